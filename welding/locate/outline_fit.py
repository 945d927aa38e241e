"""Fits a plate's outline to the edge of its scanned face: exhaustive search, robust fit and check.

All in the plane of the face; a bent face is unrolled first.
"""

import math

import cv2
import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform
from scipy.optimize import least_squares

from weldcal.welding.locate.planes import PLANE_BAND_M, Floats, Raster, point_pitch, rasterise, turned
from weldcal.welding.locate.pose_covariance import outline_covariance


def inward_normals(outline: Floats) -> Floats:
    """Unit normals (k,2) of the edges of a counter-clockwise outline (k,2), towards its inside."""
    along = np.roll(outline, -1, axis=0) - outline
    normals = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1, keepdims=True)
    return np.asarray(normals, dtype=np.float64)


def along(outline: Floats, spacing: float) -> tuple[Floats, Floats, npt.NDArray[np.int64]]:
    """Points (N,2) along the outline, the inward unit normals (N,2) there and the edges' numbers (N,)."""
    following = np.roll(outline, -1, axis=0)
    steps = [max(1, int(np.linalg.norm(b - a) / spacing)) for a, b in zip(outline, following, strict=True)]
    edge = np.repeat(np.arange(len(outline)), steps)
    t = np.concatenate([(np.arange(n) + 0.5) / n for n in steps])[:, None]
    return outline[edge] * (1.0 - t) + following[edge] * t, inward_normals(outline)[edge], edge


def slide(q: Floats, outline: Floats, max_shift_m: float, max_turn_rad: float) -> tuple[RigidTransform, float]:
    """Best pose of the outline (k,2) in plane frame Q by exhaustive search, coarse then fine, and its score."""
    raster = rasterise(q, np.abs(q[:, 2]) < PLANE_BAND_M, q[:, 2] < -0.003, point_pitch(q[:, :2]))
    solid = raster.face.astype(np.uint8)
    border = solid - cv2.erode(solid, np.ones((3, 3), dtype=np.uint8))
    gap = cv2.distanceTransform(1 - border, cv2.DIST_L2, 5) * raster.cell
    gap[0, 0] = 1.0
    rim, _, _ = along(outline, 0.005)
    low, high = outline.min(axis=0), outline.max(axis=0)
    steps = [np.arange(a + 0.01, b - 0.005, 0.015) for a, b in zip(low, high, strict=True)]
    fill = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)

    best = np.zeros(3)
    score = -math.inf
    for shift, step, turn, turn_step, cap in (
        (max_shift_m + 0.006, 0.006, max_turn_rad + 0.035, 0.035, 0.015),
        (0.006, 0.002, 0.035, 0.007, 0.005),
        (0.002, 0.0005, 0.007, 0.002, 0.003),
    ):
        offsets = np.arange(-shift, shift + 1e-9, step)
        centers = best[:2] + np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 1, 2)
        start, score = best, -math.inf
        for yaw in start[2] + np.arange(-turn, turn + 1e-9, turn_step):
            c, s = math.cos(yaw), math.sin(yaw)
            R = np.array([[c, s], [-s, c]])
            off = np.minimum(raster.look(gap, rim @ R + centers).astype(np.float64), cap).mean(axis=1) / cap
            filled = raster.look(raster.face, fill @ R + centers).mean(axis=1)
            merit = filled - off
            k = int(np.argmax(merit))
            if merit[k] > score:
                score, best = float(merit[k]), np.array([*centers[k, 0], yaw])
    return turned(*best), score


def by_the_edge(p: Floats, outline: Floats, reach: float = 0.020) -> npt.NDArray[np.bool_]:
    """Mask of points (N,k) within a distance of the outline, inside or outside of it."""
    near = np.zeros(len(p), dtype=bool)
    for a, b, inward in zip(outline, np.roll(outline, -1, axis=0), inward_normals(outline), strict=True):
        length = float(np.linalg.norm(b - a))
        t = (p[:, :2] - a) @ (b - a) / length
        near |= (np.abs((p[:, :2] - a) @ inward) < reach) & (t > -reach) & (t < length + reach)
    return near


def outermost(face: Floats, outline: Floats, gate: float, pitch: float) -> tuple[Floats, npt.NDArray[np.int64]]:
    """The face point nearest the outside in every strip across each edge: its row (M,k) and the edges' numbers (M,).

    ``face`` (N,k): x and y first, then any other columns.
    """
    found, numbers = [], []
    for k, (a, b, inward) in enumerate(
        zip(outline, np.roll(outline, -1, axis=0), inward_normals(outline), strict=True)
    ):
        length = float(np.linalg.norm(b - a))
        t = (face[:, :2] - a) @ (b - a) / length
        d = (face[:, :2] - a) @ inward
        # Strips end before the corners, where points belong to the neighbouring edge.
        near = np.flatnonzero((np.abs(d) < gate) & (t > 0.01) & (t < length - 0.01))
        strip = (t[near] / (3.0 * pitch)).astype(np.int64)
        order = np.lexsort((d[near], strip))
        _, first = np.unique(strip[order], return_index=True)
        found.append(face[near[order[first]]])
        numbers.append(np.full(len(first), k))
    return np.concatenate(found), np.concatenate(numbers)


def fit_outline(
    rims: Floats, edges: npt.NDArray[np.int64], outline: Floats, pitch: float, slant_rad: float | None, noise: float
) -> tuple[RigidTransform, float, Floats]:
    """Fit the in-plane motion that puts outermost points (M,2) on their edges.

    The inset, m, and the covariance (3,3) of x, y and turn.

    The scanner's last point on the face lies up to a pitch inside the edge; that inset is one more unknown, the same at
    all edges and held near half a pitch, so that it cancels where opposite edges are seen.
    """
    a, inward = outline[edges], inward_normals(outline)[edges]
    prior = math.sqrt(len(edges)) * 0.1

    def residuals(v: Floats) -> Floats:
        c, s = math.cos(v[2]), math.sin(v[2])
        moved = (rims - v[:2]) @ np.array([[c, -s], [s, c]])
        inset = np.einsum("ij,ij->i", moved - a, inward)
        return np.append(inset - v[3], prior * (v[3] - 0.5 * pitch))

    start = np.array([0.0, 0.0, 0.0, 0.5 * pitch])
    limit = np.array([0.02, 0.02, 0.1])
    fit = least_squares(
        residuals,
        start,
        loss="soft_l1",
        f_scale=0.3 * pitch,
        x_scale=np.array([1e-3, 1e-3, 1e-2, 1e-3]),
        bounds=(np.append(-limit, -0.1 * pitch), np.append(limit, 1.3 * pitch)),
    )
    off = residuals(fit.x)[:-1]
    covariance = outline_covariance(np.asarray(fit.jac), off, edges, pitch, prior, slant_rad, noise)
    return turned(*fit.x[:3]), float(fit.x[3]), covariance


def displaced(
    rims: Floats, edges: npt.NDArray[np.int64], outline: Floats, inset: float, tolerance: float, raster: Raster
) -> set[int]:
    """Edges whose outermost points (M,2) lie further than the tolerance from where the edges are drawn.

    Only points that end the face count: lower ground is seen just beyond them, not the shadow of something in front.
    """
    inward = inward_normals(outline)[edges]
    depth = np.einsum("ij,ij->i", rims - outline[edges], inward) - inset
    beyond = rims[:, None, :] - np.arange(0.002, 0.0125, 0.002)[:, None] * inward[:, None, :]
    ends = raster.look(raster.below, beyond).any(axis=1) | (depth < -tolerance)
    seen = [k for k in range(len(outline)) if np.count_nonzero(ends & (edges == k)) >= 10]
    return {k for k in seen if abs(float(np.median(depth[ends & (edges == k)]))) > tolerance}


def check(raster: Raster, outline: Floats, displaced: set[int]) -> tuple[float, float]:
    """Shares of the outline where the face ends as drawn, and where the scan shows that it does not."""
    at, inward, edge = along(outline, 0.002)
    offset = max(0.003, 2.0 * raster.cell) * inward
    face_in, face_out = raster.look(raster.face, at + offset), raster.look(raster.face, at - offset)
    missing = ~face_in & raster.look(raster.below, at + offset)
    denied = face_out | missing | np.isin(edge, sorted(displaced))
    return float(np.mean(face_in & ~denied)), float(np.mean(denied))
