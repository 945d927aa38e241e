"""Fits plane and both edges to a cloud that shows little but the flange; returns None where it does not."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import CircleFitError
from weldcal.calibration.flange.face import Face, FlangeFitConfig
from weldcal.calibration.flange.rim import plane_axes, sector_count
from weldcal.calibration.geometry.circle import CircleFit, refine_circles
from weldcal.calibration.geometry.plane import PlaneFit, weighted_moments
from weldcal.calibration.geometry.robust import MAD, TUKEY
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

Single = NDArray[np.float32]

_FEW = 1200  # points that find the plane and the outline; all of them then measure
_TRIPLES = 24
_ROUGH_SECTORS = 60
_HALF = 0.5  # of the outer edge; a lesser part is looked at carefully
_OWN_SHARE = 0.6  # of the points must lie on the one plane, and as many of the rim on the circle: else look carefully


def fit_segmented(points: Array, standard: FlangeStandard, config: FlangeFitConfig) -> Face | None:
    """Fit a flange face to points (N, 3) m that mostly lie on it; None where any test fails.

    Least median of planes on a seeded part, Tukey-weighted least squares on all; then the outermost and innermost point
    of each sector, and both circles at once. Deterministic for ``config.seed``. Points are held in single precision about
    their middle: to a tenth of a micrometre.
    """
    if len(points) < max(600, config.min_points):
        return None
    P = points.T.astype(np.float32, order="C")
    origin = P[:, :: max(1, len(points) // _FEW)].mean(axis=1)
    if not np.isfinite(origin.sum()):
        return None
    P -= origin[:, None]
    if not float((P.max(axis=1) - P.min(axis=1)).max()) < 2.0 * standard.outer_m:
        return None
    plane, d = _plane(P, origin, config)
    if plane is None or plane.n_inliers < _OWN_SHARE * P.shape[1] or plane.rms > 0.5 * config.hypothesis_tolerance_m:
        return None
    height = max(3.0 * plane.rms, 0.0002)
    axes = np.array(plane_axes(plane.normal))
    x, y = axes.astype(np.float32) @ P - (axes @ (plane.point - origin)).astype(np.float32)[:, None]
    thin = np.abs(d) < height
    rough = _outline(x, y, thin, standard, config)
    if rough is None:
        return None
    cx, cy, radius = rough
    dx, dy = x - np.float32(cx), y - np.float32(cy)
    rho2 = dx * dx + dy * dy
    rho2 += np.float32(1e3) * ~thin
    face_area = np.pi * (radius**2 - standard.face_inner_radius_m**2)
    inner, outer = (standard.face_inner_radius_m + 0.002) ** 2, (radius - 0.002) ** 2
    on_ring = int(np.count_nonzero((rho2 > inner) & (rho2 < outer)))
    if on_ring < config.min_points:
        return None
    pitch = float(np.sqrt(np.pi * (outer - inner) / on_ring))
    rims, radii = [], []
    width = 2.0 * pitch + 0.0012
    for r, outside in ((radius, True), (standard.face_inner_radius_m, False)):
        near = np.flatnonzero((rho2 > (r - width) ** 2) & (rho2 < (r + width) ** 2))
        rims.append(_extreme(dx[near], dy[near], rho2[near], sector_count(r, pitch), outside))
        radii.append(r)
    if min(len(r) for r in rims) < 24:
        return None
    try:
        fits = refine_circles(rims, radii, noise_floor=0.1 * pitch, settled=0.02 * pitch)
    except CircleFitError:
        return None
    outer_fit, bore = fits
    seen = _share(rims[0][outer_fit.inliers], sector_count(radius, pitch))
    core = 0.7 * standard.bore_radius_m
    filled = int(np.count_nonzero(rho2 < core**2)) / core**2
    density = on_ring * np.pi / face_area
    slack = max(config.radius_tolerance * standard.outer_radius_m, 1.5 * pitch)
    rough_limit = max(config.max_rim_rms_m, 0.7 * pitch)
    good = (
        standard.face_outer_radius_m - slack < outer_fit.radius < standard.outer_radius_m + slack
        and abs(bore.radius - standard.face_inner_radius_m) < slack + standard.chamfer_m
        and float(np.hypot(*(bore.center - outer_fit.center))) < 0.25 * slack + pitch
        and seen > max(config.min_coverage, _HALF)
        and outer_fit.rms < rough_limit
        and filled < 0.4 * density
        and min(float(f.inliers.mean()) for f in fits) > _OWN_SHARE
    )
    if not good:
        return None
    shift = np.array([cx, cy])
    moved = [CircleFit(f.center + shift, f.radius, f.covariance, f.rms, f.inliers) for f in fits]
    return Face(plane, moved[0], moved[1], seen, on_ring, seen + 1.0 - outer_fit.rms / rough_limit)


def _plane(P: Single, origin: Single, config: FlangeFitConfig) -> tuple[PlaneFit | None, Single]:
    """The plane that most of the points (3, N) about ``origin`` (3,) share, and their distance (N,) from it."""
    n = P.shape[1]
    Q = np.ascontiguousarray(P[:, :: max(1, n // _FEW)])
    pick = (_draws(config.seed) * Q.shape[1]).astype(np.intp)
    a, b, c = (Q[:, k] for k in pick)
    u, v = b - a, c - a
    normals = np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
    length = np.sqrt((normals * normals).sum(axis=0))
    normals = normals / np.maximum(length, 1e-12)
    off = np.abs(normals.T @ Q[:, ::2] - (normals * a).sum(axis=0)[:, None])
    votes = (off < config.hypothesis_tolerance_m).sum(axis=1) * (length > 1e-5)
    best = int(np.argmax(votes))
    normal, at = normals[:, best], a[:, best]
    scale = config.hypothesis_tolerance_m / TUKEY * 2.0
    points, values = Q, np.ones(3)
    for k in range(3):
        d = normal @ points - normal @ at
        if k:
            spread = np.abs(d if k < 2 else d[:: max(1, d.size // _FEW)])
            scale = max(MAD * float(np.partition(spread, len(spread) // 2)[len(spread) // 2]), 2e-5)
        share, at, moments = weighted_moments(points, d, TUKEY * scale)
        if not share > 0.3:
            return None, d
        values, vectors = np.linalg.eigh(moments)
        normal = vectors[:, 0].astype(np.float32)
        if k == 1:
            points = P
    if values[1] < 1e-12:
        return None, d
    exact = vectors[:, 0]
    d = normal @ P - normal @ at
    good = np.abs(d) < TUKEY * scale
    count = int(np.count_nonzero(good))
    inside = d * good
    rms = float(np.sqrt(inside @ inside / max(count, 1)))
    point = origin.astype(np.float64) + at
    if exact @ point > 0.0:
        exact = -exact
    sigma = rms / np.sqrt(max(count - 3, 1)) * float(np.sqrt(0.5 / values[1] + 0.5 / values[2]))
    return PlaneFit(point, exact, rms, count, sigma), d


@cache
def _draws(seed: int) -> Array:
    return np.random.default_rng(seed).random((3, _TRIPLES))


def _outline(
    x: Single, y: Single, thin: NDArray[np.bool_], standard: FlangeStandard, config: FlangeFitConfig
) -> tuple[float, float, float] | None:
    """Centre and radius of the outer edge from a part of the face's points, to a few tenths of a millimetre."""
    step = max(1, len(x) // _FEW)
    of_it = thin[::step]
    px, py = x[::step][of_it].astype(np.float64), y[::step][of_it].astype(np.float64)
    if len(px) < 100:
        return None
    cx, cy = float(px.mean()), float(py.mean())
    radius = standard.face_outer_radius_m
    for _ in range(2):
        dx, dy = px - cx, py - cy
        edge = _extreme(dx, dy, dx * dx + dy * dy, _ROUGH_SECTORS, True)
        if len(edge) < 0.4 * _ROUGH_SECTORS:
            return None
        w = np.ones(len(edge))
        A = np.ones((3, len(edge)))
        A[:2] = edge.T
        square = (A[:2] ** 2).sum(axis=0)
        for _step in range(3):  # Kasa's circle, reweighted
            weighted = A * w
            s = np.linalg.solve(weighted @ A.T, weighted @ square)
            c = 0.5 * s[:2]
            radius = float(np.sqrt(max(s[2] + c @ c, 0.0)))
            e = np.abs(np.sqrt(square - 2.0 * (c @ A[:2]) + c @ c) - radius)
            scale = max(float(np.partition(e, len(e) // 2)[len(e) // 2]), 2e-4)
            w = 1.0 / (1.0 + (e / (2.0 * scale)) ** 2) ** 2
        cx, cy = cx + float(c[0]), cy + float(c[1])
        if abs(radius - standard.face_outer_radius_m) > 0.1 * standard.outer_radius_m or scale > 0.002:
            return None
        if float(np.hypot(*c)) < 0.02 * radius:
            break  # the directions were right
    return cx, cy, radius


def _extreme(dx: Array | Single, dy: Array | Single, rho2: Array | Single, sectors: int, outer: bool) -> Array:
    """Outermost (or innermost) point (K, 2) of each sector about the origin."""
    sector = ((np.arctan2(dy, dx) + np.pi) * (sectors / (2.0 * np.pi))).astype(np.intp)
    best = np.full(sectors + 1, -np.inf, dtype=rho2.dtype)
    far = rho2 if outer else -rho2
    np.maximum.at(best, sector, far)
    last = np.flatnonzero(far == best[sector])
    return np.array([dx[last], dy[last]], dtype=np.float64).T


def _share(edge: Array, sectors: int) -> float:
    """Share of the directions in which an edge point (N, 2) lies, in sectors wide enough to hold two of them."""
    parts = min(72, max(12, sectors // 2))
    sector = ((np.arctan2(edge[:, 1], edge[:, 0]) + np.pi) * (parts / (2.0 * np.pi))).astype(np.intp) % parts
    return float(np.count_nonzero(np.bincount(sector, minlength=parts))) / parts
