"""Fit planes and circles to noisy points, robustly, with the covariance of what is found."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from weldcal.calibration.errors import CircleFitError, PlaneFitError
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


_STEPS = 7  # of Gauss-Newton in the compiled fit


@dataclass(frozen=True)
class CircleFit:
    """A fitted circle: centre (2,) and radius in m, covariance (3, 3) of (cx, cy, r) in m^2, rms m, inliers (N,)."""

    center: Array
    radius: float
    covariance: Array
    rms: float
    inliers: NDArray[np.bool_]


def fit_circle(
    points: Array,
    *,
    sigma: Array | None = None,
    radius: float | None = None,
    radius_bounds: tuple[float, float] | None = None,
    initial: tuple[Array, float] | None = None,
    noise_floor: float = 1e-6,
    hypotheses: int = 200,
    seed: int = 0,
) -> CircleFit:
    """Fit a circle to (N, 2) points [m] by minimising the orthogonal distance, resisting up to 40 % outliers.

    ``sigma`` (N,) are relative standard deviations of the points along the radius; the common scale is estimated from
    the residuals. ``radius`` fixes the radius, ``radius_bounds`` limits the search for a start. ``initial`` is a start
    (centre, radius) that makes the random search unnecessary. ``noise_floor`` [m] is the least scale believed. Raises
    CircleFitError when there are fewer than 5 points or they do not fix a circle. Method: least median of squares on
    seeded triples, then Gauss-Newton on the geometric residual with Tukey weights.
    """
    p = np.asarray(points, dtype=float)
    if p.ndim != 2 or p.shape[1] != 2 or len(p) < 5:
        raise CircleFitError(f"A circle needs at least 5 points in the plane; {len(p)} were given.")
    if not np.isfinite(p).all():
        raise CircleFitError("The points of a circle must be finite numbers; remove NaN before fitting.")
    s = np.ones(len(p)) if sigma is None else np.asarray(sigma, dtype=float)
    s = s / np.median(s)
    origin = np.median(p, axis=0)
    q = p - origin
    c, r = (
        _start(q, s, radius, radius_bounds, hypotheses, seed) if initial is None else (initial[0] - origin, initial[1])
    )
    r = radius if radius is not None else r
    free = 3 if radius is None else 2
    weight = np.ones(len(q))
    scale = noise_floor
    for _ in range(30):
        d = q - c
        rho = np.maximum(np.linalg.norm(d, axis=1), 1e-12)
        e = (rho - r) / s
        scale = max(MAD * float(np.median(np.abs(e))), noise_floor)
        t = e / (TUKEY * scale)
        weight = np.where(np.abs(t) < 1.0, (1.0 - t**2) ** 2, 0.0)
        J = -np.column_stack([d / rho[:, None], np.ones(len(q))])[:, :free] / s[:, None]
        N = J.T @ (weight[:, None] * J)
        values = np.linalg.eigvalsh(N)
        if not values[0] > 1e-9 * values[-1]:
            raise CircleFitError("The points do not fix a circle: they cover too short an arc.")
        step = np.linalg.solve(N, -J.T @ (weight * e))
        c = c + step[:2]
        r = r + (float(step[2]) if free == 3 else 0.0)
        if float(np.linalg.norm(step)) < 1e-3 * noise_floor + 1e-10:
            break
    d = q - c
    rho = np.maximum(np.linalg.norm(d, axis=1), 1e-12)
    e = (rho - r) / s
    inliers = np.abs(e) < TUKEY * scale
    used = int(inliers.sum())
    if used < max(5, free + 2) or not np.isfinite(e).all() or r <= 0:
        raise CircleFitError("No circle agrees with enough of the points.")
    return CircleFit(
        c + origin,
        float(r),
        _covariance(d, rho, e, s, scale, free),
        float(np.sqrt(np.mean((e * s)[inliers] ** 2))),
        inliers,
    )


def refine_circles(
    edges: Sequence[Array | NDArray[np.float32]],
    radii: Sequence[float],
    *,
    noise_floor: float,
    settled: float | None = None,
    fixed: NDArray[np.bool_] | None = None,
) -> list[CircleFit]:
    """Refine circles about the origin of their points (N_k, 2) [m] from radii [m] that are right to about a millimetre.

    Steps below ``settled`` [m], else a hundredth of ``noise_floor``, end it. The radii of ``fixed`` ones stay.
    """
    settled = 1e-2 * noise_floor if settled is None else settled
    out = []
    for k, (edge, radius) in enumerate(zip(edges, radii, strict=True)):
        x, y = np.ascontiguousarray(edge.T, dtype=float)
        free = 2 if fixed is not None and fixed[k] else 3
        fixes, theta, information, variance, rms, inliers = circle_steps(x, y, radius, free, noise_floor, settled)
        if not fixes:
            raise CircleFitError("The points do not fix a circle: they cover too short an arc.")
        if not np.isfinite(theta).all():
            raise CircleFitError("No circle agrees with enough of the points.")
        covariance = np.zeros((3, 3))
        covariance[:free, :free] = variance * np.linalg.inv(information[:free, :free])
        out.append(CircleFit(theta[:2], float(theta[2]), covariance, rms, inliers))
    return out


@compiled()
def circle_steps(
    x: Array, y: Array, radius: float, free: int, noise_floor: float, settled: float
) -> tuple[bool, Array, Array, float, float, NDArray[np.bool_]]:
    """Gauss-Newton with Tukey's weights for one circle about the origin of its points x, y (N,) m.

    ``free`` is 2 where the radius is known, else 3.

    The scale is the one of the third step. Returns whether the points fix a circle, (cx, cy, r), the information J^T J
    (3, 3), the variance of psi over its mean slope squared, the rms of the inliers, and which those are (N,).
    """
    n = len(x)
    theta, new = np.zeros(3), np.array([0.0, 0.0, radius])
    e, t2, size, inliers = np.empty(n), np.empty(n), np.empty(n), np.zeros(n, np.bool_)
    scale = noise_floor
    for step in range(_STEPS):
        for j in range(3):
            theta[j] = new[j]
        for i in range(n):
            dx, dy = x[i] - theta[0], y[i] - theta[1]
            e[i] = np.sqrt(dx * dx + dy * dy) + 1e-15 - theta[2]
            size[i] = abs(e[i])
        if step < 3:
            scale = max(MAD * middle(size), noise_floor)
        k = 1.0 / (TUKEY * scale)
        N, g = np.zeros((3, 3)), np.zeros(3)
        for i in range(n):
            t2[i] = (e[i] * k) ** 2
            inside = max(1.0 - t2[i], 0.0)
            w = inside * inside
            rho = e[i] + theta[2]
            a, b = (x[i] - theta[0]) / rho, (y[i] - theta[1]) / rho
            N[0, 0] += w * a * a
            N[1, 0] += w * a * b
            N[1, 1] += w * b * b
            N[2, 0] += w * a
            N[2, 1] += w * b
            N[2, 2] += w
            g[0] += w * a * e[i]
            g[1] += w * b * e[i]
            g[2] += w * e[i]
        ok, change = solved(N, g, free)
        if not ok:
            return False, theta, N, 0.0, 0.0, inliers
        for j in range(3):
            new[j] = theta[j] + change[j]
        if step > 2 and max(abs(change[0]), abs(change[1]), abs(change[2])) < settled:
            break
    psi2 = slope = squares = 0.0
    count = 0
    N = np.zeros((3, 3))
    for i in range(n):
        rho = e[i] + theta[2]
        a, b = (x[i] - theta[0]) / rho, (y[i] - theta[1]) / rho
        N[0, 0] += a * a
        N[1, 0] += a * b
        N[1, 1] += b * b
        N[2, 0] += a
        N[2, 1] += b
        inside = 1.0 - t2[i]
        if inside > 0.0:
            inliers[i] = True
            psi2 += (e[i] * inside * inside) ** 2
            slope += inside * (1.0 - 5.0 * t2[i])
            squares += e[i] * e[i]
            count += 1
    N[0, 1], N[0, 2], N[1, 2], N[2, 2] = N[1, 0], N[2, 0], N[2, 1], float(n)
    variance = psi2 / max(n - 3, 1) / max(slope / n, 0.2) ** 2
    return True, new, N, variance, np.sqrt(squares / max(count, 1)), inliers


def _covariance(d: Array, rho: Array, e: Array, s: Array, scale: float, free: int) -> Array:
    """Sandwich covariance of an M-estimate (Huber 1981, eq. 7.6.2) with Tukey's psi.

    (3, 3), zero row for a fixed radius.
    """
    t = e / (TUKEY * scale)
    inside = np.abs(t) < 1.0
    psi = np.where(inside, e * (1.0 - t**2) ** 2, 0.0)
    dpsi = np.where(inside, (1.0 - t**2) * (1.0 - 5.0 * t**2), 0.0)
    J = np.column_stack([d / rho[:, None], np.ones(len(d))])[:, :free] / s[:, None]
    n = len(d)
    mean_dpsi = max(float(dpsi.mean()), 0.2)
    variance = float(psi @ psi) / max(n - free, 1) / mean_dpsi**2
    full = np.zeros((3, 3))
    full[:free, :free] = variance * np.linalg.inv(J.T @ J)
    return full


def _start(
    q: Array, s: Array, radius: float | None, bounds: tuple[float, float] | None, hypotheses: int, seed: int
) -> tuple[Array, float]:
    """Best of seeded triples by the least 60th percentile of the residual."""
    rng = np.random.default_rng(seed)
    index = rng.integers(0, len(q), size=(hypotheses, 3))
    a, b, c = q[index[:, 0]], q[index[:, 1]], q[index[:, 2]]
    ab, ac = b - a, c - a
    det = 2.0 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    extent = float(np.ptp(q, axis=0).max())
    ok = np.abs(det) > 1e-3 * extent**2
    ab, ac, a, det = ab[ok], ac[ok], a[ok], det[ok]
    n1, n2 = (ab**2).sum(axis=1), (ac**2).sum(axis=1)
    u = np.column_stack([ac[:, 1] * n1 - ab[:, 1] * n2, ab[:, 0] * n2 - ac[:, 0] * n1]) / det[:, None]
    centers, radii = a + u, np.linalg.norm(u, axis=1)
    if radius is not None:
        bounds = (0.8 * radius, 1.25 * radius)
    if bounds is not None:
        keep = (radii > bounds[0]) & (radii < bounds[1])
        centers, radii = centers[keep], radii[keep]
    if len(radii) == 0:
        raise CircleFitError("The points do not fix a circle of the expected radius.")
    sample = q if len(q) <= 600 else q[np.linspace(0, len(q) - 1, 600).astype(int)]
    sigma = s if len(q) <= 600 else s[np.linspace(0, len(q) - 1, 600).astype(int)]
    error = np.abs(np.linalg.norm(sample[None] - centers[:, None], axis=2) - radii[:, None]) / sigma
    k = int(0.6 * error.shape[1])
    best = int(np.argmin(np.partition(error, k, axis=1)[:, k]))
    return centers[best], float(radii[best])


def fuse(centers: list[Array], covariances: list[Array]) -> tuple[Array, Array]:
    """Covariance-weighted mean of concentric centres (k of (m,), (m, m)); inflated where they disagree beyond chance.

    Returns the fused centre (m,) and its covariance (m, m). The inflation is the Birge ratio (reduced chi-square, never
    below one): rims that are not concentric widen the covariance.
    """
    information = np.linalg.inv(np.array(covariances))
    total = np.linalg.inv(information.sum(axis=0))
    at = np.array(centers)
    mean = total @ (information @ at[:, :, None]).sum(axis=0)[:, 0]
    dof = (len(centers) - 1) * len(mean)
    if dof == 0:
        return mean, total
    off = at - mean
    chi2 = float(np.einsum("ki,kij,kj->", off, information, off))
    return mean, total * max(1.0, chi2 / dof)
