"""Robust plane fit: local seeded hypotheses, then Tukey-weighted least squares."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from weldcal.calibration.errors import PlaneFitError

Array = NDArray[np.float64]

_TUKEY = 4.685
_MAD = 1.4826
_FEW = 1200  # points that find the plane, before all of them make it precise


@dataclass(frozen=True)
class PlaneFit:
    """A plane: a point on it (3,) m, unit normal (3,), rms of the inliers m, their number, sigma of the normal rad."""

    point: Array
    normal: Array
    rms: float
    n_inliers: int
    normal_sigma: float


def fit_plane(points: Array, start: tuple[Array, Array], *, tolerance: float, noise_floor: float = 2e-5) -> PlaneFit:
    """Refine a plane (point, normal) on (N, 3) points [m]; only those within ``tolerance`` [m] of the start take part.

    Raises PlaneFitError when fewer than 10 points remain or they lie on a line.
    """
    p0, n = start
    distance = points @ n - float(p0 @ n)
    use = points[np.abs(distance) < tolerance]
    if len(use) < 10:
        raise PlaneFitError("Fewer than 10 points lie near the plane.")
    # about the centroid: raw coordinates 0.5 m away would cost digits in the scatter matrix
    origin = use[:: max(1, len(use) // _FEW)].mean(axis=0)
    everything = np.ascontiguousarray(use.T) - origin[:, None]
    q = np.ascontiguousarray(everything[:, :: max(1, len(use) // _FEW)])
    at = np.zeros(3)
    values, scale = np.ones(3), tolerance
    for k in range(10):
        d = n @ q - float(n @ at)
        if k:
            few = np.abs(d[:: max(1, len(d) // _FEW)])
            scale = max(_MAD * float(np.partition(few, len(few) // 2)[len(few) // 2]), noise_floor)
            t = d * (1.0 / (_TUKEY * scale))
            w = np.maximum(1.0 - t * t, 0.0)
            w *= w
        else:
            w = np.ones(q.shape[1])
        total = float(w.sum())
        if total < 5.0:
            raise PlaneFitError("Too few points agree on a plane.")
        weighted = q * w
        at = weighted.sum(axis=1) / total
        values, vectors = np.linalg.eigh(weighted @ q.T / total - at[:, None] * at)
        if values[1] < 1e-12:
            raise PlaneFitError("The points lie on a line.")
        previous, n = n, vectors[:, 0] * (np.sign(vectors[:, 0] @ n) or 1.0)
        settled = k > 1 and float(np.abs(n - previous).max()) < 3e-5
        if settled and q is everything:
            break
        if settled or k == 4:
            q = everything  # a part of the points found the plane; all of them make it precise
    d = n @ everything - float(n @ at)
    inside = np.abs(d) < _TUKEY * scale
    count = int(np.count_nonzero(inside))
    rms = float(np.sqrt((d * d * inside).sum() / max(count, 1)))
    normal_sigma = rms / np.sqrt(max(count - 3, 1)) * float(np.sqrt(0.5 / values[1] + 0.5 / values[2]))
    return PlaneFit(origin + at, n, rms, count, normal_sigma)


def shared_noise(e: Array, good: NDArray[np.bool_], at: NDArray[np.intp], shape: tuple[int, int]) -> float:
    """How many readings of a grid tell only as much as one, because neighbours share their noise; at least 1.

    ``e`` (N,) are residuals at the flat indices ``at`` (N,) of an image of that ``shape``, 0 where not ``good`` (N,). The
    variance of sums over blocks of 10 x 10 pixels over what independent readings would have.
    """
    image = np.zeros((2, shape[0] * shape[1]), dtype=np.float32)
    image[0, at], image[1, at] = e, good
    total, number = (cv2.boxFilter(a.reshape(shape), -1, (10, 10), normalize=False)[5::10, 5::10] for a in image)
    expected = float(e @ e) * float(number.sum()) / max(int(np.count_nonzero(good)), 1)
    return max(float((total * total).sum()) / max(expected, 1e-30), 1.0)


def local_planes(
    points: Array, *, reach: float, tolerance: float, seed: int, hypotheses: int = 160, keep: int = 8, sample: int = 600
) -> list[tuple[Array, Array, int]]:
    """Distinct plane hypotheses (seed point (3,), unit normal (3,), score) in a cloud (N, 3) m, best supported first.

    The three points of a hypothesis lie within ``reach`` of each other and only support within ``reach`` counts: a
    small face is not drowned by a large table. Deterministic for a seed.
    """
    rng = np.random.default_rng(seed)
    cloud = points if len(points) <= sample else points[rng.choice(len(points), sample, replace=False)]
    n = len(cloud)
    if n < 12:
        return []
    i = rng.integers(0, n, hypotheses)
    half = hypotheses // 2
    tree = cKDTree(cloud)
    pick = np.empty((hypotheses, 2), dtype=int)
    # close triples stay on a small face; wide ones stand noise better
    for rows, share in ((slice(0, half), 0.03), (slice(half, hypotheses), 0.15)):
        k = max(12, min(n, int(share * n)))
        neighbours = np.asarray(tree.query(cloud[i[rows]], k=k)[1])
        column = rng.integers(1, k, size=(len(neighbours), 2))
        pick[rows] = np.take_along_axis(neighbours, column, axis=1)
    a, b, c = cloud[i], cloud[pick[:, 0]], cloud[pick[:, 1]]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    ok = length > 1e-4 * reach**2
    if not ok.any():
        return []
    normal, a = normal[ok] / length[ok, None], a[ok]
    center = cloud.mean(axis=0)
    x, s = cloud - center, a - center
    near = (x**2).sum(axis=1) - 2.0 * s @ x.T < reach**2 - (s**2).sum(axis=1)[:, None]
    distance = np.abs(normal @ x.T - (normal * s).sum(axis=1)[:, None])
    score = (near & (distance < tolerance)).sum(axis=1)
    chosen: list[tuple[Array, Array, int]] = []
    for h in np.argsort(-score, kind="stable"):
        # a hypothesis of three points leans by a degree or so: allow for it over the distance
        same = any(
            abs(float(m @ normal[h])) > 0.985
            and abs(float((a[h] - q) @ m)) < 2.0 * tolerance + 0.03 * float(np.linalg.norm(a[h] - q)) < reach
            for q, m, _ in chosen
        )
        if not same:
            chosen.append((a[h], normal[h], int(score[h])))
        if len(chosen) == keep:
            break
    return chosen
