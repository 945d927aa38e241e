"""Robust plane fits: seeded local hypotheses, Tukey-weighted least squares, and compiled fits for many points."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from weldcal.calibration.errors import PlaneFitError
from weldcal.calibration.geometry.robust import MAD, TUKEY, middle, solved
from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled

Single = NDArray[np.float32]

_FEW = 1200  # points that find the plane, before all of them make it precise
_FEW_COMPILED = 600  # the same in the compiled fit
_ONE = np.float32(1.0)


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
            scale = max(MAD * float(np.partition(few, len(few) // 2)[len(few) // 2]), noise_floor)
            t = d * (1.0 / (TUKEY * scale))
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
    inside = np.abs(d) < TUKEY * scale
    count = int(np.count_nonzero(inside))
    rms = float(np.sqrt((d * d * inside).sum() / max(count, 1)))
    normal_sigma = rms / np.sqrt(max(count - 3, 1)) * float(np.sqrt(0.5 / values[1] + 0.5 / values[2]))
    return PlaneFit(origin + at, n, rms, count, normal_sigma)


@compiled()
def plane_steps(p: Array, tolerance: float) -> tuple[bool, Array, Array, float, Array]:
    """Fit the plane height = a + b x + c y to points (3, N) m with Tukey weights, starting at the median height.

    Returns whether more than three points in ten agree, (a, b, c), the moments (3, 3) of (1, x, y) with those weights,
    the residual beyond which a point says nothing and all residuals (N,).
    """
    n = p.shape[1]
    few = max(1, n // _FEW_COMPILED)
    size = np.empty((n + few - 1) // few)
    for i in range(len(size)):
        size[i] = p[2, i * few]
    fit = np.array([middle(size), 0.0, 0.0])
    limit = 2.0 * tolerance
    M, e = np.zeros((3, 3)), np.empty(n)
    for step in range(4):
        stride = few if step < 2 else 1
        used = 0
        for i in range(0, n, stride):
            e[used] = p[2, i] - (fit[0] + fit[1] * p[0, i] + fit[2] * p[1, i])
            used += 1
        if step:
            skip = max(1, used // _FEW_COMPILED)
            m = 0
            for i in range(0, used, skip):
                if m < len(size):
                    size[m] = abs(e[i])
                    m += 1
            limit = TUKEY * max(MAD * middle(size[:m]), 2e-5)
        k = 1.0 / limit
        M, g = np.zeros((3, 3)), np.zeros(3)
        for j in range(used):
            i = j * stride
            inside = max(1.0 - (e[j] * k) ** 2, 0.0)
            wt = inside * inside
            x, y, d = p[0, i], p[1, i], p[2, i]
            wx, wy = wt * x, wt * y
            M[0, 0] += wt
            M[1, 0] += wx
            M[2, 0] += wy
            M[1, 1] += wx * x
            M[2, 1] += wx * y
            M[2, 2] += wy * y
            g[0] += wt * d
            g[1] += wx * d
            g[2] += wy * d
        M[0, 1], M[0, 2], M[1, 2] = M[1, 0], M[2, 0], M[2, 1]
        if not M[0, 0] > 0.3 * used:
            return False, fit, M, limit, e
        ok, fit = solved(M, g, 3)
        if not ok:
            return False, fit, M, limit, e
    for i in range(n):
        e[i] = p[2, i] - (fit[0] + fit[1] * p[0, i] + fit[2] * p[1, i])
    return True, fit, M, limit, e


def shared_noise(e: Array, good: NDArray[np.bool_], at: NDArray[np.intp], shape: tuple[int, int]) -> float:
    """Number of grid readings per independent one, from the noise that neighbours share; at least 1.

    ``e`` (N,) are residuals at the flat indices ``at`` (N,) of an image of that ``shape``, 0 where not ``good`` (N,).
    The variance of sums over blocks of 10 x 10 pixels over what independent readings would have.
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
