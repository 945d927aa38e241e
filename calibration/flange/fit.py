"""Finds a flange in a scan: the plane of its face and the centre of its concentric edges."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import CircleFitError, FlangeNotFound
from weldcal.calibration.flange.face import Face, FlangeFitConfig, Refusal, faces_on_plane
from weldcal.calibration.flange.rim import plane_axes, sector_count
from weldcal.calibration.flange.scene import Scene, crop, islands
from weldcal.calibration.flange.search import search_frame, typical_pitches, window_about
from weldcal.calibration.flange.track import fit_tracked
from weldcal.calibration.flange.window import measure_window
from weldcal.calibration.geometry.circle import CircleFit, fuse, refine_circles
from weldcal.calibration.geometry.plane import PlaneFit, local_planes, weighted_moments
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


__all__ = ["FlangeFit", "FlangeFitConfig", "FlangeGuess", "FlangeNotFound", "fit_flange"]


_GOOD_COVERAGE = 0.8  # a face seen this well, with its bore, ends the search
_WARP = 0.2  # and so much of that along the normal: a scanner's warp tilts a half more than it tilts the whole
_TRACKED_RADIUS = 0.7  # of the flange's diameter: about the fit of the scan before
_OUT_OF_ROUND_M = 7e-5  # per axis, from half of an edge: halves of recorded clouds against the whole ones


@dataclass(frozen=True)
class FlangeGuess:
    """Expected flange: within ``radius_m`` of ``center_C`` (3,) m, with outward normal (3,) where known."""

    center_C: Array
    radius_m: float
    normal_C: Array | None = None


@dataclass(frozen=True, kw_only=True)
class FlangeFit:
    """A flange found in a cloud, camera frame C, metres.

    ``center_C`` (3,) centre of the concentric edges in the face plane; ``normal_C`` (3,) outward, towards the scanner;
    ``center_covariance`` (3, 3) m^2 and ``normal_sigma`` rad (per axis) cover the noise of this scan, not the scanner's
    systematic error; ``outer_radius_m`` and ``bore_radius_m`` are the edges of the flat face (None where not seen);
    ``coverage`` is the share 0..1 of the outer edge that was seen. ``plane_rms_m``, ``outer_rms_m`` and ``bore_rms_m`` are
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
    n_rim: int
    coverage: float
    outer_rms_m: float = float("nan")
    bore_rms_m: float | None = None


def fit_flange(
    points_C: Array,
    standard: FlangeStandard,
    *,
    guess: FlangeGuess | FlangeFit | None = None,
    config: FlangeFitConfig | None = None,
) -> FlangeFit:
    """Find the flange face in a cloud (N, 3), or organised (H, W, 3) with NaN where invalid, in metres, camera frame.

    The method follows from what is given, fastest first; where one finds nothing or doubts its result, the next one decides.
    Organised scans: tracking within 3 mm of a guess that has a normal, a fit of the window about that guess, a search of the
    guess's surroundings; without a guess a search of the whole scan. Unordered clouds: a fit that takes the points for the
    flange's own, a search about the guess, or of every separate body of about the flange's size.

    ``guess`` limits the search; a FlangeFit of the scan before is a guess, too. Deterministic for ``config.seed``. Raises
    FlangeNotFound with the reason: nothing there, no plane, wrong size (also millimetres taken for metres), too little of the
    edge seen, too rough an edge, no bore. Feature and check of radius: paper, section 2.1.4; edges instead of its 3-point
    circle search, which repeats to 0.4 mm.
    """
    config = config or FlangeFitConfig()
    cloud = np.asarray(points_C)
    if cloud.ndim not in (2, 3) or cloud.shape[-1] != 3:
        raise FlangeNotFound(f"A cloud must be (N, 3) or (H, W, 3); this one has the shape {cloud.shape}.")
    if isinstance(guess, FlangeFit):
        guess = FlangeGuess(guess.center_C, _TRACKED_RADIUS * standard.outer_m, guess.normal_C)
    refusal = Refusal()
    find = _organised if cloud.ndim == 3 else _unordered
    found = find(cloud, standard, guess, config, refusal)
    if found is None and (cloud.ndim == 3 or guess is None):
        _explain_unit(cloud, standard, config)
    if found is None:
        raise FlangeNotFound(refusal.text)
    return found


def _unordered(
    cloud: Array, standard: FlangeStandard, guess: FlangeGuess | None, config: FlangeFitConfig, refusal: Refusal
) -> FlangeFit | None:
    """A list of points: taken for the flange's own first, then searched."""
    scene = crop(cloud) if guess is None else crop(cloud, guess.center_C, guess.radius_m)
    face = fit_segmented(cloud if guess is None else scene.points, standard, config)
    toward = None if guess is None else guess.normal_C
    if face is not None and (
        toward is None or float(face.plane.normal @ toward) > float(np.cos(config.max_guess_tilt_rad))
    ):
        return _result(face)
    if guess is None:
        return _search(scene, standard, config, refusal)
    return _find(scene, standard, guess, config, refusal)


def _organised(
    cloud: Array, standard: FlangeStandard, guess: FlangeGuess | None, config: FlangeFitConfig, refusal: Refusal
) -> FlangeFit | None:
    """A scan with its pixel grid: the whole of it, or the window about a guess."""
    if guess is not None:
        if guess.normal_C is not None:
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
                f"Only 0 valid points lie within {1e3 * guess.radius_m:.0f} mm of the expected flange; the flange needs "
                f"{config.min_points}.",
            )
            return None
        if guess.normal_C is not None:
            face = _where_it_was(cloud, standard, guess, max(pitches), config)
            if face is not None:
                return _result(face)
        cloud = inside
    face = search_frame(cloud, standard, config, refusal)
    return None if face is None else _result(face)


def _where_it_was(
    cloud: Array, standard: FlangeStandard, guess: FlangeGuess, pitch: float, config: FlangeFitConfig
) -> Face | None:
    """The flange within a few millimetres of a guessed pose, as when it is tracked; None where it must be searched."""
    assert guess.normal_C is not None
    reach = 0.5 * standard.outer_m + 2.0 * pitch + 0.003
    window = window_about(cloud, guess.center_C, reach, max(1, int(reach / (6.0 * pitch))))
    if window is None:
        return None
    center, normal = np.asarray(guess.center_C, dtype=float), np.asarray(guess.normal_C, dtype=float)
    face = measure_window(window, center, normal, standard.face_outer_radius_m, standard, config, Refusal())
    return face if face is not None and face.coverage > _GOOD_COVERAGE and face.bore is not None else None


def _search(scene: Scene, standard: FlangeStandard, config: FlangeFitConfig, refusal: Refusal) -> FlangeFit | None:
    """A cloud that shows little more than a flange as it is; a larger scene body by body."""
    if len(scene.points) == 0:
        refusal.note(0, "The cloud holds no valid point.")
        return None
    extent = float(np.linalg.norm(np.ptp(scene.points, axis=0)))
    if extent < 4.0 * standard.outer_m or not 0.01 < float(np.abs(scene.points).max()) < 20.0:
        return _find(scene, standard, None, config, refusal)
    for center in islands(scene, standard.outer_m):
        found = _find(scene.near(center, 1.2 * standard.outer_m), standard, None, config, refusal)
        if found is not None:
            return found
    refusal.note(0, f"No separate body of about {1e3 * standard.outer_m:.0f} mm was found in the scene.")
    return _find(scene, standard, None, config, refusal)


def _explain_unit(cloud: Array, standard: FlangeStandard, config: FlangeFitConfig) -> None:
    """Raise if the cloud would show a flange in another unit of length."""
    for factor, size, unit in (
        (1e-3, "large", "millimetres, read as metres"),
        (1e3, "small", "metres, read as millimetres"),
    ):
        if _find(crop(cloud * factor), standard, None, config, Refusal()) is not None:
            raise FlangeNotFound(
                f"The flange in the cloud is 1000 times too {size}: the coordinates are {unit}; correct the unit."
            )


def _find(
    scene: Scene, standard: FlangeStandard, guess: FlangeGuess | None, config: FlangeFitConfig, refusal: Refusal
) -> FlangeFit | None:
    if len(scene.points) < config.min_points:
        where = "in the cloud" if guess is None else f"within {1e3 * guess.radius_m:.0f} mm of the expected flange"
        refusal.note(0, f"Only {len(scene.points)} valid points lie {where}; the flange needs {config.min_points}.")
        return None
    refusal.note(0, "No plane was found in the cloud.")
    best: Face | None = None
    for p, n, support in local_planes(
        scene.points, reach=0.9 * standard.outer_m, tolerance=config.hypothesis_tolerance_m, seed=config.seed
    ):
        if support < 8:
            continue
        outward = n if float(n @ p) < 0 else -n
        if guess is not None and guess.normal_C is not None:
            tilt = float(np.arccos(np.clip(outward @ guess.normal_C, -1.0, 1.0)))
            if tilt > config.max_guess_tilt_rad:
                refusal.note(1, f"The plane found leans {np.degrees(tilt):.0f} degrees from the expected flange.")
                continue
        for face in faces_on_plane(scene, p, outward, standard, config, refusal):
            if best is None or face.quality > best.quality:
                best = face
        if best is not None and best.coverage > _GOOD_COVERAGE and best.bore is not None:
            break
    return None if best is None else _result(best)


def _result(face: Face) -> FlangeFit:
    axes = np.column_stack(plane_axes(face.plane.normal))
    circles = [face.outer] + ([face.bore] if face.bore is not None else [])
    center, cov = fuse([c.center for c in circles], [c.covariance[:2, :2] for c in circles])
    # edges of real faces are no perfect circles: round the whole of one it averages out, over a half it moves the centre
    missing = max(_GOOD_COVERAGE - face.coverage, 0.0) / (_GOOD_COVERAGE - 0.5)
    cov = cov + (_OUT_OF_ROUND_M * missing) ** 2 * np.eye(2)
    # the plane pivots about the middle of its points, where `center` is measured from
    along = face.plane.rms**2 / face.plane.n_inliers + (face.plane.normal_sigma * float(np.linalg.norm(center))) ** 2
    along += (_WARP * _OUT_OF_ROUND_M * missing) ** 2
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
        n_rim=n_rim,
        coverage=face.coverage,
        outer_rms_m=face.outer.rms,
        bore_rms_m=None if face.bore is None else face.bore.rms,
    )
