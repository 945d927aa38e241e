"""Find a flange in a scan, ordered or not: the plane of its face and the centre of its concentric edges."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.face import FaceRefusal, FlangeFace, FlangeFitConfig, faces_on_plane, near, plane_axes
from weldcal.calibration.flange.search import search_frame, typical_pitches, window_about
from weldcal.calibration.flange.track import fit_tracked
from weldcal.calibration.flange.window import measure_window
from weldcal.calibration.geometry.primitives import fuse, local_planes
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

__all__ = ["FlangeFit", "FlangeFitConfig", "FlangeGuess", "FlangeNotFound", "fit_flange"]


_STEP_M = 0.003  # gap between points that separates two bodies
_MAX_ISLANDS = 40  # bodies that are tried, largest first
_GOOD_COVERAGE = 0.8  # a face seen this well, with its bore, ends the search
_WARP = 0.2  # and so much of that along the normal: a scanner's warp tilts a half more than it tilts the whole
_TRACKED_RADIUS = 0.7  # of the flange's diameter: about the fit of the scan before
# What the centre is off, per axis of the face, where there is no grid, beside the noise: ray-cast scans with noise of
# 0.05 and 0.2 mm and 0.4 to 1 mm between points (tests/calibration/flange/test_forms.py).
_PULL_M, _PULL_SHARE = 2e-5, 0.22
# How far the chamfers of edge and holes draw the plane down, rms^2 over this: 4 um at 0.2 and 10 um at 0.3 mm of noise,
# in ray-cast scans.
_SINK_M = 9e-3
_OUT_OF_ROUND_M = 7e-5  # per axis, from half of an edge: halves of recorded clouds against the whole ones

_LOCAL = 400  # points about the middle that show the lattice
_NEIGHBOURS = 8  # of each: they span the lattice where only a third of the points is left
_FIT = 3_000  # points that fix the polynomial
_INSIDE = 0.25  # of a cell: how far a point may lie from its pixel's ray
_MOST = 0.97  # share of the points that must lie so close
_DOUBLE = 0.01  # share of the pixels that may have two points: more are two views, or noise
_CELLS = 60_000_000  # the largest grid: six times the pixels of the largest scanner in use
_THINNED = 0.5  # a scan with fewer neighbours of its pixels
_STEP_PER_PIXEL_M = 0.003  # depth per pixel at which one body ends before another


@dataclass(frozen=True)
class FlangeGuess:
    """Expected flange: within ``radius_m`` of ``center_C`` (3,) m, with outward normal (3,) where known."""

    center_C: Array
    radius_m: float
    normal_C: Array | None = None


@dataclass(frozen=True, kw_only=True)
class FlangeFit:
    """A flange found in a cloud, camera frame C, metres.

    ``center_C`` (3,) centre of the concentric edges in the face plane. ``normal_C`` (3,) outward, towards the scanner.
    ``center_covariance`` (3, 3) m^2 and ``normal_sigma`` rad (per axis) cover the noise of this scan, not the scanner's
    systematic error. ``outer_radius_m`` and ``bore_radius_m`` are the edges of the flat face (None where not seen).
    ``coverage`` is the share 0..1 of the outer edge that was seen, ``on_grid``
    whether it was measured on a pixel grid. ``plane_rms_m``, ``outer_rms_m`` and ``bore_rms_m`` are
    the residuals of each feature, ``rim_rms_m`` of both edges together.
    """

    center_C: Array
    normal_C: Array
    center_covariance: Array
    normal_sigma: float
    plane_rms_m: float
    rim_rms_m: float
    outer_radius_m: float | None
    bore_radius_m: float | None
    n_points: int
    coverage: float
    outer_rms_m: float = float("nan")
    bore_rms_m: float | None = None
    on_grid: bool = True


def fit_flange(
    points_C: Array,
    standard: FlangeStandard,
    *,
    guess: FlangeGuess | FlangeFit | None = None,
    config: FlangeFitConfig | None = None,
) -> FlangeFit:
    """Find the flange face in a cloud (N, 3), or organised (H, W, 3) with NaN where invalid, in metres, camera frame.

    The method follows from what is given, fastest first; where one finds nothing or doubts its result, the next one
    decides. Organised scans: tracking within 3 mm of a guess that has a normal, a fit of the window about that guess, a
    search of the guess's surroundings. Without a guess a search of the whole scan. Unordered clouds: the same on the
    sensor's rebuilt grid; where it cannot be rebuilt, a search about the guess, or of every separate body of about the
    flange's size.

    ``guess`` limits the search; a FlangeFit of the scan before is a guess, too. Deterministic for ``config.seed``.
    Raises FlangeNotFound with the reason: nothing there, no plane, wrong size (also millimetres taken for metres), too
    little of the edge seen, too rough an edge, no bore. Feature and check of radius: paper, section 2.1.4; edges
    instead of its 3-point circle search, which repeats to 0.4 mm.
    """
    config = config or FlangeFitConfig()
    cloud = np.asarray(points_C)
    if cloud.ndim not in (2, 3) or cloud.shape[-1] != 3:
        raise FlangeNotFound(f"A cloud must be (N, 3) or (H, W, 3); this one has the shape {cloud.shape}.")
    if isinstance(guess, FlangeFit):
        guess = FlangeGuess(guess.center_C, _TRACKED_RADIUS * standard.outer_m, guess.normal_C)
    refusal = FaceRefusal()
    find = _organised if cloud.ndim == 3 else _unordered
    found = find(cloud, standard, guess, config, refusal)
    if found is None and (cloud.ndim == 3 or guess is None):
        _explain_unit(cloud, standard, config)
    if found is None:
        raise FlangeNotFound(refusal.text)
    return found


def _unordered(
    cloud: Array, standard: FlangeStandard, guess: FlangeGuess | None, config: FlangeFitConfig, refusal: FaceRefusal
) -> FlangeFit | None:
    """Return a list of points.

    On its sensor's pixel grid where that can be rebuilt, else taken for the flange's own, then searched.
    """
    grid = rebuild_grid(cloud)
    if grid is not None:
        on_grid = FaceRefusal()
        found = _organised(grid, standard, guess, config, on_grid)
        if found is not None:
            return found
    points = cloud[np.isfinite(cloud).all(axis=1)].astype(float)
    if guess is not None:
        points = near(points, guess.center_C, guess.radius_m)
    search = (
        _search(points, standard, config, refusal) if guess is None else _find(points, standard, guess, config, refusal)
    )
    if search is None:
        return None
    # the chamfer is in the edge by an amount that the points alone do not show
    pull = _PULL_M + _PULL_SHARE * search.plane_rms_m
    in_face = np.eye(3) - np.outer(search.normal_C, search.normal_C)
    return replace(search, on_grid=False, center_covariance=search.center_covariance + pull**2 * in_face)


def _organised(
    cloud: Array, standard: FlangeStandard, guess: FlangeGuess | None, config: FlangeFitConfig, refusal: FaceRefusal
) -> FlangeFit | None:
    """Return a scan with its pixel grid: the whole of it, or the window about a guess."""
    measured = None
    if is_thinned(cloud):
        measured = np.isfinite(cloud[..., 2])
        cloud = interpolated(cloud)
    if guess is not None:
        if guess.normal_C is not None and measured is None:
            face = fit_tracked(cloud, guess.center_C, guess.normal_C, standard, config)
            if face is not None and face.coverage > _GOOD_COVERAGE:
                return _result(face)
        pitches = typical_pitches(cloud)
        if pitches is None:
            refusal.note(0, "The cloud holds no valid point.")
            return None
        inside = window_about(cloud, guess.center_C, guess.radius_m, max(1, int(guess.radius_m / (6.0 * pitches[0]))))
        if inside is None:
            refusal.note(
                0,
                f"Only 0 valid points lie within {1e3 * guess.radius_m:.0f} mm of the expected flange; the flange needs"
                f" {config.min_points}.",
            )
            return None
        if guess.normal_C is not None:
            face = _where_it_was(cloud, standard, guess, max(pitches), config, measured)
            if face is not None:
                return _result(face)
        cloud, measured = cloud[inside], None if measured is None else measured[inside]
    face = search_frame(cloud, standard, config, refusal, measured)
    return None if face is None else _result(face)


def _where_it_was(
    cloud: Array,
    standard: FlangeStandard,
    guess: FlangeGuess,
    pitch: float,
    config: FlangeFitConfig,
    measured: NDArray[np.bool_] | None,
) -> FlangeFace | None:
    """The flange within a few millimetres of a guessed pose, as when it is tracked; None where it must be searched."""
    assert guess.normal_C is not None
    reach = 0.5 * standard.outer_m + 2.0 * pitch + 0.003
    window = window_about(cloud, guess.center_C, reach, max(1, int(reach / (6.0 * pitch))))
    if window is None:
        return None
    center, normal = np.asarray(guess.center_C, dtype=float), np.asarray(guess.normal_C, dtype=float)
    known = None if measured is None else measured[window]
    face = measure_window(
        cloud[window], center, normal, standard.face_outer_radius_m, standard, config, FaceRefusal(), known
    )
    return face if face is not None and face.coverage > _GOOD_COVERAGE and face.bore is not None else None


def _search(points: Array, standard: FlangeStandard, config: FlangeFitConfig, refusal: FaceRefusal) -> FlangeFit | None:
    """Return a cloud that shows little more than a flange as it is; a larger scene body by body."""
    if len(points) == 0:
        refusal.note(0, "The cloud holds no valid point.")
        return None
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if extent < 4.0 * standard.outer_m or not 0.01 < float(np.abs(points).max()) < 20.0:
        return _find(points, standard, None, config, refusal)
    for center in _islands(points, standard.outer_m):
        found = _find(near(points, center, 1.2 * standard.outer_m), standard, None, config, refusal)
        if found is not None:
            return found
    refusal.note(0, f"No separate body of about {1e3 * standard.outer_m:.0f} mm was found in the scene.")
    return _find(points, standard, None, config, refusal)


def _islands(points: Array, diameter: float) -> list[Array]:
    """Return the centres (3,) of the separate bodies about ``diameter`` m across among points (N, 3).

    The largest come first, at most 40.

    Bodies end where space is empty for 3 mm.
    """
    cell = np.floor((points - points.min(axis=0)) / _STEP_M).astype(np.int64)
    if float(np.prod(cell.max(axis=0).astype(float) + 1.0)) > 2e8:
        return []
    count = np.zeros(cell.max(axis=0) + 1, dtype=np.uint16)
    np.add.at(count, (cell[:, 0], cell[:, 1], cell[:, 2]), 1)
    # a lone point in the air is a flying pixel, not a bridge
    space = count > 0.3 * float(np.median(count[count > 0]))
    labels = ndimage.label(space)[0][cell[:, 0], cell[:, 1], cell[:, 2]]
    points, labels = points[labels > 0], labels[labels > 0]
    if len(labels) == 0:
        return []
    order = np.argsort(labels, kind="stable")
    starts = np.nonzero(np.diff(labels[order], prepend=-1))[0]
    low = np.minimum.reduceat(points[order], starts)
    high = np.maximum.reduceat(points[order], starts)
    counts = np.diff(starts, append=len(labels))
    extent = np.linalg.norm(high - low, axis=1)
    fits = np.nonzero((counts >= 100) & (extent > 0.8 * diameter) & (extent < 2.2 * diameter))[0]
    best = fits[np.argsort(-counts[fits], kind="stable")][:_MAX_ISLANDS]
    return [0.5 * (low[k] + high[k]) for k in best]


def _explain_unit(cloud: Array, standard: FlangeStandard, config: FlangeFitConfig) -> None:
    """Raise if the cloud would show a flange in another unit of length."""
    for factor, size, unit in (
        (1e-3, "large", "millimetres, read as metres"),
        (1e3, "small", "metres, read as millimetres"),
    ):
        find = _organised if cloud.ndim == 3 else _unordered
        if find(cloud * factor, standard, None, config, FaceRefusal()) is not None:
            raise FlangeNotFound(
                f"The flange in the cloud is 1000 times too {size}: the coordinates are {unit}; correct the unit."
            )


def _find(
    points: Array, standard: FlangeStandard, guess: FlangeGuess | None, config: FlangeFitConfig, refusal: FaceRefusal
) -> FlangeFit | None:
    if len(points) < config.min_points:
        where = "in the cloud" if guess is None else f"within {1e3 * guess.radius_m:.0f} mm of the expected flange"
        refusal.note(0, f"Only {len(points)} valid points lie {where}; the flange needs {config.min_points}.")
        return None
    refusal.note(0, "No plane was found in the cloud.")
    best: FlangeFace | None = None
    for p, n, support in local_planes(
        points, reach=0.9 * standard.outer_m, tolerance=config.hypothesis_tolerance_m, seed=config.seed
    ):
        if support < 8:
            continue
        outward = n if float(n @ p) < 0 else -n
        if guess is not None and guess.normal_C is not None:
            tilt = float(np.arccos(np.clip(outward @ guess.normal_C, -1.0, 1.0)))
            if tilt > config.max_guess_tilt_rad:
                refusal.note(1, f"The plane found leans {np.degrees(tilt):.0f} degrees from the expected flange.")
                continue
        for face in faces_on_plane(points, p, outward, standard, config, refusal):
            if best is None or face.quality > best.quality:
                best = face
        if best is not None and best.coverage > _GOOD_COVERAGE and best.bore is not None:
            break
    return None if best is None else _result(best)


def _result(face: FlangeFace) -> FlangeFit:
    axes = np.column_stack(plane_axes(face.plane.normal))
    circles = [face.outer] + ([face.bore] if face.bore is not None else [])
    center, cov = fuse([c.center for c in circles], [c.covariance[:2, :2] for c in circles])
    # edges of real faces are no perfect circles: round the whole of one it averages out, over a half it moves the
    # centre
    missing = max(_GOOD_COVERAGE - face.coverage, 0.0) / (_GOOD_COVERAGE - 0.5)
    cov = cov + (_OUT_OF_ROUND_M * missing) ** 2 * np.eye(2)
    # the plane pivots about the middle of its points, where `center` is measured from
    along = face.plane.rms**2 / face.plane.n_inliers + (face.plane.normal_sigma * float(np.linalg.norm(center))) ** 2
    along += (_WARP * _OUT_OF_ROUND_M * missing) ** 2 + (face.plane.rms**2 / _SINK_M) ** 2
    point = face.plane.point + axes @ center
    normal = face.plane.normal if float(face.plane.normal @ point) < 0 else -face.plane.normal
    n_rim = sum(int(c.inliers.sum()) for c in circles)
    return FlangeFit(
        center_C=point,
        normal_C=normal,
        center_covariance=axes @ cov @ axes.T + along * np.outer(normal, normal),
        normal_sigma=face.plane.normal_sigma,
        plane_rms_m=face.plane.rms,
        rim_rms_m=float(np.sqrt(sum(c.rms**2 * int(c.inliers.sum()) for c in circles) / n_rim)),
        outer_radius_m=face.outer.radius,
        bore_radius_m=None if face.bore is None else face.bore.radius,
        n_points=face.n_points,
        coverage=face.coverage,
        outer_rms_m=face.outer.rms,
        bore_rms_m=None if face.bore is None else face.bore.rms,
    )


def rebuild_grid(points: Array) -> Array | None:
    """Rebuild the organised scan (H, W, 3) m of an unordered cloud (N, 3) in its sensor's frame.

    Pixels where nothing was measured are NaN.

    A sensor measures along the rays of its pixels: x/z and y/z of the points lie on a lattice, which a polynomial of
    the third degree bends where a lens does. None where they do not: a cloud of several views, in another frame, or
    noisy across its rays.
    """
    points = points[np.isfinite(points).all(axis=1)]
    z = points[:, 2]
    if len(points) < _LOCAL or not ((z > 0.0).all() or (z < 0.0).all()):
        return None
    ray = points[:, :2] / z[:, None]
    middle = ray[np.argmin(((ray - np.median(ray, axis=0)) ** 2).sum(axis=1))]
    found = _basis(ray, middle)
    if found is None:
        return None
    index = _indices(ray - middle, found)
    if index is None:
        return None
    index -= index.min(axis=0)
    w, h = (index.max(axis=0) + 1).tolist()
    if w * h > _CELLS:
        return None
    cell = index[:, 1] * w + index[:, 0]
    grid = np.full((h * w, 3), np.nan)
    grid[cell] = points
    known = np.isfinite(grid[:, 0])
    if np.count_nonzero(known) < (1.0 - _DOUBLE) * len(points):
        return None
    return grid.reshape(h, w, 3)


def _basis(ray: Array, middle: Array) -> Array | None:
    """The lattice's two shortest steps (2, 2), one a row, the first along x, from rays (N, 2) about a middle (2,)."""
    far = ((ray - middle) ** 2).sum(axis=1)
    some = ray[np.argpartition(far, min(4 * _LOCAL, len(far) - 1))[: 4 * _LOCAL]]
    about = cKDTree(some)
    near = some[np.asarray(about.query(middle, k=_LOCAL)[1])]
    which = np.asarray(about.query(near, k=_NEIGHBOURS + 1)[1])
    d = (some[which[:, 1:]] - near[:, None]).reshape(-1, 2)
    length = np.hypot(d[:, 0], d[:, 1])
    if not length.min() > 0.0:
        return None
    shortest = d[length < 1.2 * np.quantile(length, 0.02)]
    first = _same(shortest, shortest[0])
    area = np.abs(d[:, 0] * first[1] - d[:, 1] * first[0])
    off = area > 0.3 * float(first @ first)
    if not off.any():
        return None
    cell = np.quantile(area[off], 0.02)
    second = d[off & (area < 1.2 * cell)]
    second = _same(second, second[0])
    basis = _reduced(np.array([first, second]))
    steps = d @ np.linalg.inv(basis)
    if np.mean(np.abs(steps - np.rint(steps)).max(axis=1) < _INSIDE) < _MOST:
        return None
    fit = np.rint(steps)
    basis = np.asarray(np.linalg.lstsq(fit, d, rcond=None)[0], dtype=float)
    along = np.abs(basis[:, 0])
    basis = basis[np.argsort(-along, kind="stable")]
    return np.asarray(basis * np.sign([[basis[0, 0]], [basis[1, 1]]]))


def _same(d: Array, like: Array) -> Array:
    """Return the median of those steps (N, 2) that equal one of them, or its reverse, within a fifth of its length."""
    d = np.where((d @ like)[:, None] < 0.0, -d, d)
    return np.asarray(np.median(d[np.hypot(*(d - like).T) < 0.2 * np.hypot(*like)], axis=0))


def _reduced(basis: Array) -> Array:
    """Return the shortest basis of the same lattice (Lagrange)."""
    a, b = basis
    for _ in range(10):
        if a @ a > b @ b:
            a, b = b, a
        k = np.rint(float(a @ b) / float(a @ a))
        if k == 0.0:
            break
        b = b - k * a
    return np.array([a, b])


def _indices(ray: Array, basis: Array) -> NDArray[np.intp] | None:
    """Pixel (N, 2) of each ray (N, 2) about the middle.

    A plane's lattice, or one that grows from the middle and bends.
    """
    at = ray @ np.linalg.inv(basis)
    order = np.argsort((at * at).sum(axis=1), kind="stable")
    for degree in (1, 3):
        count, scale, c = _LOCAL, 1.0, None
        while True:
            count = min(2 * count, len(at))
            inside = order[:count][:: max(1, count // _FIT)]
            found = at[inside] if c is None else _terms(at[inside] / scale, degree) @ c
            whole = np.rint(found)
            close = np.abs(found - whole).max(axis=1) < _INSIDE
            if np.mean(close) < _MOST:
                break
            inside, whole = inside[close], whole[close]
            scale = float(np.abs(at[inside]).max())
            c = np.linalg.lstsq(_terms(at[inside] / scale, degree), whole, rcond=None)[0]
            if count == len(at):
                found = _terms(at / scale, degree) @ c
                index = np.rint(found)
                if np.mean(np.abs(found - index).max(axis=1) < _INSIDE) < _MOST:
                    break
                return np.asarray(index, dtype=np.intp)
    return None


def _terms(at: Array, degree: int) -> Array:
    x, y = at.T
    powers = [[np.ones_like(x), x, x * x, x * x * x], [np.ones_like(y), y, y * y, y * y * y]]
    return np.column_stack([powers[0][i] * powers[1][j] for i in range(degree + 1) for j in range(degree + 1 - i)])


def is_thinned(grid: Array) -> bool:
    """Whether fewer than half of a scan's (H, W, 3) pixels have a measured neighbour beside them, or below them."""
    known = np.isfinite(grid[..., 2])
    count = np.count_nonzero(known)
    beside = np.count_nonzero(known[:, 1:] & known[:, :-1])
    below = np.count_nonzero(known[1:] & known[:-1])
    return bool(count > 0 and min(beside, below) < _THINNED * count)


def interpolated(grid: Array) -> Array:
    """Return a thinned scan (H, W, 3) with its gaps filled, along the rows and then along the columns.

    The values x/z, y/z and 1/z are linear across a gap, as they are on a plane; where the depth steps, the nearest one
    goes on. Gaps longer than twice the common one stay.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / grid[..., 2]
        rays = np.stack([grid[..., 0] * inverse, grid[..., 1] * inverse, inverse], axis=-1)
    for _ in range(2):
        rays = np.swapaxes(_along_rows(rays), 0, 1)
    rays[..., 2] = 1.0 / rays[..., 2]
    rays[..., :2] *= rays[..., 2:]
    return np.ascontiguousarray(rays)


def _along_rows(rays: Array) -> Array:
    """Rays and inverse depth (h, w, 3) with the gaps of the rows filled."""
    h, w = rays.shape[:2]
    known = np.flatnonzero(np.isfinite(rays[..., 2]))
    row, column = np.divmod(known, w)
    gap = np.diff(column)
    same = np.diff(row) == 0
    if not (same & (gap > 1)).any():
        return rays
    widest = 2 * int(np.median(gap[same & (gap > 1)]))
    fill = np.flatnonzero(same & (gap > 1) & (gap <= widest))
    out = rays.reshape(-1, 3).copy()
    a, b, g = out[known[fill]], out[known[fill + 1]], gap[fill]
    step = np.abs(1.0 / b[:, 2] - 1.0 / a[:, 2]) > _STEP_PER_PIXEL_M * g
    for k in range(1, widest):
        at = k < g
        share = (k / g[at])[:, None]
        value = (1.0 - share) * a[at] + share * b[at]
        near = np.where(share[:, 0] <= 0.5, a[at, 2], b[at, 2])
        value[:, 2] = np.where(step[at], near, value[:, 2])
        out[known[fill[at]] + k] = value
    return out.reshape(h, w, 3)


def face_cloud(points_C: Array, fit: FlangeFit, standard: FlangeStandard) -> Array:
    """Return the points (N, 3) m of the fitted face and its chamfers, without what lies in front, behind or around."""
    flat = np.asarray(points_C, dtype=float).reshape(-1, 3)
    # most of a cloud is far from the face's plane; NaN is nowhere near
    flat = flat[np.abs((flat - fit.center_C) @ fit.normal_C) < 2.0 * standard.chamfer_m + 0.002]
    flat = flat[np.isfinite(flat).all(axis=1)]
    d = flat - fit.center_C
    height = d @ fit.normal_C
    reach = np.linalg.norm(d - height[:, None] * fit.normal_C, axis=1)
    keep = (reach < 0.5 * standard.outer_m + 0.001) & (height < 0.001) & (height > -2.0 * standard.chamfer_m)
    return np.asarray(flat[keep])
