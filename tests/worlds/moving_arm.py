"""A moving UR arm, and its picture in which each pixel mixes over its exposure.

Every link is a body of its own in its own frame. A ray of a pixel and a time is cast in the link's frame of that time,
so that no frame is rendered with an arm at rest. Bodies are the drawn solids of the arm's description and the mesh of
its flange.
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import open3d as o3d
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.worlds.streams import Moves, closed_moves
from weldcal.models.arms.inverse import inverse_kinematics, nearest_solution
from weldcal.models.arms.kinematics import ArmModel, link_frames
from weldcal.models.arms.urdf import arm_urdf, placed_solid
from weldcal.models.arrays import Array
from weldcal.models.depth_noise import Depth, noisy_depth
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, flange_mesh
from weldcal.models.mesh import TriMesh, merge
from weldcal.models.scanner_streams import ScannerStream, mixed_exposure
from weldcal.models.scanners import ScannerPreset

CORNERS = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]], dtype=np.float64) - 0.5
"""Four corners of a cube that lie in no plane (section 3.2 of the paper), in units of its edge."""


def path_through(arm: ArmModel, poses: list[RigidTransform], q_near: Array, move: str, **options: float) -> Moves:
    """Return closed moves through flange poses X_BF, from joint angles near ``q_near`` (6,) rad.

    Raises InputError out of reach.
    """
    q: list[Array] = []
    for X in poses:
        found = nearest_solution(arm, X, q[-1] if q else q_near)
        if found is None:
            raise InputError(f"A waypoint is out of the {arm.name}'s reach: move the cube nearer, or make it smaller.")
        q.append(found)
    return closed_moves(np.array(q), linear=move == "moveL", robot=arm.name, fastest=True, pause_s=0.0, **options)


def cube_poses(
    centre_m: Array, edge_m: float, towards: RotationMatrix, lean_rad: float, rng: np.random.Generator
) -> list[RigidTransform]:
    """Compute flange poses at four corners of a cube about ``centre_m``.

    Each is turned away from ``towards`` by up to ``lean_rad``.
    """
    return [leaning(centre_m + edge_m * corner, towards, lean_rad, rng) for corner in CORNERS]


def leaning(p: Array, towards: RotationMatrix, lean_rad: float, rng: np.random.Generator) -> RigidTransform:
    """A pose at ``p`` (3,) m whose rotation is off ``towards``: each of roll, pitch and yaw by up to ``lean_rad``."""
    off = RollPitchYaw(*rng.uniform(-lean_rad, lean_rad, 3)).ToRotationMatrix()
    return RigidTransform(towards @ off, p)


def reachable_start(arm: ArmModel, X_BF: RigidTransform) -> Array:
    """Joint angles (6,) rad for a pose, with the elbow as high as it gets.

    Raises InputError out of reach.
    """
    found = inverse_kinematics(arm, X_BF)
    if not len(found):
        raise InputError(f"The {arm.name} does not reach the cube: move it nearer.")
    # the height of the elbow, by the upper arm's angle
    return np.asarray(found[int(np.argsort([-np.sin(q[1]) for q in found])[-1])], dtype=np.float64)


Pixels = npt.NDArray[np.intp]

_THICK_M = 0.012
_NODES = (
    5  # exact arm poses over the readout; rows between them are interpolated, which bends by less than 0.1 micrometre
)
_CELL, _AROUND = (
    8,
    7,
)  # pixels of a coarse picture's cell, and cells about it in which a body may show: 24 pixels either way
_DARK = {"charcoal": 0.7, "blue_grey": 0.0, "light_grey": 0.0}


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Hold a rigid body: ``link`` counts as link_frames does (0 the base, 6 wrist 3), None is fixed in the base.

    ``dark`` 0 to 1.
    """

    link: int | None
    mesh: TriMesh
    dark: float = 0.0


class _Cast:
    """The bodies of one link as a scene of its own."""

    def __init__(self, bodies: list[RigidBody]) -> None:
        self.link = bodies[0].link
        self.scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        for body in bodies:
            self.scene.add_triangles(
                o3d.core.Tensor.from_numpy(body.mesh.vertices.astype(np.float32)),
                o3d.core.Tensor.from_numpy(body.mesh.triangles.astype(np.uint32)),
            )
        self.dark = np.array([*(b.dark for b in bodies), 0.0], dtype=np.float32)

    def cast(self, origins: Array, directions: Array) -> tuple[Depth, Depth]:
        """Depth (h, w) of the first surface, infinite where there is none, and how dark it is."""
        rays = np.concatenate([np.broadcast_to(origins, directions.shape), directions], axis=-1).astype(np.float32)
        hit = self.scene.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)
        ids = np.minimum(hit["geometry_ids"].numpy().astype(np.int64), len(self.dark) - 1)
        return hit["t_hit"].numpy(), self.dark[ids]


def arm_bodies(arm: ArmModel, flange: FlangeStandard) -> list[RigidBody]:
    """Return the drawn solids of an arm and the mesh of its flange, in their links' frames."""
    root = ET.fromstring(arm_urdf(arm))
    bodies = [RigidBody(6, flange_mesh(flange, _THICK_M))]
    for link in root.iter("link"):
        for visual in link.iter("visual"):
            material, number = visual.find("material"), arm.link_names.index(link.get("name", ""))
            assert material is not None
            bodies.append(RigidBody(number, placed_solid(visual), _DARK.get(material.get("name", ""), 0.0)))
    return bodies


class MovingScene:
    """Renders what a streaming scanner returns of bodies on a moving arm and of bodies that stand in the base."""

    def __init__(self, arm: ArmModel, bodies: list[RigidBody], scanner: ScannerPreset, stream: ScannerStream) -> None:
        self.arm, self.scanner, self.stream = arm, scanner, stream
        links = sorted({b.link for b in bodies if b.link is not None})
        self._moving = [_Cast([b for b in bodies if b.link == k]) for k in links]
        fixed = [b for b in bodies if b.link is None]
        self._fixed = [_Cast([RigidBody(None, merge(*(b.mesh for b in fixed)))])] if fixed else []
        self._background: tuple[Array, Depth] | None = None  # camera pose and its depth map
        u = (np.arange(scanner.width) - scanner.cx) / scanner.fx
        v = (np.arange(scanner.height) - scanner.cy) / scanner.fy
        self._rays = np.stack(
            [*np.meshgrid(u, v), np.ones((scanner.height, scanner.width))], axis=-1
        )  # (H, W, 3), one metre deep

    def frame(
        self,
        joints: Callable[[float], Array],
        X_BC: RigidTransform,
        capture_s: float,
        rng: np.random.Generator,
        *,
        samples: int = 5,
        scanner: ScannerPreset | None = None,
    ) -> Depth:
        """Return the depth map (H, W) m of one frame, 0 where nothing was measured.

        ``joints(t)`` are the joint angles (6,) rad at time t, ``capture_s`` the middle of the exposure of the middle
        row. ``samples`` times of the exposure are mixed. ``scanner`` has the errors of this frame (the preset's).
        """
        device = self.scanner if scanner is None else scanner
        depth, dark = self._mixed(joints, X_BC, capture_s, samples, rng)
        rows, columns = (np.flatnonzero(depth.any(axis=k)) for k in (1, 0))
        out = np.zeros_like(depth)
        if not len(rows):
            return out
        r = slice(max(int(rows[0]) - 3, 0), int(rows[-1]) + 4)
        c = slice(max(int(columns[0]) - 3, 0), int(columns[-1]) + 4)
        noisy = noisy_depth(
            depth[r, c], device.noise, device.fx, device.fy, device.cx - c.start, device.cy - r.start, rng, dark[r, c]
        )
        noisy[(noisy < device.near_m) | (noisy > device.far_m)] = 0.0
        out[r, c] = noisy
        return out

    def _mixed(
        self, joints: Callable[[float], Array], X_BC: RigidTransform, capture_s: float, n: int, rng: np.random.Generator
    ) -> tuple[Depth, Depth]:
        """Depth and darkness (H, W) after the exposure.

        The mean of its samples on a surface, one or a mix of two at an edge.
        """
        stream, shape = self.stream, self._rays.shape[:2]
        offsets = stream.exposure_s * ((np.arange(n) + 0.5) / n - 0.5)
        dark = np.zeros(shape, dtype=np.float32)
        X_CB = X_BC.inverse()
        middle = [X_CB @ X for X in link_frames(self.arm, joints(capture_s))]
        seen = [self._pixels(body, middle) for body in self._moving]
        stack = np.stack([self._instant(joints, X_CB, capture_s + dt, seen, dark) for dt in offsets])
        noise = self.scanner.noise
        out = mixed_exposure(stack, noise.edge_step_m, noise.flying, rng)
        out[(out < self.scanner.near_m) | (out > self.scanner.far_m)] = 0.0
        return out, dark

    def _pixels(self, body: _Cast, X_CL: list[RigidTransform]) -> Pixels:
        """Indices (n,) of the pixels in which a body may show during a frame.

        Where a coarse picture shows it, and around.
        """
        assert body.link is not None
        X = X_CL[body.link]
        R, p = X.rotation().matrix(), X.translation()
        coarse = body.cast(-R.T @ p, self._rays[_CELL // 2 :: _CELL, _CELL // 2 :: _CELL] @ R)[0]
        near = cv2.dilate(np.isfinite(coarse).astype(np.uint8), np.ones((_AROUND, _AROUND), dtype=np.uint8))
        fine = np.kron(near, np.ones((_CELL, _CELL), dtype=np.uint8))
        height, width = self._rays.shape[:2]
        down, right = max(height - fine.shape[0], 0), max(width - fine.shape[1], 0)
        return np.flatnonzero(np.pad(fine, ((0, down), (0, right)), mode="edge")[:height, :width])

    def _instant(
        self, joints: Callable[[float], Array], X_CB: RigidTransform, t: float, seen: list[Pixels], dark: Depth
    ) -> Depth:
        """Depth (H, W) with each row at its own time; ``dark`` takes the darkness of what the moving bodies show."""
        height, width = self._rays.shape[:2]
        out = self._static(X_CB.inverse()).copy()
        row_times = t + self.stream.readout_s * (np.arange(height) / max(height - 1, 1) - 0.5)
        nodes = np.linspace(row_times[0], row_times[-1], _NODES) if self.stream.readout_s > 0.0 else np.array([t])
        frames = [link_frames(self.arm, joints(float(time))) for time in nodes]
        for body, at in zip(self._moving, seen, strict=True):
            if not len(at):
                continue
            assert body.link is not None
            poses = [(X_CB @ f[body.link]).GetAsMatrix34() for f in frames]
            rays = self._rays.reshape(-1, 3)[at]
            if len(nodes) > 1:
                X = _between(np.array(poses), nodes, row_times)[at // width]
                rays = np.einsum("nji,nj->ni", X[:, :, :3], rays)
                origins = -np.einsum("nji,nj->ni", X[:, :, :3], X[:, :, 3])
            else:
                R, p = poses[0][:, :3], poses[0][:, 3]
                rays, origins = rays @ R, -R.T @ p
            depth, shade = body.cast(origins, rays)
            nearer = depth < out.ravel()[at]
            out.ravel()[at[nearer]] = depth[nearer]
            dark.ravel()[at[nearer]] = shade[nearer]
        return out

    def _static(self, X_WC: RigidTransform) -> Depth:
        """Return the depth (H, W) of the static surroundings, rendered again where the camera has moved."""
        pose = X_WC.GetAsMatrix34()
        if self._background is not None and np.array_equal(self._background[0], pose):
            return self._background[1]
        out: Depth = np.full(self._rays.shape[:2], np.inf, dtype=np.float32)
        for body in self._fixed:
            out = body.cast(X_WC.translation(), self._rays @ X_WC.rotation().matrix().T)[0]
        self._background = (pose, out)
        return out


def _between(poses: Array, nodes: Array, times: Array) -> Array:
    """Poses (h, 3, 4) at ``times`` (h,), linear between those (n, 3, 4) at ``nodes`` (n,)."""
    k = np.clip(np.searchsorted(nodes, times, side="right") - 1, 0, len(nodes) - 2)
    w = ((times - nodes[k]) / (nodes[k + 1] - nodes[k]))[:, None, None]
    return np.asarray((1.0 - w) * poses[k] + w * poses[k + 1])
