"""Searches an organised scan for the flange: flat parts on a thinned grid, then a fit at full resolution."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.flange.face import FaceRefusal, FlangeFace, FlangeFitConfig, plane_axes
from weldcal.calibration.flange.window import measure_window
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

_Noise = Literal["of all", "by depth", "smoothed"]

_ACROSS = 7.0  # thinned pixels across the flat ring: fewer do not keep it in one piece between its holes
_BEND_M = 2.5e-4  # least depth by which three neighbours must bend to be no plane, above the scan's own noise
_BEND_SIGMAS = (5.0, 3.5)  # of that noise's third; first the one that breaks no face, then the one that stops at less
_LAYERS, _LAYER_PIXELS, _LAYER_LEAST = 8.0, 40_000, 30  # an eighth of the depth, of so many pixels, with its own noise
_WIDEST = 3.0  # of the flange's diameter: a part that leaked onto its surroundings
_ROUND = 0.03  # of the flange's diameter: most of an outline lies so close to its circle
_VERY_ROUND = 0.012  # such a part is tried before the rest is looked at
_TRIPLES = 40
_MOST = 60  # parts that are looked at closely


@dataclass(frozen=True, eq=False)
class FlatPart:
    """A flat part of about the flange's size.

    Where its outer edge seems to be (centre (3,) m, radius m), the outward normal (3,), and how little its outline
    differs from that circle.
    """

    center: Array
    normal: Array
    radius: float
    misfit: float


def search_frame(
    cloud: Array,
    standard: FlangeStandard,
    config: FlangeFitConfig,
    refusal: FaceRefusal,
    measured: NDArray[np.bool_] | None = None,
) -> FlangeFace | None:
    """Return the best flange face in a scan (H, W, 3) m, NaN where nothing was measured; None with the reason noted.

    Of a thinned scan, whose missing pixels are interpolated, ``measured`` (H, W) says which were not.
    """
    pitches = typical_pitches(cloud)
    if pitches is None:
        refusal.note(0, "The cloud holds no valid point.")
        return None
    ring = standard.face_outer_radius_m - standard.face_inner_radius_m
    down = typical_pitches(np.swapaxes(cloud, 0, 1)) or pitches
    across, along = pitches[1] / max(pitches[1], down[1]), down[1] / max(pitches[1], down[1])
    near, pitch = max(pitches[0], down[0]), max(pitches[1], down[1])
    widest = [max(1, int(ring / (_ACROSS * p))) for p in (near, pitch, 2.0 * pitch)]
    # coarse first; where a part leaks over a shallow step at one scale or threshold, it ends there at another
    sizes = sorted(set(widest), reverse=True)
    noises: tuple[_Noise, ...] = ("of all", "by depth")
    scales = [(w, s, n) for n in noises for s in _BEND_SIGMAS for w in sizes]
    scales += [(w, _BEND_SIGMAS[0], "smoothed") for w in sizes]
    tried: list[tuple[Array, float]] = []
    for wide, sigmas, noise in scales:
        best: FlangeFace | None = None
        step = (round(wide / along), round(wide / across))
        for part in flat_parts(cloud[:: step[0], :: step[1]], standard, config, sigmas, noise):
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
            known = None if measured is None else measured[window]
            face = measure_window(
                cloud[window], part.center, part.normal, part.radius, standard, config, refusal, known
            )
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
    """Distances (m) between neighbouring pixels on the nearest things and on nearer than middling ones.

    None where no two neighbours were measured. Quantiles (1 and 25 %) over a few thousand of them.
    """
    step = max(1, int(np.sqrt(cloud.shape[0] * cloud.shape[1] / 4000.0)))
    a, b = cloud[:-1:step, :-1:step], cloud[:-1:step, 1::step]
    h, w = min(a.shape[0], b.shape[0]), min(a.shape[1], b.shape[1])
    d = np.linalg.norm(a[:h, :w, :2] - b[:h, :w, :2], axis=-1)
    d = d[np.isfinite(d) & (d > 0.0)]
    if len(d) < 5:
        return None
    near, middle = np.quantile(d, [0.01, 0.25])
    return float(near), float(middle)


def window_about(cloud: Array, center: Array, radius: float, step: int | tuple[int, int]) -> tuple[slice, slice] | None:
    """Find the rows and columns of a scan that hold all pixels within ``radius`` (m) of a centre (3,).

    Pixels are looked at on every ``step``-th row and column, or on every so many.
    """
    sv, su = (step, step) if isinstance(step, int) else step
    thin = cloud[::sv, ::su]
    with np.errstate(invalid="ignore"):
        near = np.abs(thin - center) < radius
    near = near[..., 0] & near[..., 1] & near[..., 2]
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    if len(rows) == 0:
        return None
    v = slice(max((int(rows[0]) - 1) * sv, 0), (int(rows[-1]) + 2) * sv)
    u = slice(max((int(columns[0]) - 1) * su, 0), (int(columns[-1]) + 2) * su)
    return v, u


def flat_parts(
    grid: Array,
    standard: FlangeStandard,
    config: FlangeFitConfig,
    sigmas: float = _BEND_SIGMAS[0],
    noise: _Noise = "of all",
) -> Iterator[FlatPart]:
    """Connected flat parts of a thinned scan (h, w, 3) whose size and outline could be the flange's, most likely first.

    A plane seen in perspective has an inverse depth that is linear over the image: where its second differences
    vanish, pixels are flat, and parts of flat pixels end at every step and crease.
    """
    z = np.ascontiguousarray(grid[..., 2], dtype=np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.float32(1.0) / z
        if noise == "smoothed":  # noise hides the crease between a face and the wall below it
            inverse = np.asarray(cv2.blur(inverse, (3, 3)), dtype=np.float32)
        bend_u = np.abs(inverse[1:-1, 2:] + inverse[1:-1, :-2] - 2.0 * inverse[1:-1, 1:-1])
        bend_v = np.abs(inverse[2:, 1:-1] + inverse[:-2, 1:-1] - 2.0 * inverse[1:-1, 1:-1])
        bend = np.maximum(bend_u, bend_v)
    if np.count_nonzero(np.isfinite(bend)) < 20:
        return
    sigma = _noise(bend, inverse[1:-1, 1:-1], by_depth=noise != "of all")
    with np.errstate(invalid="ignore"):
        flat = (bend < np.maximum(_BEND_M * np.square(inverse[1:-1, 1:-1]), sigmas * sigma)).astype(np.uint8)
    _count, labels, stats, _centroids = cv2.connectedComponentsWithStats(flat, connectivity=4, ltype=cv2.CV_32S)
    parts: list[FlatPart] = []
    for k in _likeliest(labels, stats, z, grid, standard):
        x, y, w, h = stats[k, :4].tolist()
        inside = labels[y : y + h, x : x + w] == k
        for part in _parts(grid[y + 1 : y + 1 + h, x + 1 : x + 1 + w][inside], standard, config):
            if part.misfit < _VERY_ROUND:
                yield part
            else:
                parts.append(part)
    yield from sorted(parts, key=lambda p: p.misfit)


def _noise(bend: NDArray[np.float32], inverse: NDArray[np.float32], *, by_depth: bool) -> NDArray[np.float32]:
    """Noise (h, w) of the bend at each pixel.

    What the lower third of all pixels, or of those of about its depth, shows, most of a scan being smooth. A floor far
    behind the flange may have another noise in inverse depth than the flange.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        layer = np.rint(_LAYERS * np.log(np.abs(inverse)))
    known = np.isfinite(bend) & np.isfinite(layer)
    layer = np.where(known, layer - layer[known].min(), 0.0).astype(np.intp)
    at = np.flatnonzero(known)[:: max(1, np.count_nonzero(known) // _LAYER_PIXELS)]
    value, of = bend.ravel()[at], layer.ravel()[at]
    whole = np.partition(value, len(value) // 3)[len(value) // 3]
    table = np.full(int(layer.max()) + 1, whole, dtype=np.float32)
    for k in np.unique(of) if by_depth else ():
        mine = value[of == k]
        if len(mine) >= _LAYER_LEAST:
            table[k] = np.partition(mine, len(mine) // 3)[len(mine) // 3]
    return np.asarray(table[layer])


def _likeliest(
    labels: NDArray[np.int32], stats: NDArray[np.int32], z: NDArray[np.float32], grid: Array, standard: FlangeStandard
) -> list[int]:
    """Labels of the parts whose box in the image could hold the flange, the most flange-like box first."""
    some = grid[:: max(1, z.shape[0] // 24), :: max(1, z.shape[1] // 24)]
    ray = some[..., :2] / some[..., 2:]
    known = np.isfinite(ray[..., 0])
    if int(known.sum()) < 3:
        return []
    # metres per pixel and metre of depth, along each axis of the image
    v, u = (k * max(1, n // 24) for k, n in zip(np.nonzero(known), z.shape, strict=True))
    c = np.linalg.lstsq(np.column_stack([np.ones(len(u)), u, v]), ray[known], rcond=None)[0]
    per_u, per_v = np.hypot(c[1:, 0], c[1:, 1])
    count = len(stats)
    first = np.full(count, -1)
    flat = labels.ravel()
    step = max(1, flat.size // 20000)
    first[flat[::step]] = np.arange(0, flat.size, step)
    first[0] = -1
    rows, columns = np.divmod(np.maximum(first, 0), labels.shape[1])
    depth = z[rows + 1, columns + 1].astype(float)
    diagonal = np.hypot(stats[:, cv2.CC_STAT_WIDTH] * per_u, stats[:, cv2.CC_STAT_HEIGHT] * per_v) * depth
    expected = np.sqrt(2.0) * standard.outer_m
    with np.errstate(invalid="ignore"):
        able = (first >= 0) & (diagonal > 0.35 * expected) & (diagonal < _WIDEST * standard.outer_m)
    able &= stats[:, cv2.CC_STAT_AREA] >= 25
    ks = np.flatnonzero(able)
    return [int(k) for k in ks[np.argsort(np.abs(np.log(diagonal[ks] / (0.9 * expected))), kind="stable")][:_MOST]]


def _parts(points: Array, standard: FlangeStandard, config: FlangeFitConfig) -> list[FlatPart]:
    """Return the part as it is, or the planes it consists of where it leaked over a shallow step onto another."""
    extent = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
    if not 0.55 * standard.outer_m < extent < _WIDEST * standard.outer_m:
        return []
    whole, rms = _part(points, standard, config)
    if rms < config.hypothesis_tolerance_m:
        return [] if whole is None else [whole]
    out = []
    for _ in range(3):
        if len(points) < 40:
            break
        few = points[:: max(1, len(points) // 240)]
        a, b, c = (few[k] for k in (_draws(config.seed) * len(few)).astype(np.intp))
        normals = np.cross(b - a, c - a)
        length = np.sqrt((normals * normals).sum(axis=1))
        normals /= np.maximum(length, 1e-12)[:, None]
        off = np.abs(normals @ few.T - (normals * a).sum(axis=1)[:, None])
        best = int(np.argmax((off < config.hypothesis_tolerance_m).sum(axis=1) * (length > 1e-5)))
        on = np.abs((points - a[best]) @ normals[best]) < 2.0 * config.hypothesis_tolerance_m
        mine = points[on]
        mine = mine[((mine - np.median(mine, axis=0)) ** 2).sum(axis=1) < standard.outer_m**2]
        part = _part(mine, standard, config)[0] if len(mine) > 20 else None
        if part is not None:
            out.append(part)
        points = points[~on]
    return out


@cache
def _draws(seed: int) -> Array:
    return np.random.default_rng(seed).random((3, _TRIPLES))


def _part(points: Array, standard: FlangeStandard, config: FlangeFitConfig) -> tuple[FlatPart | None, float]:
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
    return FlatPart(middle + axes @ center, normal, radius + pitch, misfit / standard.outer_m), rms


def _hull_circle(hull: Array, bounds: tuple[float, float]) -> tuple[Array, float, float] | None:
    """Return a circle through most of a convex outline (N, 2) with a radius within ``bounds`` (m).

    Centre, radius, misfit (m).
    """
    if len(hull) < 6:
        return None
    n = len(hull)
    # every triple of about a dozen corners, spread over the outline
    some = hull[np.unique(np.linspace(0, n - 1, 11).round().astype(int))]
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
