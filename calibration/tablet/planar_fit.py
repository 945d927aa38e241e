"""Fit camera and pen to planar touches: by linear least squares, or by the tablet's known size with PnP."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.optimize import minimize
from scipy.special import log_ndtr

from weldcal.calibration.errors import CollinearLandmarks, LandmarksNotFound, TooFewLandmarks
from weldcal.calibration.tablet.plane_pose import tablet_points, tablet_pose
from weldcal.calibration.tablet.published import Sign
from weldcal.calibration.tablet.touches import MIN_LANDMARKS, TabletTouches, check_touches, same_landmark
from weldcal.models.arrays import Array

LINEAR_NAMES = ("a", "b", "t_x", "t_y", "x_p", "y_p")
UNKNOWNS = len(LINEAR_NAMES)

PLANAR_NAMES = ("phi", "t_x", "t_y", "x_p", "y_p", "scale")


@dataclass(frozen=True)
class ClosedForm:
    """Bare result: ``parameters`` (6,) m, ``normal_inverse`` (6, 6), ``residuals`` and ``leave_one_out`` (2, n) m."""

    parameters: Array
    normal_inverse: Array
    residuals: Array
    leave_one_out: Array


@dataclass(frozen=True, kw_only=True)
class LinearFit:
    """Six-parameter calibration: hand = [a x - b y + t_x + x_p C - y_p S, -b x - a y + t_y - x_p S - y_p C].

    ``x``, y are viewing rays at depth 1, C and S of the hand's turn. ``parameters`` (6,) = a, b, t_x, t_y, x_p, y_p,
    all m. ``covariance`` (6, 6) m^2 from the residuals. ``residuals_m`` and ``leave_one_out_m`` (n, 2): hand predicted
    minus measured, the second by a fit that never saw that landmark. ``scale``: fitted over measured depth (1 for a
    perfect depth camera). ``condition``: of the column-scaled design.
    """

    parameters: Array
    covariance: Array
    residuals_m: Array
    leave_one_out_m: Array
    sigma_m: float
    scale: float
    condition: float

    def hand_to_touch(self, rays: Array, theta_rad: Array) -> Array:
        """Return hand positions (m, 2) m from which the pen touches the points on rays (m, 2), at turns (m,) rad."""
        return np.asarray((_design(rays.T, theta_rad) @ self.parameters).T)


def _design(rays: Array, theta_rad: Array) -> Array:
    """(2, n, 6): rows of x, then of y, for rays (2, n)."""
    A = np.zeros((2, rays.shape[1], UNKNOWNS))
    cos, sin = np.cos(theta_rad), np.sin(theta_rad)
    A[0, :, 0], A[0, :, 1] = rays[0], -rays[1]
    A[1, :, 0], A[1, :, 1] = -rays[1], -rays[0]
    A[0, :, 2] = A[1, :, 3] = 1.0
    A[0, :, 4], A[0, :, 5] = cos, -sin
    A[1, :, 4], A[1, :, 5] = -sin, -cos
    return A


def solve_closed_form(rays: Array, hand: Array, theta_rad: Array) -> ClosedForm:
    """Return the least squares itself, nothing checked: rays (2, n), hand (2, n) m, theta (n,) rad.

    Normal equations: with rays instead of millimetres the design's condition is below 1e2, so that squaring it costs
    four of sixteen digits. Left-out errors come from the leverages: e_i of the fit without both rows of landmark i is
    (I - H_ii)^-1 e_i.
    """
    A = _design(rays, theta_rad)
    flat = A.reshape(-1, UNKNOWNS)
    N = np.linalg.inv(flat.T @ flat).astype(float, copy=False)
    x = N @ (hand.reshape(-1) @ flat)
    e = A @ x - hand
    AN = A @ N
    h_xx, h_yy = (AN[0] * A[0]).sum(axis=1), (AN[1] * A[1]).sum(axis=1)
    h_xy = (AN[0] * A[1]).sum(axis=1)
    m_xx, m_yy = 1.0 - h_xx, 1.0 - h_yy
    left_out = np.array([m_yy * e[0] + h_xy * e[1], h_xy * e[0] + m_xx * e[1]]) / (m_xx * m_yy - h_xy * h_xy)
    return ClosedForm(x, N, e, left_out)


def touched_rays(touches: TabletTouches, sign: Sign = Sign.CORRECTED) -> Array:
    """Viewing rays (n, 2) of the points that were touched: the landmark's ray moved by the touching error.

    The move is turned into the image by the affine map from tablet to rays that the landmarks themselves give, so that
    no parameter of the calibration is needed for it. With the printed sign of Eq. 20 it goes the other way.
    """
    n = len(touches.uv_px)
    affine = np.linalg.lstsq(np.c_[touches.landmark_px, np.ones(n)], touches.rays, rcond=None)[0]
    return np.asarray(touches.rays - sign * touches.delta_px @ affine[:2])


def fit_linear(touches: TabletTouches, sign: Sign = Sign.CORRECTED) -> LinearFit:
    """Calibrate from planar touches with an upright pen; one plane, so its depth is part of the scale.

    Raises what check_touches raises (TooFewLandmarks, CollinearLandmarks, EqualRotations), and TooFewLandmarks where a
    left-out landmark would leave fewer than six equations.
    """
    check_touches(touches)
    n = len(touches.uv_px)
    rays = touched_rays(touches, sign).T
    found = solve_closed_form(rays, touches.hand_m.T, touches.theta_rad)
    if not np.isfinite(found.leave_one_out).all():
        raise TooFewLandmarks("One landmark alone fixes a part of the calibration; touch more landmarks.")
    left_out, number = found.leave_one_out.T, same_landmark(touches.landmark_px)
    if number.max() + 1 < n:  # a landmark touched twice: the leverages of one touch would leave the other in
        left_out = _left_out_together(rays, touches.hand_m.T, touches.theta_rad, number)
    dof = 2 * n - UNKNOWNS
    sigma = float(np.sqrt((found.residuals**2).sum() / dof))
    flat = _design(rays, touches.theta_rad).reshape(-1, UNKNOWNS)
    scale = float(np.hypot(*found.parameters[:2]) / touches.depth_m.mean())
    return LinearFit(
        parameters=found.parameters,
        covariance=sigma**2 * found.normal_inverse,
        residuals_m=found.residuals.T,
        leave_one_out_m=left_out,
        sigma_m=sigma,
        scale=scale,
        condition=float(np.linalg.cond(flat / np.linalg.norm(flat, axis=0))),
    )


def _left_out_together(rays: Array, hand: Array, theta_rad: Array, number: NDArray[np.int64]) -> Array:
    """Leave-one-out errors (n, 2) m, all touches of a landmark held out together.

    NaN where the rest determines nothing.
    """
    errors = np.full((rays.shape[1], 2), np.nan)
    for k in range(number.max() + 1):
        keep, one = number != k, number == k
        flat = _design(rays[:, keep], theta_rad[keep]).reshape(-1, UNKNOWNS)
        if np.linalg.matrix_rank(flat) < UNKNOWNS:
            continue
        x = np.linalg.lstsq(flat, hand[:, keep].reshape(-1), rcond=None)[0]
        errors[one] = (_design(rays[:, one], theta_rad[one]) @ x - hand[:, one]).T
    return errors


@dataclass(frozen=True, kw_only=True)
class PlanarFit:
    """Calibration by the tablet's own size: hand = scale M(phi) p + t + pen(theta), M = [[c, s], [s, -c]].

    ``p``: point of the tablet (m) that a pixel shows by ``X_CT``. ``parameters`` (6,) = phi (rad), t_x, t_y, x_p, y_p
    (m), scale (1 unless it was freed). ``covariance`` (6, 6) from the residuals of the touches, zero for a fixed scale.
    ``residuals_m`` and ``leave_one_out_m`` (n, 2): hand predicted from the image minus measured, the second by a fit
    that saw that landmark neither touched nor in the image. ``free_scale``: (value, standard deviation) of a scale that
    the touches alone would like, a check of the tablet's pixels per inch.
    """

    X_CT: RigidTransform
    parameters: Array
    covariance: Array
    residuals_m: Array
    leave_one_out_m: Array
    sigma_m: float
    free_scale: tuple[float, float]

    def hand_to_touch(self, rays: Array, theta_rad: Array) -> Array:
        """Return hand positions (m, 2) m from which the pen touches the points on rays (m, 2), at turns (m,) rad."""
        return hand_over(self.parameters, tablet_points(self.X_CT, rays), theta_rad)


@dataclass(frozen=True)
class PlanarConfig:
    """``sign`` of the touching error; ``free_scale`` where the tablet's pixel pitch is not to be trusted.

    ``step_m`` to which the hand's position was rounded when it was read off (0: not), and ``noise_m`` per axis of a
    touch besides.
    """

    sign: Sign = Sign.CORRECTED
    free_scale: bool = False
    step_m: float = 0.0
    noise_m: float = 0.15e-3


def hand_over(parameters: Array, points_m: Array, theta_rad: Array) -> Array:
    """Hand (m, 2) m whose pen touches points of the tablet (m, 2) m, for parameters (6,)."""
    phi, t, pen, scale = parameters[0], parameters[1:3], parameters[3:5], parameters[5]
    c, s = np.cos(phi), np.sin(phi)
    return np.asarray(scale * points_m @ np.array([[c, s], [s, -c]]) + t + _pen_matrix(theta_rad) @ pen)


def fit_plane_motion(points_m: Array, hand_m: Array, theta_rad: Array, free_scale: bool = False) -> Array:
    """Parameters (6,) minimising the squared differences of hand_over to ``hand_m`` (n, 2) m.

    Translation and pen are linear and projected out. What remains is a quadratic in scale (cos phi, sin phi): solved as
    it is with a free scale, else on the unit circle by Newton's method in phi.
    """
    n = len(points_m)
    B = np.concatenate([np.broadcast_to(np.eye(2), (n, 2, 2)), _pen_matrix(theta_rad)], axis=2).reshape(2 * n, 4)
    x, y = points_m[:, 0], points_m[:, 1]
    D = np.stack([np.c_[x, -y], np.c_[y, x]], axis=2).reshape(2 * n, 2)
    r = hand_m.reshape(-1)
    Q = np.linalg.qr(B)[0]
    D_free, r_free = D - Q @ (Q.T @ D), r - Q @ (Q.T @ r)
    G, g = D_free.T @ D_free, D_free.T @ r_free
    z = np.linalg.solve(G, g)
    phi = np.arctan2(z[1], z[0])
    if not free_scale:
        for _ in range(20):
            c, s = np.array([np.cos(phi), np.sin(phi)]), np.array([-np.sin(phi), np.cos(phi)])
            step = -(s @ (G @ c - g)) / (s @ G @ s - c @ (G @ c - g))
            phi += step
            if abs(step) < 1e-15:
                break
        z = np.array([np.cos(phi), np.sin(phi)])
    rest = np.linalg.lstsq(B, r - D @ z, rcond=None)[0]
    return np.asarray(np.r_[np.arctan2(z[1], z[0]), rest, np.hypot(*z)])


def refine_rounded(start: Array, points_m: Array, hand_m: Array, theta_rad: Array, config: PlanarConfig) -> Array:
    """Parameters (6,) most likely for hands that were read off in steps of ``config.step_m``.

    A rounded reading says "within half a step", which squares do not: the likelihood is the rounding's interval
    smoothed by a normal error of ``noise_m``. On hands in whole millimetres it takes 4 to 10 % off the error of least
    squares.
    """
    half, noise = 0.5 * config.step_m, config.noise_m
    free = slice(0, 6 if config.free_scale else 5)
    unit = np.array([1e-2, 1e-3, 1e-3, 1e-3, 1e-3, 1e-2])[free]

    def parameters(y: Array) -> Array:
        return np.asarray(np.r_[start[free] + y * unit, start[free.stop :]])

    def objective(y: Array) -> tuple[float, Array]:
        p = parameters(y)
        e = hand_over(p, points_m, theta_rad) - hand_m
        near, far = (half - np.abs(e)) / noise, (-half - np.abs(e)) / noise
        log_near = log_ndtr(near)
        log_p = log_near + np.log1p(-np.exp(log_ndtr(far) - log_near))
        slope = (np.exp(_log_density(near) - log_p) - np.exp(_log_density(far) - log_p)) / noise * np.sign(e)
        J = _jacobian(p, points_m, theta_rad)[:, :, free]
        return -float(log_p.sum()), np.asarray((slope[:, :, None] * J).sum(axis=(0, 1)) * unit)

    return parameters(np.asarray(minimize(objective, np.zeros(len(unit)), jac=True, method="BFGS").x))


def _log_density(x: Array) -> Array:
    """Of the normal distribution."""
    return np.asarray(-0.5 * x * x - 0.5 * np.log(2.0 * np.pi))


def fit_planar(touches: TabletTouches, config: PlanarConfig | None = None, *, leave_one_out: bool = True) -> PlanarFit:
    """Calibrate from planar touches with an upright pen by the tablet's own size; measured depths are not used.

    ``leave_one_out`` repeats the whole fit without each landmark in turn (NaN where it is off, or where four are left).
    Raises what check_touches and tablet_pose raise.
    """
    config = config or PlanarConfig()
    check_touches(touches)
    n = len(touches.uv_px)
    X_CT, parameters = _fit(touches, config)
    left_out = np.full((n, 2), np.nan)
    number = same_landmark(touches.landmark_px)
    if leave_one_out and number.max() + 1 > MIN_LANDMARKS:
        for k in range(number.max() + 1):
            one = touches.pick(number == k)
            try:
                found = _fit(touches.pick(number != k), config)
            except (CollinearLandmarks, LandmarksNotFound):  # this landmark alone spans the plane
                continue
            left_out[number == k] = _predict(*found, one, config.sign) - one.hand_m
    touched = _touched(touches, config.sign)
    error = hand_over(parameters, touched, touches.theta_rad) - touches.hand_m
    unknowns = 6 if config.free_scale else 5
    sigma = float(np.sqrt((error**2).sum() / (2 * n - unknowns)))
    J = _jacobian(parameters, touched, touches.theta_rad).reshape(2 * n, 6)
    covariance = np.zeros((6, 6))
    covariance[:unknowns, :unknowns] = sigma**2 * np.linalg.inv(J[:, :unknowns].T @ J[:, :unknowns])
    free = fit_plane_motion(touched, touches.hand_m, touches.theta_rad, free_scale=True)
    free_error = hand_over(free, touched, touches.theta_rad) - touches.hand_m
    scatter = np.sqrt((free_error**2).sum() / (2 * n - 6) * np.linalg.inv(J.T @ J)[5, 5])
    return PlanarFit(
        X_CT=X_CT,
        parameters=parameters,
        covariance=covariance,
        residuals_m=_predict(X_CT, parameters, touches, config.sign) - touches.hand_m,
        leave_one_out_m=left_out,
        sigma_m=sigma,
        free_scale=(float(free[5]), float(scatter)),
    )


def _fit(touches: TabletTouches, config: PlanarConfig) -> tuple[RigidTransform, Array]:
    touched = _touched(touches, config.sign)
    parameters = fit_plane_motion(touched, touches.hand_m, touches.theta_rad, config.free_scale)
    if config.step_m > 0.0:
        parameters = refine_rounded(parameters, touched, touches.hand_m, touches.theta_rad, config)
    return tablet_pose(touches.rays, touches.landmark_m), parameters


def _touched(touches: TabletTouches, sign: Sign) -> Array:
    """Touched points (n, 2) m of the tablet."""
    return touches.pitch_m * (touches.landmark_px - sign * touches.delta_px)


def _predict(X_CT: RigidTransform, parameters: Array, touches: TabletTouches, sign: Sign) -> Array:
    """Hand (n, 2) m for the touched points as the image shows the landmarks."""
    seen = tablet_points(X_CT, touches.rays) - sign * touches.pitch_m * touches.delta_px
    return hand_over(parameters, seen, touches.theta_rad)


def _pen_matrix(theta_rad: Array) -> Array:
    """(n, 2, 2): hand minus tip (Eqs. 7 and 8) as a map of the pen's offset."""
    c, s = np.cos(theta_rad), np.sin(theta_rad)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([-s, -c], axis=-1)], axis=-2)


def _jacobian(parameters: Array, points_m: Array, theta_rad: Array) -> Array:
    """(n, 2, 6) of hand_over."""
    c, s, scale = np.cos(parameters[0]), np.sin(parameters[0]), parameters[5]
    turn = scale * points_m @ np.array([[-s, c], [c, s]])
    grow = points_m @ np.array([[c, s], [s, -c]])
    identity = np.broadcast_to(np.eye(2), (len(points_m), 2, 2))
    return np.concatenate([turn[:, :, None], identity, _pen_matrix(theta_rad), grow[:, :, None]], axis=2)
