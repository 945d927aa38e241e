"""A scan prepared for registration: thinned points with normals, the planes in it and the scanner's position."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from weldcal.models.errors import InputError
from weldcal.welding.locate.part.result import PartNotFound

Floats = npt.NDArray[np.float64]

FINE_POINTS, COARSE_CELL_M = 160_000, 0.004
FLAT_COS, FLAT_SHARE = 0.985, 0.6
PLANE_BAND_M, PLANE_TRIALS, MOST_PLANES = 0.0025, 150, 6
EYE_ABOVE_M = 1.0  # assumed where the scanner's position is not given


@dataclass(frozen=True, eq=False)
class Plane:
    """Points x with normal . x = level, the normal towards the scanner; extent_m: how far the plane is seen across."""

    normal: Floats
    level: float
    extent_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedScan:
    """Points (N,3) m in base with normals towards the scanner, a coarse copy, the planes in it, and the scanner's position.

    planes: the largest, largest first; pitch_m: distance between neighbouring points as measured; measured (M,3): all points.
    """

    points: Floats
    normals: Floats
    coarse: Floats
    coarse_normals: Floats
    planes: list[Plane]
    eye: Floats
    pitch_m: float
    measured: Floats

    @cached_property
    def tree(self) -> cKDTree:
        """The points' tree."""
        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)

    @cached_property
    def sight(self) -> Floats:
        """Unit directions (N,3) from the scanner to the points."""
        d = self.points - self.eye
        return np.asarray(d / np.linalg.norm(d, axis=1)[:, None])

    @cached_property
    def rays(self) -> cKDTree:
        """The tree of the unit directions from the scanner to the measured points."""
        d = self.measured - self.eye
        return cKDTree(d / np.linalg.norm(d, axis=1)[:, None], balanced_tree=False, compact_nodes=False)


def finite_points(points_B: npt.NDArray[np.floating]) -> Floats:
    """The measured points (N,3) of a scan (N,3) or (H,W,3); raises InputError for another shape."""
    points = np.asarray(points_B, dtype=np.float64)
    if points.ndim < 2 or points.shape[-1] != 3:
        raise InputError(f"A scan has the shape (N, 3) or (H, W, 3): this one is {points.shape}.")
    points = points.reshape(-1, 3)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def prepare(points: Floats, eye_B: npt.ArrayLike | None, least: int, seed: int) -> PreparedScan:
    """Thin a scan (N,3), estimate its normals and planes. Without `eye_B` the scanner is assumed above the largest plane.

    Raises:
        PartNotFound: fewer than `least` points.
    """
    from weldcal.models.mesh import o3d

    if len(points) < least:
        raise PartNotFound(f"The scan has only {len(points)} points: move the part into view.")
    rng = np.random.default_rng(seed)
    pitch, measured = _pitch(points, rng), points
    if len(points) > FINE_POINTS:
        points = points[np.sort(rng.choice(len(points), FINE_POINTS, replace=False))]
    cloud: Any = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(14))
    few = cloud.voxel_down_sample(COARSE_CELL_M)
    few.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
    found = _planes(np.asarray(few.points), np.asarray(few.normals), rng)
    middle = np.median(np.asarray(few.points), axis=0)
    if eye_B is None:
        up = found[0].normal * (1.0 if found[0].normal[2] >= 0.0 else -1.0) if found else np.array([0.0, 0.0, 1.0])
        eye = middle + EYE_ABOVE_M * up
    else:
        eye = np.asarray(eye_B, dtype=np.float64).reshape(3)
    planes = [f if f.normal @ eye > f.level else Plane(-f.normal, -f.level, f.extent_m) for f in found]

    def turned(cloud: Any) -> tuple[Floats, Floats]:
        p, n = np.asarray(cloud.points), np.asarray(cloud.normals)
        return p, n * np.where(np.sum(n * (eye - p), axis=1) < 0.0, -1.0, 1.0)[:, None]

    p, n = turned(cloud)
    q, m = turned(few)
    return PreparedScan(
        points=p, normals=n, coarse=q, coarse_normals=m, planes=planes, eye=eye, pitch_m=pitch, measured=measured
    )


def _planes(points: Floats, normals: Floats, rng: np.random.Generator) -> list[Plane]:
    """The largest planes among points (N,3) with normals (N,3), largest first.

    Each trial takes a point with its normal; the best one's plane is fitted to its points, and these are taken away.
    """
    found: list[Plane] = []
    least = max(60, round(0.004 * len(points)))
    for _ in range(MOST_PLANES):
        if len(points) < least:
            break
        trial = rng.choice(len(points), size=min(len(points), PLANE_TRIALS), replace=False)
        sample = points[:: max(1, len(points) // 4000)]
        n = normals[trial]
        away = sample @ n.T - np.sum(points[trial] * n, axis=1)
        best = trial[int(np.argmax(np.count_nonzero(np.abs(away) < PLANE_BAND_M, axis=0)))]
        normal, middle = normals[best], points[best]
        for _ in range(3):
            inside = np.abs((points - middle) @ normal) < PLANE_BAND_M
            if np.count_nonzero(inside) < 3:
                break
            middle = points[inside].mean(axis=0)
            normal = np.linalg.svd(np.cov((points[inside] - middle).T))[0][:, 2]
        inside = np.abs((points - middle) @ normal) < PLANE_BAND_M
        if np.count_nonzero(inside) < least:
            break
        on, along = points[inside], np.abs(normals[inside] @ normal) > FLAT_COS
        points, normals = points[~inside], normals[~inside]
        # A plane that cuts across several surfaces is none.
        if np.count_nonzero(along) >= FLAT_SHARE * len(on):
            extent = float(np.linalg.norm(np.percentile(on, 98, axis=0) - np.percentile(on, 2, axis=0)))
            found.append(Plane(np.asarray(normal), float(normal @ middle), extent))
    return found


def _pitch(points: Floats, rng: np.random.Generator) -> float:
    middle = points[rng.choice(len(points), size=min(len(points), 40), replace=False)]
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    near = np.asarray(tree.query(middle, k=min(5, len(points)))[0])[:, 1:]
    return max(float(np.median(near)), 1e-4)
