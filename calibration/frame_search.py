"""The flange in an organised scan: flat parts of the right size on a thinned grid, then each one at full resolution."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.face import Face, FlangeFitConfig, Refusal
from weldcal.calibration.plane import local_planes
from weldcal.calibration.rim import plane_axes
from weldcal.calibration.window import measure_window
from weldcal.models.flanges import FlangeStandard

Array = NDArray[np.float64]

_ACROSS = 7.0  # thinned pixels across the flat ring: fewer do not keep it in one piece between its holes
_BEND_M = 2.5e-4  # least depth by which three neighbours must bend to be no plane, above the scan's own noise
_BEND_SIGMAS = (5.0, 3.5)  # of that noise's third; first the one that breaks no face, then the one that stops at less
_WIDEST = 3.0  # of the flange's diameter: a part that leaked onto its surroundings
_ROUND = 0.03  # of the flange's diameter: most of an outline lies so close to its circle
_MOST = 60  # parts that are looked at closely


@dataclass(frozen=True, eq=False)
class Part:
    """A flat part of about the flange's size: where its outer edge seems to be (centre (3,) m, radius m), the outward
    normal (3,), and how little its outline differs from that circle."""

    center: Array
    normal: Array
    radius: float
    misfit: float


def search_frame(cloud: Array, standard: FlangeStandard, config: FlangeFitConfig, refusal: Refusal) -> Face | None:
    """The best flange face in a scan (H, W, 3) m, NaN where nothing was measured; None with the reason noted."""
    pitches = typical_pitches(cloud)
    if pitches is None:
        refusal.note(0, "The cloud holds no valid point.")
        return None
    ring = standard.face_outer_radius_m - standard.face_inner_radius_m
    near, pitch = pitches
    widest = [max(1, int(ring / (_ACROSS * p))) for p in (near, pitch, 2.0 * pitch)]
    # coarse first; where a part leaks over a shallow step at one scale or threshold, it ends there at another
    scales = [(w, s) for s in _BEND_SIGMAS for w in sorted(set(widest), reverse=True)]
    tried: list[tuple[Array, float]] = []
    for step, sigmas in scales:
        best: Face | None = None
        for part in flat_parts(cloud[::step, ::step], standard, config, sigmas):
            if any(
                float(np.linalg.norm(part.center - c)) < 0.02 * standard.outer_m
                and abs(part.radius - r) < 0.02 * standard.outer_m
                for c, r in tried
            ):
                continue
            tried.append((part.center, part.radius))
            window = window_about(cloud, part.center, 0.62 * standard.outer_m + 3.0 * pitch, step)
            if window is None:
                continue
            face = measure_window(window, part.center, part.normal, part.radius, standard, config, refusal)
            if face is None:
                continue
            if best is None or face.quality > best.quality:
                best = face
            if face.coverage > 0.8 and face.bore is not None:
                return face
        if best is not None:
            return best
    refusal.note(0, f"No flat part of about {1e3 * standard.outer_m:.0f} mm across was found in the scan.")
    return None


def typical_pitches(cloud: Array) -> tuple[float, float] | None:
    """Distances (m) between neighbouring pixels on the nearest things and on nearer than middling ones; None where no two
    neighbours were measured. Quantiles (5 and 25 %) over a few thousand of them."""
    step = max(1, int(np.sqrt(cloud.shape[0] * cloud.shape[1] / 4000.0)))
    a, b = cloud[:-1:step, :-1:step], cloud[:-1:step, 1::step]
    h, w = min(a.shape[0], b.shape[0]), min(a.shape[1], b.shape[1])
    d = np.linalg.norm(a[:h, :w, :2] - b[:h, :w, :2], axis=-1)
    d = d[np.isfinite(d) & (d > 0.0)]
    if len(d) < 5:
        return None
    near, middle = np.quantile(d, [0.05, 0.25])
    return float(near), float(middle)


def window_about(cloud: Array, center: Array, radius: float, step: int) -> Array | None:
    """The part of a scan that holds all pixels within ``radius`` (m) of a centre (3,), found on every ``step``-th one."""
    thin = cloud[::step, ::step]
    with np.errstate(invalid="ignore"):
        near = np.abs(thin - center) < radius
    near = near[..., 0] & near[..., 1] & near[..., 2]
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    if len(rows) == 0:
        return None
    v = slice(max((int(rows[0]) - 1) * step, 0), (int(rows[-1]) + 2) * step)
    u = slice(max((int(columns[0]) - 1) * step, 0), (int(columns[-1]) + 2) * step)
    return cloud[v, u]


def flat_parts(
    grid: Array, standard: FlangeStandard, config: FlangeFitConfig, sigmas: float = _BEND_SIGMAS[0]
) -> Iterator[Part]:
    """Connected flat parts of a thinned scan (h, w, 3) whose size and outline could be the flange's, likeliest first.

    A plane seen in perspective has an inverse depth that is linear over the image: where its second differences
    vanish, pixels are flat, and parts of flat pixels end at every step and crease.
    """
    z = np.ascontiguousarray(grid[..., 2], dtype=np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.float32(1.0) / z
        bend_u = np.abs(inverse[1:-1, 2:] + inverse[1:-1, :-2] - 2.0 * inverse[1:-1, 1:-1])
        bend_v = np.abs(inverse[2:, 1:-1] + inverse[:-2, 1:-1] - 2.0 * inverse[1:-1, 1:-1])
        bend = np.maximum(bend_u, bend_v)
    known = bend[np.isfinite(bend)]
    if len(known) < 20:
        return
    few = known[:: max(1, len(known) // 4000)]
    # most of a scan is smooth: its lower third shows the noise, which is even in inverse depth for a triangulating scanner
    noise = float(np.partition(few, len(few) // 3)[len(few) // 3])
    with np.errstate(invalid="ignore"):
        flat = (bend < np.maximum(_BEND_M * np.square(inverse[1:-1, 1:-1]), sigmas * noise)).astype(np.uint8)
    _count, labels, stats, _centroids = cv2.connectedComponentsWithStats(flat, connectivity=4, ltype=cv2.CV_32S)
    size, area = stats[:, cv2.CC_STAT_WIDTH] * 1.0, stats[:, cv2.CC_STAT_AREA]
    size = np.hypot(size, stats[:, cv2.CC_STAT_HEIGHT])
    order = np.argsort(-area)
    parts = []
    looked = 0
    for k in order.tolist():
        if k == 0 or area[k] < 25:
            continue
        if looked == _MOST:
            break
        x, y, w, h = stats[k, :4].tolist()
        inside = labels[y : y + h, x : x + w] == k
        window = grid[y + 1 : y + 1 + h, x + 1 : x + 1 + w]
        if size[k] > 40 and not _about_the_size(window, inside, standard):
            continue
        looked += 1
        parts += _parts(window[inside], standard, config)
    yield from sorted(parts, key=lambda p: p.misfit)


def _about_the_size(window: Array, inside: NDArray[np.bool_], standard: FlangeStandard) -> bool:
    """Whether a part's extent, judged from a few of its rows and columns, is of the flange's order."""
    v, u = np.nonzero(inside[:: max(1, inside.shape[0] // 16), :: max(1, inside.shape[1] // 16)])
    if len(v) < 4:
        return True
    p = window[:: max(1, inside.shape[0] // 16), :: max(1, inside.shape[1] // 16)][v, u]
    extent = float(np.linalg.norm(p.max(axis=0) - p.min(axis=0)))
    return 0.5 * standard.outer_m < extent < _WIDEST * standard.outer_m


def _parts(points: Array, standard: FlangeStandard, config: FlangeFitConfig) -> list[Part]:
    """The part as it is, or the planes it consists of where it leaked over a shallow step onto another."""
    extent = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
    if not 0.55 * standard.outer_m < extent < _WIDEST * standard.outer_m:
        return []
    whole, rms = _part(points, standard, config)
    if rms < config.hypothesis_tolerance_m:
        return [] if whole is None else [whole]
    out = []
    for p, n, support in local_planes(
        points, reach=0.9 * standard.outer_m, tolerance=config.hypothesis_tolerance_m, seed=config.seed, hypotheses=60,
        keep=3, sample=300,
    ):  # fmt: skip
        if support < 12:
            break
        on = points[np.abs((points - p) @ n) < 2.0 * config.hypothesis_tolerance_m]
        on = on[((on - np.median(on, axis=0)) ** 2).sum(axis=1) < standard.outer_m**2]
        part = _part(on, standard, config)[0] if len(on) > 20 else None
        if part is not None:
            out.append(part)
    return out


def _part(points: Array, standard: FlangeStandard, config: FlangeFitConfig) -> tuple[Part | None, float]:
    """Plane and outline of points (N, 3), None where they could not be a flange's, and the rms from the plane, m."""
    middle = points.mean(axis=0)
    d = points - middle
    values, vectors = np.linalg.eigh(d.T @ d / len(d))
    rms = float(np.sqrt(max(values[0], 0.0)))
    normal = vectors[:, 0] if float(vectors[:, 0] @ middle) < 0.0 else -vectors[:, 0]
    if rms > max(3.0 * config.hypothesis_tolerance_m, 0.02 * standard.outer_m):
        return None, rms
    axes = np.column_stack(plane_axes(normal))
    xy = d @ axes
    pitch = float(np.sqrt(np.pi * 2.0 * np.sqrt(values[1] * values[2]) / len(d)))
    hull = cv2.convexHull(xy.astype(np.float32))[:, 0].astype(np.float64)
    slack = config.radius_tolerance * standard.outer_radius_m + pitch
    # the flat pixels end a thinned pixel before the edge
    found = _hull_circle(hull, (standard.face_outer_radius_m - pitch - slack, standard.outer_radius_m - pitch + slack))
    if found is None or found[2] > _ROUND * standard.outer_m:
        return None, rms
    center, radius, misfit = found
    return Part(middle + axes @ center, normal, radius + pitch, misfit / standard.outer_m), rms


def _hull_circle(hull: Array, bounds: tuple[float, float]) -> tuple[Array, float, float] | None:
    """A circle through most of a convex outline (N, 2) with a radius within ``bounds`` (m): centre, radius, misfit (m)."""
    if len(hull) < 6:
        return None
    n = len(hull)
    # every triple of about a dozen corners, spread over the outline
    some = hull[np.unique(np.linspace(0, n - 1, 14).round().astype(int))]
    m = len(some)
    i, j, k = (t.ravel() for t in np.meshgrid(*[np.arange(m)] * 3, indexing="ij"))
    keep = (i < j) & (j < k)
    a, b, c = some[i[keep]], some[j[keep]], some[k[keep]]
    ab, ac = b - a, c - a
    det = 2.0 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    n1, n2 = (ab**2).sum(axis=1), (ac**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.column_stack([ac[:, 1] * n1 - ab[:, 1] * n2, ab[:, 0] * n2 - ac[:, 0] * n1]) / det[:, None]
        radii = np.hypot(u[:, 0], u[:, 1])
        good = (radii > bounds[0]) & (radii < bounds[1])
    if not good.any():
        return None
    centers, radii = (a + u)[good], radii[good]
    d = hull[None] - centers[:, None]
    e = np.abs(np.sqrt((d * d).sum(axis=2)) - radii[:, None])
    # a straight cut leaves few corners of the outline, an arc many
    h = max(int(0.7 * n), 5) - 1
    value = np.partition(e, h, axis=1)[:, h]
    best = int(np.argmin(value))
    return centers[best], float(radii[best]), float(value[best])
