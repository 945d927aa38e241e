"""Finds upward planes in a scan, frames on them, and rasters of the points on and below a face."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import cKDTree

from weldcal.models.errors import InputError

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

PLANE_BAND_M = 0.0015  # above a scanner's noise and form error at 1 m; twice it, a plate's 3 mm, parts two planes


@dataclass(frozen=True, eq=False)
class Raster:
    """Which cells of the plane hold face points, or points well below the face; cell size and corner in metres."""

    face: Mask
    below: Mask
    cell: float
    corner: Floats

    def look(self, cells: npt.NDArray[Any], xy: Floats) -> npt.NDArray[Any]:
        """Values of a raster (H,W) at points (...,2); points outside it read its first cell, which is kept empty."""
        height, width = cells.shape
        x, y = (((xy[..., k] - self.corner[k]) / self.cell).astype(np.int64) for k in range(2))
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return np.asarray(cells[y * inside, x * inside])


def finite_points(points_B: npt.NDArray[np.floating] | Sequence[npt.NDArray[np.floating]]) -> list[Floats]:
    """Select the measured points (N,3) of each scan, (N,3) or (H,W,3), of a list or alone.

    Raises:
        InputError: a scan has another shape.
    """
    found = []
    for one in points_B if isinstance(points_B, list | tuple) else [points_B]:
        points = np.asarray(one, dtype=np.float64)
        if points.ndim < 2 or points.shape[-1] != 3:
            raise InputError(f"A scan has the shape (N, 3) or (H, W, 3): this one is {points.shape}.")
        points = points.reshape(-1, 3)
        found.append(np.asarray(points[np.isfinite(points).all(axis=1)]))
    return found


def into(X_AB: RigidTransform, p_A: Floats) -> Floats:
    """Points (N,3) given in A, expressed in B."""
    return np.asarray((p_A - X_AB.translation()) @ X_AB.rotation().matrix(), dtype=np.float64)


def turned(x: float, y: float, yaw: float) -> RigidTransform:
    return RigidTransform(RotationMatrix.MakeZRotation(yaw), np.array([x, y, 0.0]))


def plane_frame(normal: Floats, center: Floats) -> RigidTransform:
    """A frame on a plane: z along the normal, x as close to the given x as possible."""
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    R = RotationMatrix(np.column_stack([x, np.cross(normal, x), normal]))
    return RigidTransform(R, np.array([0.0, 0.0, float(normal @ center) / normal[2]]))


def upward_planes(
    sample: Floats, steepest_rad: float, least_points: int, rng: np.random.Generator, most: int = 4
) -> list[RigidTransform]:
    """Find up to `most` planes through points (N,3) whose normals lie within an angle of z, as frames Q.

    Most points first.
    """
    planes: list[RigidTransform] = []
    rest = sample
    steepest = math.cos(steepest_rad)
    for _ in range(most):
        if len(rest) < least_points:
            break
        # Triples of neighbours: all three lie on one surface far more often than three points from anywhere.
        neighbours = min(len(rest) - 1, max(30, len(rest) // 12))
        first = rng.integers(len(rest), size=200)
        near = np.asarray(cKDTree(rest).query(rest[first], k=neighbours)[1])
        second, third = (near[np.arange(len(first)), rng.integers(1, neighbours, size=len(first))] for _ in range(2))
        a = rest[first]
        normal = np.cross(rest[second] - a, rest[third] - a)
        length = np.linalg.norm(normal, axis=1)
        normal *= np.where(normal[:, 2:] < 0.0, -1.0, 1.0)
        usable = (length > 1e-5) & (normal[:, 2] > steepest * length)
        if not usable.any():
            break
        normal = normal[usable] / length[usable, None]
        distance = rest @ normal.T - np.einsum("ij,ij->i", normal, a[usable])
        best = int(np.argmax(np.count_nonzero(np.abs(distance) < PLANE_BAND_M, axis=0)))
        X = plane_frame(normal[best], a[usable][best])
        for _ in range(3):
            q = into(X, rest)
            on = np.abs(q[:, 2]) < PLANE_BAND_M
            if np.count_nonzero(on) < 50:
                break
            center = rest[on].mean(axis=0)
            n = np.linalg.svd(rest[on] - center, full_matrices=False)[2][2]
            X = plane_frame(n * np.sign(n[2]), center)
        planes.append(X)
        rest = rest[np.abs(into(X, rest)[:, 2]) > 2.0 * PLANE_BAND_M]
    return planes


def robust_plane(p: Floats) -> tuple[RigidTransform, float]:
    """Plane through most of the points (N,3) as a frame, and their standard deviation about it (from the median)."""
    X, sigma = RigidTransform(), 0.0
    for _ in range(6):
        z = into(X, p)[:, 2]
        sigma = 1.4826 * float(np.median(np.abs(z - np.median(z))))
        on = np.abs(z - np.median(z)) < max(3.0 * sigma, 5e-5)
        center = p[on].mean(axis=0)
        _, vectors = np.linalg.eigh(np.cov((p[on] - center).T))
        n = vectors[:, 0]
        X = plane_frame(n * np.sign(n[2]), center)
    return X, sigma


def point_pitch(xy: Floats) -> float:
    """Typical distance between neighbouring scan points on the face, m; of a large cloud from a few windows of it."""
    if len(xy) > 40_000:
        size = np.ptp(xy, axis=0)
        half = 0.5 * math.sqrt(3000.0 * float(np.prod(size)) / len(xy))
        middles = xy[(np.linspace(0.15, 0.85, 6) * len(xy)).astype(int)]
        windows = [xy[(np.abs(xy - m) < half).all(axis=1)] for m in middles]
        return float(np.median([point_pitch(w) for w in windows if len(w) > 100]))
    some = xy[:: max(1, len(xy) // 1000)]
    distance = np.asarray(cKDTree(xy, balanced_tree=False, compact_nodes=False).query(some, k=2)[0])
    return max(float(np.median(distance[:, 1])), 1e-4)


def thinned(points: Floats, most: int, least_cell_m: float = 0.0) -> Floats:
    """Thin points (N,3), z up, to about `most`: one unchanged point in every cell of a square grid seen from above.

    ``least_cell_m``: cells are at least this large, so that fewer may be left. A cloud with fewer points is returned
    unchanged.
    """
    if len(points) <= most and least_cell_m == 0.0:
        return points
    corner = points[:, :2].min(axis=0)
    size = points[:, :2].max(axis=0) - corner
    cell = max(math.sqrt(float(np.prod(size)) / most), least_cell_m, 1e-4)
    index = ((points[:, :2] - corner) / cell).astype(np.int64)
    width = int(size[0] / cell) + 1
    chosen = np.full(width * (int(size[1] / cell) + 1), -1)
    chosen[index[:, 1] * width + index[:, 0]] = np.arange(len(points))
    kept = points[np.sort(chosen[chosen >= 0])]
    return kept if len(kept) < 0.9 * len(points) else points


def rasterise(p: Floats, face: Mask, below: Mask, pitch: float) -> Raster:
    """Rasterise points (N,3) in cells of two pitches; small gaps in the face are closed."""
    cell = max(2.0 * pitch, 0.001)
    corner = p[:, :2].min(axis=0) - 4.0 * cell
    width, height = (np.ceil((p[:, :2].max(axis=0) - corner) / cell).astype(int) + 4).tolist()
    layers = np.zeros((2, height, width), dtype=np.uint8)
    for layer, which in zip(layers, (face, below), strict=True):
        i = ((p[which, :2] - corner) / cell).astype(np.int64)
        layer[i[:, 1], i[:, 0]] = 1
    closed = cv2.morphologyEx(layers[0], cv2.MORPH_CLOSE, np.ones((3, 3), dtype=np.uint8))
    return Raster(closed.astype(bool), layers[1].astype(bool), cell, corner)
