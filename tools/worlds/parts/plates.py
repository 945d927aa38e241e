"""Simulated scans of workpieces: a part on a table with other objects, ray-cast for any scanner preset."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.spatial import cKDTree

from weldcal.models.mesh import TriMesh, extrude
from weldcal.models.scanners import ScannerPreset, apply_noise, depth_to_points
from weldcal.models.workpieces.plate import Workpiece
from weldcal.welding.locate.planes import Floats, into

TABLE_M = 1.4
SLANT_RAD = 0.1  # of the scanner against the vertical, at most


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan p_BS (H,W,3) m, NaN where nothing was measured, and the true pose."""

    cloud_B: Floats
    eye_B: Floats
    X_BP: RigidTransform
    part: Workpiece


def box(length: float, width: float, height: float) -> TriMesh:
    """A box that rests on z = 0, m."""
    corners = 0.5 * np.array([(-length, -width), (length, -width), (length, width), (-length, width)])
    return extrude(corners, 0.0, height)


def table() -> TriMesh:
    """A table whose top is z = 0."""
    return box(TABLE_M, TABLE_M, 0.02).transformed(RigidTransform([0.6, 0.0, -0.02]))


def looking_at(eye: Floats, target: Floats) -> RigidTransform:
    """X_BC of a camera at `eye` (3,) that looks at `target` (3,), image rows along x of the base as near as can be."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), eye)


def cast(meshes: Sequence[TriMesh], X_BC: RigidTransform, scanner: ScannerPreset, seed: int) -> Floats:
    """What the scanner at X_BC sees of meshes given in base, its noise included: (H,W,3) m in base."""
    import open3d

    tensor: Any = open3d.core.Tensor
    scene = open3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.triangles.astype(np.uint32)))
    flat = np.ones((scanner.height, scanner.width), dtype=np.float32)
    rays_C = depth_to_points(flat, scanner.fx, scanner.fy, scanner.cx, scanner.cy)
    R, eye = X_BC.rotation().matrix(), X_BC.translation()
    rays = np.concatenate([np.broadcast_to(eye, rays_C.shape), rays_C @ R.T], axis=2).astype(np.float32)
    # The rays have unit depth, so what the caster calls distance is depth.
    depth = scene.cast_rays(tensor(rays))["t_hit"].numpy()
    depth[~np.isfinite(depth)] = 0.0
    measured = apply_noise(depth, scanner, np.random.default_rng(seed))
    points_C = depth_to_points(measured, scanner.fx, scanner.fy, scanner.cx, scanner.cy)
    return np.asarray(points_C @ R.T + eye)


def random_pose(rng: np.random.Generator, part: Workpiece, tilt_rad: float, spread_m: float = 0.06) -> RigidTransform:
    """X_BP of a part wedged up on the table: any turn, a tilt up to `tilt_rad` in any direction, its underside free."""
    heading, tilt = rng.uniform(-math.pi, math.pi), tilt_rad * math.sqrt(rng.uniform())
    axis = tilt * np.array([math.cos(heading), math.sin(heading)])
    R = RotationMatrix(RollPitchYaw(axis[0], axis[1], 0.0)) @ RotationMatrix.MakeZRotation(
        rng.uniform(-math.pi, math.pi)
    )
    lift = -float((part.mesh.vertices @ R.matrix().T)[:, 2].min()) + 0.0005
    x, y = np.array([0.6, 0.0]) + rng.uniform(-spread_m, spread_m, size=2)
    return RigidTransform(R, [x, y, lift])


def scan_part(
    part: Workpiece,
    scanner: ScannerPreset,
    seed: int,
    *,
    tilt_rad: float = 0.0,
    spread_m: float = 0.06,
    others: Sequence[TriMesh] = (),
) -> Scene:
    """A part in a random place and turn under a scanner that hangs roughly above it.

    Everything random, the scanner's place and noise included, follows from the seed.
    """
    rng = np.random.default_rng([seed, 41])
    X = random_pose(rng, part, tilt_rad, spread_m)
    far = min(0.93, 0.97 * scanner.far_m)
    around, slant = rng.uniform(-math.pi, math.pi), SLANT_RAD * math.sqrt(rng.uniform())
    target = np.array([0.6, 0.0, 0.02])
    eye = target + far * np.array(
        [math.sin(slant) * math.cos(around), math.sin(slant) * math.sin(around), math.cos(slant)]
    )
    X_BC = looking_at(eye, target)
    X_BC = RigidTransform(X_BC.rotation() @ RotationMatrix.MakeZRotation(rng.uniform(-0.3, 0.3)), eye)
    cloud = cast([part.mesh.transformed(X), table(), *others], X_BC, scanner, seed)
    return Scene(cloud, eye, X, part)


def sideways(points_B: Floats, part: Workpiece, X_BP: RigidTransform) -> tuple[Floats, Floats]:
    """Signed distances (N,) of points from the true root line, in the plate's face to the left, and in height, m."""
    p = into(X_BP, points_B)
    nearest = np.asarray(cKDTree(part.seam_P).query(p)[1])
    up = np.broadcast_to(part.up_P, part.seam_P.shape)[nearest]
    left = np.cross(up, part.tangents_P[nearest])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    gap = p - part.seam_P[nearest]
    return np.sum(gap * left, axis=1), np.sum(gap * up, axis=1)
