"""Surface models of a link: sampled from meshes, or fused from scans with the robot's own poses."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from scipy.spatial import cKDTree

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, o3d

_SAMPLES_PER_M2 = 6e5  # one in 1.3 mm
_INSIDE_M = 1e-4  # a choice: above the rounding of float32 at 1 m (1e-7), below any gap between links
_VOXEL_M = 0.0015  # a choice: about the samples of a mesh (1.3 mm); half leaves voxels empty, twice rounds edges
_LEAST_SHARE, _LEAST_FRAMES = 0.5, 4  # of the frames a voxel must be seen in: what moves otherwise is not of the body
_PITCHES = 1.5  # point pitches of a voxel, a choice: at one, many voxels stay empty
_NORMAL_VOXELS = 4.0  # radius of the neighbours that tell a normal
_SAMPLE = 2000
_FEWEST = 300


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A body's surface in its own frame L: points (n, 3) m, outward unit normals (n, 3), and the middle (3,) m of the
    points."""

    points: Array
    normals: Array

    @property
    def middle(self) -> Array:
        """Centroid (3,) m."""
        return np.asarray(self.points.mean(axis=0))

    @property
    def radius_m(self) -> float:
        """Largest distance of a point from the middle, m."""
        return float(np.linalg.norm(self.points - self.middle, axis=1).max())


def model_from_solids(solids: Sequence[TriMesh], *, seed: int = 0) -> BodyModel:
    """Sample the outer surface of closed solids that may overlap; what lies inside another one is left out.

    Raises InputError without a solid.
    """
    if not solids:
        raise InputError("This link has no solids: fuse a model from the scans instead.")
    rng = np.random.default_rng(seed)
    scenes = [_scene(mesh) for mesh in solids]
    points, normals = [], []
    for k, mesh in enumerate(solids):
        p, n = mesh.sample(max(int(_SAMPLES_PER_M2 * mesh.area), 10), rng)
        probe = o3d.core.Tensor.from_numpy((p + _INSIDE_M * n).astype(np.float32))
        outside = np.ones(len(p), dtype=bool)
        for j, scene in enumerate(scenes):
            if j != k:
                outside &= scene.compute_signed_distance(probe).numpy() > 0.0
        points.append(p[outside])
        normals.append(n[outside])
    return BodyModel(np.concatenate(points), np.concatenate(normals))


def fused_model(frames: Iterable[tuple[Array, RigidTransform]], middle: Array, radius_m: float) -> BodyModel:
    """Fuse scans to the surface of what moves with a frame L: ``frames`` are clouds (N, 3) or (H, W, 3) m in C with the
    pose X_LC by calibration and robot. Only points within ``radius_m`` of ``middle`` (3,) m in L count.

    A surfel is the mean of all points in a voxel of 1.5 mm (or 1.5 pixels) that half of the frames saw: what stands
    still or belongs to another link sweeps through the voxels. Raises InputError where too little is left.
    """
    keys: list[Array] = []
    sums: list[Array] = []
    eyes, count, voxel = [], 0, _VOXEL_M
    for cloud, X_LC in frames:
        p = cloud.reshape(-1, 3)
        p = p[np.isfinite(p).all(axis=1)] @ X_LC.rotation().matrix().T + X_LC.translation()
        p = p[np.linalg.norm(p - middle, axis=1) < radius_m]
        count += 1
        eyes.append(X_LC.translation())
        if len(p) > 1:
            if not keys:  # wider than the pixels are apart, or voxels stay empty
                apart = np.asarray(cKDTree(p).query(p[:: 1 + len(p) // _SAMPLE], [2])[0])
                voxel = max(_VOXEL_M, _PITCHES * float(np.median(apart)))
            cell, index, size = np.unique(
                np.floor(p / voxel).astype(np.int64), axis=0, return_inverse=True, return_counts=True
            )
            mean = np.stack([np.bincount(index.ravel(), p[:, k]) for k in range(3)], axis=1) / size[:, None]
            keys.append(cell)
            sums.append(mean)
    if not keys:
        raise InputError("No scan shows anything where the body should be.")
    cell, index, seen = np.unique(np.concatenate(keys), axis=0, return_inverse=True, return_counts=True)
    flat = np.concatenate(sums)
    points = np.stack([np.bincount(index.ravel(), flat[:, k]) for k in range(3)], axis=1) / seen[:, None]
    points = points[seen >= max(_LEAST_FRAMES, _LEAST_SHARE * count)]
    if len(points) < _FEWEST:
        raise InputError(f"Only {len(points)} surface points move with this body; show more of it, or another body.")
    surface = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    surface.estimate_normals(o3d.geometry.KDTreeSearchParamRadius(_NORMAL_VOXELS * voxel))
    surface.orient_normals_towards_camera_location(np.mean(eyes, axis=0))
    normals = np.asarray(surface.normals)
    # a lone point has no neighbours to tell its plane from
    near = np.asarray(cKDTree(points).query(points, [8])[0])[:, 0] < _NORMAL_VOXELS * voxel
    return BodyModel(points[near], normals[near])


def _scene(mesh: TriMesh) -> Any:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
        o3d.core.Tensor.from_numpy(mesh.triangles.astype(np.uint32)),
    )
    return scene
