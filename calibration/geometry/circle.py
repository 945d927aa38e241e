"""Robust geometric circle fit in the plane, with the covariance of centre and radius."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import CircleFitError
from weldcal.calibration.geometry.robust import MAD, TUKEY, middle, solved
from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled

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
