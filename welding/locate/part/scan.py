"""Scans prepared for registration: thinned points with normals, the planes in them and the scanner's positions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
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
LEVEL_M = (0.0004, PLANE_BAND_M)  # height over a plane that is no longer its own: at least half of a sheet of 0.8 mm
NARROWED_M = (1.5e-3, 1.2e-3, 1e-3, 0.8e-3, 0.6e-3, 0.5e-3, 0.4e-3, 0.4e-3, 0.4e-3)  # bands over a plane's lowest tenth
LEAST_LEVEL = 300  # points in such a band: the level is then known to 0.1 mm / sqrt(300) = 6 um
LEVEL_COS = math.cos(math.radians(1.0))  # turn of a plane 0.3 m across by which its ends leave the band of +-2.5 mm
EYE_ABOVE_M = 1.0  # assumed where the scanner's position is not given


@dataclass(frozen=True, eq=False)
class Plane:
    """Points x with normal . x = level, the normal towards the scanner.

    Attributes:
        extent_m: how far the scan shows the plane across.
        filled: area of its points over that of the square with this diagonal.
        own_m: height over it within which a point is its own.
    """

    normal: Floats
    level: float
    extent_m: float
    filled: float
    own_m: float = PLANE_BAND_M


@dataclass(frozen=True, eq=False)
class View:
    """One scan: the scanner's position (3,) in base, all measured points (M,3) and their distance, m."""

    eye: Floats
    measured: Floats
    pitch_m: float

    @cached_property
    def rays(self) -> cKDTree:
        """The tree of the unit directions from the scanner to the measured points."""
        d = self.measured - self.eye
        return cKDTree(d / np.linalg.norm(d, axis=1)[:, None], balanced_tree=False, compact_nodes=False)


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedScan:
    """Points (N,3) m in base with normals towards the scanner, a coarse copy, and the planes in them.

    ``view`` (N,): index in `views` of each point's scan; planes: the largest, largest first; pitch_m: distance between
    neighbouring points as measured.
    """

    points: Floats
    normals: Floats
    view: npt.NDArray[np.int64]
    coarse: Floats
    coarse_normals: Floats
    planes: list[Plane]
    views: tuple[View, ...]
    pitch_m: float

    @cached_property
    def tree(self) -> cKDTree:
        """The points' tree."""
        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)

    @cached_property
    def shown(self) -> list[cKDTree]:
        """The trees of the coarse points in each of the planes."""
        return [cKDTree(self.coarse[np.abs(self.coarse @ p.normal - p.level) < p.own_m]) for p in self.planes]

    @cached_property
    def sight(self) -> Floats:
        """Unit directions (N,3) from each point's scanner to the points."""
        d = self.points - self.eyes[self.view]
        return np.asarray(d / np.linalg.norm(d, axis=1)[:, None])

    @cached_property
    def extent_m(self) -> float:
        """How far the scan shows the scene across."""
        return float(np.linalg.norm(np.subtract(*np.percentile(self.coarse, (98, 2), axis=0))))

    @cached_property
    def eyes(self) -> Floats:
        """The scanners' positions (V,3)."""
        return np.array([v.eye for v in self.views])


def prepare(scans: list[Floats], eye_B: npt.ArrayLike | None, least: int, seed: int) -> PreparedScan:
    """Thin scans (N,3) of one scene, and estimate normals and planes.

    Without `eye_B` the scanner is assumed above the largest plane.

    Raises:
        PartNotFound: fewer than `least` points. InputError: several scans without a position for each.
    """
    from weldcal.models.mesh import o3d

    points = np.concatenate(scans)
    if len(points) < least:
        raise PartNotFound(f"The scan has only {len(points)} points: move the part into view.")
    if len(scans) > 1 and (eye_B is None or np.shape(eye_B) != (len(scans), 3)):
        raise InputError(
            f"{len(scans)} scans need a scanner position for each: give eye_B with the shape ({len(scans)}, 3)."
        )
    rng = np.random.default_rng(seed)
    pitch = _pitch(max(scans, key=len), rng)
    view = np.repeat(np.arange(len(scans)), [len(one) for one in scans])
    if len(points) > FINE_POINTS:
        chosen = np.sort(rng.choice(len(points), FINE_POINTS, replace=False))
        points, view = points[chosen], view[chosen]
    cloud: Any = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(14))
    few = cloud.voxel_down_sample(COARSE_CELL_M)
    few.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
    coarse, coarse_normals = np.asarray(few.points), np.asarray(few.normals)
    found = _planes(coarse, coarse_normals, rng)
    if eye_B is None:
        up = found[0].normal * (1.0 if found[0].normal[2] >= 0.0 else -1.0) if found else np.array([0.0, 0.0, 1.0])
        eyes = (np.median(coarse, axis=0) + EYE_ABOVE_M * up)[None]
    else:
        eyes = np.asarray(eye_B, dtype=np.float64).reshape(-1, 3)
    eye = eyes.mean(axis=0)
    planes = [
        _own_level(f if f.normal @ eye > f.level else replace(f, normal=-f.normal, level=-f.level), coarse)
        for f in found
    ]
    normals = np.asarray(cloud.normals)
    normals = normals * np.where(np.sum(normals * (eyes[view] - points), axis=1) < 0.0, -1.0, 1.0)[:, None]
    near = normals[np.asarray(cKDTree(points).query(coarse)[1])]
    coarse_normals = coarse_normals * np.where(np.sum(coarse_normals * near, axis=1) < 0.0, -1.0, 1.0)[:, None]
    return PreparedScan(
        points=points,
        normals=normals,
        view=view,
        coarse=coarse,
        coarse_normals=coarse_normals,
        planes=planes,
        views=tuple(View(e, p, pitch) for e, p in zip(eyes, scans, strict=True)),
        pitch_m=pitch,
    )


def _own_level(plane: Plane, points: Floats) -> Plane:
    """Fit the plane to its lowest points only: a thin sheet that lies on a table is no part of the table."""
    height = points @ plane.normal - plane.level
    band = points[np.abs(height) < PLANE_BAND_M]
    normal, level = plane.normal, plane.level
    for above in NARROWED_M:
        height = band @ normal - level
        low = band[height < np.percentile(height, 10) + above]
        if len(low) < LEAST_LEVEL:
            return plane
        middle = low.mean(axis=0)
        towards = np.linalg.svd(np.cov((low - middle).T))[0][:, 2]
        normal = towards * (1.0 if towards @ normal > 0.0 else -1.0)
        level = float(normal @ middle)
    if normal @ plane.normal < LEVEL_COS:
        return plane
    sigma = 1.4826 * float(np.median(np.abs(low @ normal - level)))
    return replace(plane, normal=normal, level=level, own_m=min(max(LEVEL_M[0], 4.0 * sigma), LEVEL_M[1]))


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
            filled = 2.0 * len(on) * COARSE_CELL_M**2 / max(extent, 1e-9) ** 2
            found.append(Plane(np.asarray(normal), float(normal @ middle), extent, filled))
    return found


def _pitch(points: Floats, rng: np.random.Generator) -> float:
    middle = points[rng.choice(len(points), size=min(len(points), 40), replace=False)]
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    near = np.asarray(tree.query(middle, k=min(5, len(points)))[0])[:, 1:]
    return max(float(np.median(near)), 1e-4)
