"""Fits camera and pen by linear least squares in six unknowns: an image-plane similarity and the pen offset."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import TooFewLandmarks
from weldcal.calibration.tablet.published.two_stage import Sign
from weldcal.calibration.tablet.touches import TabletTouches, check_touches, same_landmark
from weldcal.models.arrays import Array

LINEAR_NAMES = ("a", "b", "t_x", "t_y", "x_p", "y_p")
UNKNOWNS = len(LINEAR_NAMES)


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

    x, y are viewing rays at depth 1, C and S of the hand's turn. ``parameters`` (6,) = a, b, t_x, t_y, x_p, y_p, all m;
    ``covariance`` (6, 6) m^2 from the residuals; ``residuals_m`` and ``leave_one_out_m`` (n, 2): hand predicted minus
    measured, the second by a fit that never saw that landmark. ``scale``: fitted over measured depth (1 for a perfect
    depth camera). ``condition``: of the column-scaled design.
    """

    parameters: Array
    covariance: Array
    residuals_m: Array
    leave_one_out_m: Array
    sigma_m: float
    scale: float
    condition: float

    @property
    def pen_m(self) -> Array:
        """Pen tip from the hand's axis (2,) m, in the hand's frame."""
        return self.parameters[4:]

    def hand_to_touch(self, rays: Array, theta_rad: Array) -> Array:
        """Hand positions (m, 2) m from which the pen touches what is seen along rays (m, 2), at turns (m,) rad."""
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
    """The least squares itself, nothing checked: rays (2, n), hand (2, n) m, theta (n,) rad.

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
    """Leave-one-out errors (n, 2) m, all touches of a landmark held out together; NaN where the rest determines
    nothing."""
    errors = np.full((rays.shape[1], 2), np.nan)
    for k in range(number.max() + 1):
        keep, one = number != k, number == k
        flat = _design(rays[:, keep], theta_rad[keep]).reshape(-1, UNKNOWNS)
        if np.linalg.matrix_rank(flat) < UNKNOWNS:
            continue
        x = np.linalg.lstsq(flat, hand[:, keep].reshape(-1), rcond=None)[0]
        errors[one] = (_design(rays[:, one], theta_rad[one]) @ x - hand[:, one]).T
    return errors
