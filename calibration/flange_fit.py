"""The robot's flange in a scan: the plane of its face and the concentric edges that give its centre."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from weldcal.calibration.circle import CircleFit, fit_circle, fuse
from weldcal.calibration.errors import CircleFitError, FlangeNotFound, PlaneFitError
from weldcal.calibration.plane import PlaneFit, fit_plane, local_planes
from weldcal.calibration.edge_labels import refine_circle
from weldcal.calibration.rim import (
    face_pixels,
    FacePixels,
    EdgePoints,
    RayModel,
    connected_parts,
    connected_pixels,
    coverage,
    organised_edges,
    plane_axes,
    sector_edges,
)
from weldcal.models.flanges import FlangeStandard

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CHAMFER_M = 0.0025  # a surface that goes on at most this far below the face is its chamfer, not another part
_CHAMFER_SHARE = 0.2  # more of the edge than flying pixels and noise could make look so
_SHARED = 1.0  # smoothing makes neighbouring edge points agree: the variance of their mean is this many times larger


@dataclass(frozen=True)
class FlangeGuess:
    """Where to look: ball about ``center_C`` (3,) m of ``radius_m``, and the outward normal (3,) where known."""

    center_C: Array
    radius_m: float
    normal_C: Array | None = None


@dataclass(frozen=True)
class FlangeFitConfig:
    """What counts as a flange. Lengths in m; the defaults suit structured-light scanners and admit time-of-flight ones."""

    seed: int = 0
    hypothesis_tolerance_m: float = 0.0008
    radius_tolerance: float = 0.05
    min_coverage: float = 0.5
    max_plane_rms_m: float = 0.0015
    max_rim_rms_m: float = 0.0006
    max_guess_tilt_rad: float = 0.8
    min_points: int = 120


@dataclass(frozen=True)
class FlangeFit:
    """A flange found in a cloud, camera frame C, metres.

    ``center_C`` (3,) centre of the concentric edges in the face plane; ``normal_C`` (3,) outward, towards the scanner;
    ``center_covariance`` (3, 3) m^2 and ``normal_sigma`` rad (per axis) cover the noise of this scan, not the scanner's
    systematic error; ``outer_radius_m`` and ``bore_radius_m`` are the edges of the flat face (None where not seen);
    ``coverage`` is the share 0..1 of the outer edge that was seen.
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


@dataclass(frozen=True)
class _Cloud:
    """A cropped scan: organised (grid, valid, rays) or a list of points only."""

    points: Array
    grid: Array | None = None
    valid: Mask | None = None
    rays: RayModel | None = None


@dataclass
class _Refusal:
    """The most telling reason so far: a candidate that failed a late test says more than one that failed early."""

    stage: int = -1
    text: str = ""

    def note(self, stage: int, text: str) -> None:
        if stage > self.stage:
            self.stage, self.text = stage, text


@dataclass(frozen=True)
class _Face:
    """Edges of one face candidate in the plane's own axes."""

    plane: PlaneFit
    outer: CircleFit
    bore: CircleFit | None
    coverage: float
    n_points: int
    pitch: float
    quality: float = field(default=0.0)


def fit_flange(
    points_C: Array,
    standard: FlangeStandard,
    *,
    guess: FlangeGuess | None = None,
    config: FlangeFitConfig | None = None,
) -> FlangeFit:
    """Find the flange face in a cloud (N, 3), or organised (H, W, 3) with NaN where invalid, in metres, camera frame.

    With ``guess`` only a ball of the scene is searched; without one the cloud should show little more than the flange.
    Deterministic for ``config.seed``. Raises FlangeNotFound with the reason: nothing in the ball, no plane, wrong size
    (also millimetres taken for metres), too little of the edge seen, too rough an edge.
    Feature and check of radius: paper, section 2.1.4; edges instead of its 3-point circle search, which repeats to 0.4 mm.
    """
    config = config or FlangeFitConfig()
    cloud = np.asarray(points_C)
    if cloud.ndim not in (2, 3) or cloud.shape[-1] != 3:
        raise FlangeNotFound(f"A cloud must be (N, 3) or (H, W, 3); this one has the shape {cloud.shape}.")
    refusal = _Refusal()
    found = _find(cloud, standard, guess, config, refusal)
    if found is not None:
        return found
    if guess is None:
        for factor, wrong, right in ((1e-3, "millimetres", "large"), (1e3, "metres read as millimetres", "small")):
            if _find(cloud * factor, standard, None, config, _Refusal()) is not None:
                raise FlangeNotFound(
                    f"The flange in the cloud is 1000 times too {right}: the coordinates are {wrong}; correct the unit."
                )
    raise FlangeNotFound(refusal.text)


def _find(
    cloud: Array, standard: FlangeStandard, guess: FlangeGuess | None, config: FlangeFitConfig, refusal: _Refusal
) -> FlangeFit | None:
    scene = _crop(cloud, guess)
    diameter = standard.outer_m
    if len(scene.points) < config.min_points:
        where = (
            "in the cloud" if guess is None else f"within {1e3 * guess.radius_m:.0f} mm of where the flange should be"
        )
        refusal.note(0, f"Only {len(scene.points)} valid points lie {where}; the flange needs {config.min_points}.")
        return None
    best: _Face | None = None
    for p, n, support in local_planes(
        scene.points, reach=0.9 * diameter, tolerance=config.hypothesis_tolerance_m, seed=config.seed
    ):
        outward = n if float(n @ p) < 0 else -n
        if guess is not None and guess.normal_C is not None:
            tilt = float(np.arccos(np.clip(outward @ guess.normal_C, -1.0, 1.0)))
            if tilt > config.max_guess_tilt_rad:
                refusal.note(
                    1, f"The only plane found is tilted {np.degrees(tilt):.0f} degrees from the expected flange."
                )
                continue
        if support < 8:
            refusal.note(0, "No plane was found in the cloud.")
            continue
        for face in _faces_on_plane(scene, p, outward, standard, config, refusal):
            if best is None or face.quality > best.quality:
                best = face
        if best is not None and best.coverage > 0.8 and best.bore is not None:
            break
    return None if best is None else _result(best)


def _crop(cloud: Array, guess: FlangeGuess | None) -> _Cloud:
    valid = np.isfinite(cloud).all(axis=-1)
    if guess is not None:
        # a box first: comparing one axis at a time is several times cheaper than norms over a whole scan
        for axis in range(3):
            np.logical_and(valid, np.abs(cloud[..., axis] - guess.center_C[axis]) < guess.radius_m, out=valid)
    if cloud.ndim == 2:
        return _Cloud(_ball(cloud[valid].astype(float), guess))
    rows, columns = np.nonzero(valid.any(axis=1))[0], np.nonzero(valid.any(axis=0))[0]
    if len(rows) == 0:
        return _Cloud(np.zeros((0, 3)))
    v = slice(max(int(rows[0]) - 2, 0), int(rows[-1]) + 3)
    u = slice(max(int(columns[0]) - 2, 0), int(columns[-1]) + 3)
    grid, mask = cloud[v, u].astype(float), valid[v, u]
    points = grid[mask]
    if len(points) < 12:
        return _Cloud(points)
    return _Cloud(points, grid, mask, RayModel(grid, mask))


def _focus(scene: _Cloud, center: Array, radius: float) -> _Cloud:
    return _crop(scene.points if scene.grid is None else scene.grid, FlangeGuess(center, radius))


def _ball(points: Array, guess: FlangeGuess | None) -> Array:
    if guess is None or len(points) == 0:
        return points
    return points[((points - guess.center_C) ** 2).sum(axis=1) < guess.radius_m**2]


def _faces_on_plane(
    scene: _Cloud,
    seed_point: Array,
    normal: Array,
    standard: FlangeStandard,
    config: FlangeFitConfig,
    refusal: _Refusal,
) -> list[_Face]:
    """Face candidates on one plane: every connected part of about the flange's size is tried."""
    around = ((scene.points - seed_point) ** 2).sum(axis=1) < (1.2 * standard.outer_m) ** 2
    try:
        plane = fit_plane(scene.points[around], (seed_point, normal), tolerance=3.0 * config.hypothesis_tolerance_m)
    except PlaneFitError as e:
        refusal.note(1, str(e))
        return []
    if plane.rms > config.max_plane_rms_m:
        refusal.note(1, f"The face is not flat: {1e3 * plane.rms:.2f} mm rms from its plane.")
        return []
    axes = np.column_stack(plane_axes(plane.normal))
    on, xy, pitch, part = _parts(scene, plane, axes, seed_point, standard)
    if len(xy) < config.min_points:
        refusal.note(1, f"Only {len(xy)} points lie on the largest flat face; the flange needs {config.min_points}.")
        return []
    faces = []
    for k in range(min(3, int(part.max()) + 1)):
        mine = xy[part == k]
        if len(mine) < config.min_points // 2:
            break
        face = _measure(scene, plane, mine, pitch, standard, config, refusal)
        if face is not None:
            faces.append(face)
    return faces


def _thickness(plane: PlaneFit) -> float:
    return max(3.0 * plane.rms, 0.0002)


def _parts(
    scene: _Cloud, plane: PlaneFit, axes: Array, seed_point: Array, standard: FlangeStandard
) -> tuple[Mask, Array, float, NDArray[np.intp]]:
    """Points on a plane near the seed: mask, coordinates in the plane (N, 2), point pitch m, connected part of each."""
    reach = 2.0 * standard.outer_m
    if scene.grid is not None and scene.valid is not None and scene.rays is not None:
        d = (scene.grid - plane.point) @ plane.normal
        with np.errstate(invalid="ignore"):
            on = scene.valid & (np.abs(d) < _thickness(plane))
            on &= ((scene.grid - seed_point) ** 2).sum(axis=2) < reach**2
        label = connected_pixels(on)
        xy = (scene.grid[on] - plane.point) @ axes
        return on, xy, _grid_pitch(scene, plane), label[on]
    d = (scene.points - plane.point) @ plane.normal
    on = (np.abs(d) < _thickness(plane)) & (((scene.points - seed_point) ** 2).sum(axis=1) < reach**2)
    xy = (scene.points[on] - plane.point) @ axes
    if len(xy) < 3:
        return on, xy, 1e-3, np.zeros(len(xy), dtype=int)
    few = xy[:: max(1, len(xy) // 200)]
    # the median distance to the 4th neighbour of a square grid is its pitch; less sensitive to doubled points than the 1st
    pitch = float(np.median(cKDTree(xy).query(few, k=min(5, len(xy)))[0][:, -1]))
    return on, xy, pitch, connected_parts(xy, 2.5 * pitch)


def _grid_pitch(scene: _Cloud, plane: PlaneFit) -> float:
    assert scene.rays is not None and scene.valid is not None
    v, u = (float(np.mean(i)) for i in np.nonzero(scene.valid))
    corner = scene.rays.on_plane(np.array([u, u + 1.0, u]), np.array([v, v, v + 1.0]), plane.point, plane.normal)
    return float(np.sqrt(np.linalg.norm(np.cross(corner[1] - corner[0], corner[2] - corner[0]))))


def _measure(
    scene: _Cloud,
    plane: PlaneFit,
    part: Array,
    pitch: float,
    standard: FlangeStandard,
    config: FlangeFitConfig,
    refusal: _Refusal,
) -> _Face | None:
    """Edges of one connected part, and the tests that make it a flange."""
    outer_nominal, bore_nominal = 0.5 * standard.outer_m, 0.5 * standard.bore_m
    slack = max(config.radius_tolerance * outer_nominal, 1.5 * pitch)
    bounds = (standard.face_outer_radius_m - slack, outer_nominal + slack)
    extent = np.ptp(part, axis=0)
    if float(extent.max()) < bounds[0]:
        refusal.note(
            2,
            f"The largest flat face is {1e3 * float(extent.max()):.1f} mm across; the flange has {1e3 * standard.outer_m:.0f} mm.",
        )
        return None
    middle = 0.5 * (part.min(axis=0) + part.max(axis=0))
    wide = sector_edges(part, middle, 2.0 * pitch, outer=True, band=(0.3 * outer_nominal, 4.0 * outer_nominal))
    try:
        outer = fit_circle(wide, radius_bounds=bounds, noise_floor=0.2 * pitch, hypotheses=100, seed=config.seed)
    except CircleFitError:
        outer = None
    if outer is None or not bounds[0] < outer.radius < bounds[1]:
        size = float(np.median(np.linalg.norm(wide - middle, axis=1))) if len(wide) else 0.0
        refusal.note(
            3,
            f"No circle of {1e3 * standard.outer_m:.0f} mm was found on the flat face, which is {2e3 * size:.0f} mm across.",
        )
        return None
    bore: CircleFit | None = None
    count = 0
    axes = np.column_stack(plane_axes(plane.normal))
    scene = _focus(scene, plane.point + axes @ outer.center, 1.35 * outer_nominal + 3.0 * pitch)
    for _ in range(2):
        axes = np.column_stack(plane_axes(plane.normal))
        center3 = plane.point + axes @ outer.center
        distance = scene.points - center3
        height = distance @ plane.normal
        rho2 = (distance**2).sum(axis=1) - height**2
        margin = 0.5 * pitch
        inner = (bore.radius if bore is not None else bore_nominal) + margin
        ring = (rho2 < (outer.radius - margin) ** 2) & (rho2 > inner**2) & (np.abs(height) < 2.0 * _thickness(plane))
        try:
            plane = fit_plane(scene.points[ring], (plane.point, plane.normal), tolerance=2.0 * _thickness(plane))
            axes = np.column_stack(plane_axes(plane.normal))
            center = (center3 - plane.point) @ axes
            thickness = _thickness(plane)
            xy, edges, pixels = _edges(scene, plane, center, 1.4 * outer_nominal)
            outer = _circle(pixels, edges, xy, center, outer.radius, pitch, 2.0 * pitch + 0.0012, thickness, True)
        except (PlaneFitError, CircleFitError) as e:
            refusal.note(4, str(e))
            return None
        count = int(ring.sum())
        try:
            bore = _circle(
                pixels,
                edges,
                xy,
                outer.center,
                bore.radius if bore else standard.face_inner_radius_m,
                pitch,
                2.0 * pitch + 0.0012,
                thickness,
                False,
            )
        except CircleFitError:
            bore = None
        if bore is not None and (
            abs(bore.radius - standard.face_inner_radius_m) > slack
            or float(np.linalg.norm(bore.center - outer.center)) > 0.25 * slack + pitch
        ):
            bore = None
    return _tests(outer, bore, plane, xy, count, pitch, bounds, standard, config, refusal)


def _edges(scene: _Cloud, plane: PlaneFit, center: Array, reach: float) -> tuple[Array, EdgePoints | None, FacePixels | None]:
    """Face points (N, 2) within ``reach`` of the centre and, on organised clouds, the crossings of their mask."""
    axes = np.column_stack(plane_axes(plane.normal))
    center3 = plane.point + axes @ center
    if scene.grid is None or scene.valid is None or scene.rays is None:
        d = scene.points - center3
        on = (np.abs(d @ plane.normal) < _thickness(plane)) & ((d**2).sum(axis=1) < reach**2)
        return (scene.points[on] - plane.point) @ axes, None, None
    d = scene.grid - center3
    with np.errstate(invalid="ignore"):
        face = scene.valid & (np.abs(d @ plane.normal) < _thickness(plane)) & ((d**2).sum(axis=2) < reach**2)
    return (
        (scene.grid[face] - plane.point) @ axes,
        organised_edges(scene.grid, face, scene.rays, plane.point, plane.normal),
        face_pixels(scene.grid, face, scene.rays, plane.point, plane.normal),
    )


def _circle(
    pixels: FacePixels | None,
    edges: EdgePoints | None,
    xy: Array,
    center: Array,
    radius: float,
    pitch: float,
    width: float,
    thickness: float,
    outer: bool,
) -> CircleFit:
    """One edge, from the points within ``width`` of the expected circle."""
    band = (radius - width, radius + width)
    if edges is None:
        found = sector_edges(xy, center, pitch, outer=outer, band=band)
        return fit_circle(found, initial=(center, radius), noise_floor=0.1 * pitch)
    d = edges.points - center
    rho = np.hypot(d[:, 0], d[:, 1])
    near = (rho > band[0]) & (rho < band[1])
    if int(near.sum()) < 12:
        raise CircleFitError("Too little of the edge was seen.")
    d, rho, beyond = d[near], rho[near], edges.beyond[near]
    # where a chamfer continues the face, the face "ends" one thickness below its plane, and a slanting ray moves that sideways;
    # away from the scanner a chamfer is foreshortened below a pixel, so it is judged for the edge as a whole
    known = np.isfinite(beyond)
    share = float(np.mean((beyond[known] < 0.0) & (beyond[known] > -_CHAMFER_M))) if known.any() else 0.0
    points = edges.points[near] - (thickness if share > _CHAMFER_SHARE else 0.0) * edges.slide[near]
    sigma = np.hypot((edges.step[near] * d).sum(axis=1) / rho, 0.3 * pitch)
    fit = fit_circle(points, sigma=sigma, initial=(center, radius), noise_floor=0.03 * pitch)
    lowered = thickness if share > _CHAMFER_SHARE else 0.0
    xy_p = pixels.points - lowered * pixels.slide
    rho = np.hypot(*(xy_p - fit.center).T)
    sel = np.abs(rho - fit.radius) < min(2.5 * pitch, 0.002)
    fit = refine_circle(xy_p[sel], pixels.on_face[sel], fit, pitch, outer=outer)
    return replace(fit, covariance=_SHARED * fit.covariance)


def _tests(
    outer: CircleFit,
    bore: CircleFit | None,
    plane: PlaneFit,
    xy: Array,
    count: int,
    pitch: float,
    bounds: tuple[float, float],
    standard: FlangeStandard,
    config: FlangeFitConfig,
    refusal: _Refusal,
) -> _Face | None:
    rho = np.linalg.norm(xy - outer.center, axis=1)
    seen = coverage(xy[np.abs(rho - outer.radius) < 2.0 * pitch + 0.0005], outer.center)
    inside = int((rho < 0.7 * 0.5 * standard.bore_m).sum()) / (0.7 * 0.5 * standard.bore_m) ** 2
    density = max(count, 1) / (outer.radius**2 - (0.5 * standard.bore_m) ** 2)
    rim_limit = max(config.max_rim_rms_m, 0.7 * pitch)
    if not bounds[0] < outer.radius < bounds[1]:
        refusal.note(
            5,
            f"The circle found is {2e3 * outer.radius:.1f} mm across; the flange has {1e3 * standard.outer_m:.0f} mm.",
        )
    elif count < config.min_points:
        refusal.note(5, f"Only {count} points lie on the face; the flange needs {config.min_points}.")
    elif seen < config.min_coverage:
        refusal.note(
            6, f"Only {100 * seen:.0f} % of the flange's edge was seen; {100 * config.min_coverage:.0f} % are needed."
        )
    elif outer.rms > rim_limit:
        refusal.note(
            6,
            f"The edge is too rough: {1e3 * outer.rms:.2f} mm rms from its circle, at most {1e3 * rim_limit:.2f} mm is allowed.",
        )
    elif standard.bore_m > 0 and inside > 0.4 * density:
        refusal.note(6, f"The disc found has no bore of {1e3 * standard.bore_m:.1f} mm: it is not the flange.")
    else:
        quality = seen + (1.0 if bore is not None else 0.0) - outer.rms / rim_limit
        return _Face(plane, outer, bore, seen, count, pitch, quality)
    return None


def _result(face: _Face) -> FlangeFit:
    axes = np.column_stack(plane_axes(face.plane.normal))
    circles = [face.outer] + ([face.bore] if face.bore is not None else [])
    center, cov = fuse([c.center for c in circles], [c.covariance[:2, :2] for c in circles])
    along = face.plane.rms**2 / face.plane.n_inliers + (face.plane.normal_sigma * float(np.linalg.norm(center))) ** 2
    normal = face.plane.normal
    point = face.plane.point + axes @ center
    normal = normal if float(normal @ point) < 0 else -normal
    n_rim = sum(int(c.inliers.sum()) for c in circles)
    rms = float(np.sqrt(sum(c.rms**2 * int(c.inliers.sum()) for c in circles) / n_rim))
    return FlangeFit(
        center_C=point,
        normal_C=normal,
        center_covariance=axes @ cov @ axes.T + along * np.outer(normal, normal),
        normal_sigma=face.plane.normal_sigma,
        plane_rms_m=face.plane.rms,
        rim_rms_m=rms,
        outer_radius_m=face.outer.radius,
        bore_radius_m=None if face.bore is None else face.bore.radius,
        n_points=face.n_points,
        n_rim=n_rim,
        coverage=face.coverage,
    )
