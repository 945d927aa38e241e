"""Fits the circle of a robot's base mounting in a scan that shows only an arc of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import CircleFitError, FlangeNotFound, PlaneFitError
from weldcal.calibration.flange.edge_labels import RayModel, refine_circle
from weldcal.calibration.flange.face import coverage, plane_axes
from weldcal.calibration.flange.fit import FlangeFit, FlangeGuess
from weldcal.calibration.flange.search import window_about
from weldcal.calibration.geometry.primitives import CircleFit, PlaneFit, fit_circle, fit_plane, local_planes
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

Mask = NDArray[np.bool_]

_TILT_RAD = 0.2  # between the guessed normal and a plane that is tried
_UPWARD_RAD = 0.4  # and the normal of a pixel's neighbourhood, which noise turns
_NORMAL_PX = 2
_FLAT_M = 8e-4  # of a plane, a choice: a few times a scanner's noise at 2 m; half misses a noisy ring
_PLANES = 6  # flat things about a robot's foot, its table among them
_STEP_M = 0.004  # what lies so far below the ring is off it
_SIDE_PX = 3  # pixels that a scanner may lose at the ring's edge
_BAND_PX = 3.0  # about the edge whose pixels place it


@dataclass(frozen=True)
class BaseCircleConfig:
    """Limits of the fit.

    ``radius_sigma_m``: uncertainty of the drawing's outer radius, which an arc determines badly; ``min_arc``: share of
    the edge that must be seen; ``min_points`` on the ring.
    """

    radius_sigma_m: float = 2.2e-4
    min_arc: float = 0.25
    min_points: int = 80
    seed: int = 0


@dataclass(frozen=True, eq=False)
class _View:
    """Hold a plane under the pixels of a window (h, w, 3): heights (h, w) m over it, its axes, thickness."""

    plane: PlaneFit
    axes: Array
    height: Array
    thick: float


def fit_base_circle(
    points_C: Array, standard: FlangeStandard, guess: FlangeGuess, config: BaseCircleConfig | None = None
) -> FlangeFit:
    """Find the ring in an organised cloud (H, W, 3) m, NaN where invalid, near a guess with its normal.

    The planes near the guess are tried in turn: on the right one the face ends in an arc of the drawn radius with
    something lower beyond it. The arc's centre is placed by its pixels, the radius held to the drawing as far as that
    is known. ``coverage`` is the share of the outer edge that was seen. Raises FlangeNotFound with the reason.
    """
    config = config or BaseCircleConfig()
    if guess.normal_C is None:
        raise FlangeNotFound("A base circle needs a guess with its normal: give normal_C.")
    part = window_about(points_C, guess.center_C, guess.radius_m, 1)
    window = None if part is None else points_C[part]
    valid = np.zeros((0, 0), dtype=bool) if window is None else np.isfinite(window[..., 2])
    if window is None or int(valid.sum()) < config.min_points:
        raise FlangeNotFound(f"Fewer than {config.min_points} valid points lie where the base circle is expected.")
    rays = RayModel(window, valid)
    rest = window[_upward(window, guess.normal_C)]
    rest = rest[np.linalg.norm(rest - guess.center_C, axis=1) < guess.radius_m]
    best: tuple[float, _View, CircleFit] | None = None
    for _ in range(_PLANES):
        plane = _parallel_plane(rest, guess.normal_C, standard, config)
        if plane is None:
            break
        view = _look(window, plane)
        found = _arc(window, view, rays, standard, config)
        if found is not None and (best is None or found[0] > best[0]):
            best = (found[0], view, found[1])
        if best is not None and best[0] > 2.0 * config.min_arc:
            break
        rest = rest[np.abs((rest - plane.point) @ plane.normal) > 0.002]
    if best is None:
        raise FlangeNotFound(
            f"No ring {1e3 * standard.outer_m:.0f} mm across with at least {100 * config.min_arc:.0f} % of its edge in "
            "sight was found where the robot's base is expected."
        )
    return _refine(window, best[1], best[2], rays, standard, config)


def _upward(window: Array, normal: Array) -> Mask:
    """Pixels (h, w) whose neighbours lie on a surface of about this normal: tables, rings and steps, no columns."""
    k = _NORMAL_PX
    across, down = np.full_like(window, np.nan), np.full_like(window, np.nan)
    across[:, k:-k] = window[:, 2 * k :] - window[:, : -2 * k]
    down[k:-k] = window[2 * k :] - window[: -2 * k]
    n = np.cross(across, down)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(n @ normal) > np.cos(_UPWARD_RAD) * np.linalg.norm(n, axis=2))


def _parallel_plane(
    points: Array, normal: Array, standard: FlangeStandard, config: BaseCircleConfig
) -> PlaneFit | None:
    """Return the best supported plane of about the guessed normal."""
    if len(points) < config.min_points:
        return None
    for p, n, _ in local_planes(
        points, reach=0.4 * standard.outer_m, tolerance=_FLAT_M, seed=config.seed, hypotheses=240, sample=900
    ):
        up = n if float(n @ normal) > 0.0 else -n
        if float(up @ normal) < np.cos(_TILT_RAD):
            continue
        close = points[np.linalg.norm(points - p, axis=1) < 0.6 * standard.outer_m]
        try:
            return fit_plane(close, (p, up), tolerance=3.0 * _FLAT_M)
        except PlaneFitError:
            continue
    return None


def _look(window: Array, plane: PlaneFit) -> _View:
    normal = plane.normal if float(plane.normal @ plane.point) < 0.0 else -plane.normal
    plane = PlaneFit(plane.point, normal, plane.rms, plane.n_inliers, plane.normal_sigma)
    height = (window - plane.point) @ normal
    return _View(plane, np.column_stack(plane_axes(normal)), height, max(3.0 * plane.rms, 2e-4))


def _arc(
    window: Array, view: _View, rays: RayModel, standard: FlangeStandard, config: BaseCircleConfig
) -> tuple[float, CircleFit] | None:
    """Return the arc of the drawn radius in which a face ends, and the share of the circle that it covers."""
    with np.errstate(invalid="ignore"):
        face, below = np.abs(view.height) < view.thick, view.height < -_STEP_M
    u, v = _ends(face, below)
    if len(u) < 12:
        return None
    xy, lowered = _places(u, v, view, rays)
    near = np.linalg.norm(xy, axis=1) < 3.0 * standard.outer_m
    if int(near.sum()) < 12:
        return None
    pitch = _pitch(window, view)
    radius, floor = standard.outer_radius_m, 0.3 * pitch
    try:
        circle = fit_circle(xy[near], radius=radius, noise_floor=floor, hypotheses=400, seed=config.seed)
        for _ in range(2):
            xy = _where_it_ends(xy, lowered, circle.center, view)
            circle = fit_circle(xy[near], radius=radius, initial=(circle.center, radius), noise_floor=floor)
    except CircleFitError:
        return None
    on = np.abs(np.linalg.norm(xy[near] - circle.center, axis=1) - circle.radius) < 1.5 * pitch
    seen = coverage(xy[near][on], circle.center)
    ring = _on_ring(window, view, circle, standard)
    if seen < config.min_arc or int(ring.sum()) < config.min_points:
        return None
    return seen, circle


def _ends(face: Mask, below: Mask) -> tuple[Array, Array]:
    """Pixels (u, v), halves included, where a row or column of the window passes from the face to something lower."""
    u, v = [], []
    for turned in (False, True):
        f, b = (face.T, below.T) if turned else (face, below)
        for ahead in (True, False):
            g, c = (f, b) if ahead else (f[:, ::-1], b[:, ::-1])
            for k in range(1, _SIDE_PX + 1):
                hit = g[:, :-k] & c[:, k:]
                for j in range(1, k):
                    hit &= ~g[:, j : j - k] & ~c[:, j : j - k]
                row, column = np.nonzero(hit)
                at = column + 0.5 * k
                at = at if ahead else f.shape[1] - 1 - at
                u.append(row if turned else at)
                v.append(at if turned else row)
    return np.concatenate(u).astype(float), np.concatenate(v).astype(float)


def _places(u: Array, v: Array, view: _View, rays: RayModel) -> tuple[Array, Array]:
    """Where the rays of pixels meet the plane, and one thickness below it (n, 2) m each, in the plane's axes."""
    p, n = view.plane.point, view.plane.normal
    low = p - view.thick * n
    return (rays.on_plane(u, v, p, n) - p) @ view.axes, (rays.on_plane(u, v, low, n) - p) @ view.axes


def _where_it_ends(xy: Array, lowered: Array, center: Array, view: _View) -> Array:
    """Places (n, 2) at which a face one thickness thick ends.

    On the scanner's side of the ring its upright side shows, and the face seems to end only where that is one thickness
    lower.
    """
    eye = -(view.plane.point + view.axes @ center) @ view.axes  # towards the scanner, in the plane
    return np.where(((xy - center) @ eye > 0.0)[:, None], lowered, xy)


def _pitch(window: Array, view: _View) -> float:
    """Distance (m) between neighbouring pixels on the plane, about."""
    with np.errstate(invalid="ignore"):
        face = np.abs(view.height) < view.thick
    both = face[:, 1:] & face[:, :-1]
    if not both.any():
        return 1e-3
    step = np.linalg.norm((window[:, 1:] - window[:, :-1])[both], axis=1)
    up = face[1:] & face[:-1]
    other = np.linalg.norm((window[1:] - window[:-1])[up], axis=1) if up.any() else step
    return float(np.sqrt(np.median(step) * np.median(other)))


def _on_ring(window: Array, view: _View, circle: CircleFit, standard: FlangeStandard) -> Mask:
    """Pixels (h, w) on the ring between its edges, a millimetre off either."""
    d = (window - view.plane.point) @ view.axes - circle.center
    rho = np.linalg.norm(d, axis=2)
    with np.errstate(invalid="ignore"):
        inside = (rho > standard.bore_radius_m + 0.001) & (rho < circle.radius - 0.001)
        return np.asarray(inside & (np.abs(view.height) < 2.0 * view.thick))


def _refine(
    window: Array, view: _View, circle: CircleFit, rays: RayModel, standard: FlangeStandard, config: BaseCircleConfig
) -> FlangeFit:
    """Plane and arc in turn, twice."""
    vv, uu = np.indices(window.shape[:2], dtype=float)
    for _ in range(2):
        points = window[_on_ring(window, view, circle, standard)]
        try:
            plane = fit_plane(points, (view.plane.point, view.plane.normal), tolerance=2.0 * view.thick)
        except PlaneFitError as e:
            raise FlangeNotFound(str(e)) from e
        center = view.plane.point + view.axes @ circle.center
        view = _look(window, plane)
        start = CircleFit(
            (center - view.plane.point) @ view.axes,
            standard.outer_radius_m,
            circle.covariance,
            circle.rms,
            circle.inliers,
        )
        pitch = _pitch(window, view)
        with np.errstate(invalid="ignore"):
            face, off = np.abs(view.height) < view.thick, view.height < -view.thick
            rough = np.linalg.norm((window - view.plane.point) @ view.axes - start.center, axis=2)
            near = (face | off) & (np.abs(rough - start.radius) < 0.02 + 4.0 * pitch)
        u, v = uu[near], vv[near]
        xy, lowered = _places(u, v, view, rays)
        xy = _where_it_ends(xy, lowered, start.center, view)
        band = np.abs(np.linalg.norm(xy - start.center, axis=1) - start.radius) < _BAND_PX * pitch
        try:
            fit = refine_circle(xy[band], face[near][band], start, pitch, outer=True)
        except CircleFitError as e:
            raise FlangeNotFound(f"The edge of the base circle does not fix it: {e}") from e
        circle = _held(fit, standard.outer_radius_m, config.radius_sigma_m)
    on_face = face[near][band]
    rho = np.linalg.norm(xy[band] - circle.center, axis=1)
    rim = on_face & (circle.radius - rho < 1.5 * pitch)
    seen = coverage(xy[band][rim], circle.center)
    if seen < config.min_arc:
        raise FlangeNotFound(f"Only {100 * seen:.0f} % of the base circle's edge is in the scan.")
    axes, plane = view.axes, view.plane
    along = plane.rms**2 / plane.n_inliers + (plane.normal_sigma * float(np.linalg.norm(circle.center))) ** 2
    return FlangeFit(
        center_C=plane.point + axes @ circle.center,
        normal_C=plane.normal,
        center_covariance=axes @ circle.covariance[:2, :2] @ axes.T + along * np.outer(plane.normal, plane.normal),
        normal_sigma=plane.normal_sigma,
        plane_rms_m=plane.rms,
        rim_rms_m=circle.rms,
        outer_radius_m=circle.radius,
        bore_radius_m=None,
        n_points=len(points),
        coverage=seen,
    )


def _held(fit: CircleFit, radius_m: float, sigma_m: float) -> CircleFit:
    """Return the circle with its radius held to the drawing by one more measurement of it."""
    C = fit.covariance
    gain = C[:, 2] / (C[2, 2] + sigma_m**2)
    change = gain * (radius_m - fit.radius)
    held = C - np.outer(gain, C[2])
    return CircleFit(
        fit.center + change[:2], fit.radius + float(change[2]), 0.5 * (held + held.T), fit.rms, fit.inliers
    )
