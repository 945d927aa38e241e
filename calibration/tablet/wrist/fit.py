"""Fits tablet, pen and camera together from full robot poses, touches and images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import least_squares

from weldcal.calibration.errors import TabletDataError
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.tablet.plane_pose import tablet_pose
from weldcal.calibration.tablet.touches import MIN_LANDMARKS, check_layout, check_turns
from weldcal.models.arrays import Array

_OPEN_PRIOR_M = 1.0  # of the pen's tip where nothing is known: far wider than any pen
_KNOWN_PRIOR_M = 0.5e-3  # of a pen length that an operator measured
UNSURE_M = 5e-3  # a pen's tip worse than this is not known
_LEAN = 3.0  # degrees of freedom that the scatter of all touches counts for
_TOUCH_FLOOR_M, _PIXEL_FLOOR = 1e-6, 1e-3  # keep exact data from dividing by zero


@dataclass(frozen=True)
class WristTouches:
    """Touches and images of one visit, SI units.

    ``X_BF`` flange in the base at each of n touches. ``touched_m`` and ``landmark_m`` (n, 2) on the tablet. ``views``:
    for each image the flange's pose when it was taken and the rays (n, 2) of the landmarks. ``focal_px`` of the camera
    (mean of both axes), which turns rays into pixels. ``tip_radius_m`` of a round pen tip, whose centre is what p_FP
    then means: however the pen leans, the centre stands that far above the point it touches.
    """

    X_BF: tuple[RigidTransform, ...]
    touched_m: Array
    landmark_m: Array
    views: tuple[tuple[RigidTransform, Array], ...]
    focal_px: float
    tip_radius_m: float = 0.0

    def pick(self, keep: NDArray[np.bool_]) -> WristTouches:
        """Return the same visit with these landmarks only."""
        poses = tuple(X for X, k in zip(self.X_BF, keep, strict=True) if k)
        views = tuple((X, rays[keep]) for X, rays in self.views)
        return WristTouches(poses, self.touched_m[keep], self.landmark_m[keep], views, self.focal_px, self.tip_radius_m)


@dataclass(frozen=True, kw_only=True)
class WristFit:
    """Camera ``X_FC`` and pen tip ``p_FP`` (3,) m on the flange, tablet ``X_BT`` in the base.

    ``joint_covariance`` (15, 15) of X_BT, p_FP and X_FC, from the residuals, a pose as [rotation; translation] on its
    left about its own origin; (9, 9) of the first two where there is no image. ``touch_residuals_m`` (n, 3),
    ``pixel_residuals`` (v, n, 2). ``leave_one_out_m`` (n,): how far the pen would touch from what the first image
    shows, in the tablet's plane, by a fit without that landmark; without an image, from where that fit has the
    landmark. ``unobservable``: sentences on what the touches left open.
    """

    X_FC: RigidTransform
    p_FP: Array
    X_BT: RigidTransform
    joint_covariance: Array
    touch_residuals_m: Array
    pixel_residuals: Array
    leave_one_out_m: Array
    unobservable: tuple[str, ...]

    @property
    def covariance(self) -> Array:
        """Of X_FC (6, 6), [rotation; translation] on the flange side about the camera's origin."""
        return self.joint_covariance[9:, 9:]

    @property
    def pen_covariance(self) -> Array:
        """Of p_FP (3, 3) m^2."""
        return self.joint_covariance[6:9, 6:9]


def fit_wrist(
    data: WristTouches,
    pen_length_m: float | None = None,
    *,
    X_FC: RigidTransform | None = None,
    leave_one_out: bool = True,
) -> WristFit:
    """Fit tablet, pen and camera together; ``pen_length_m`` along the flange's z where it is known.

    Start: touches are linear in two columns of R_BT, p_BT and p_FP; the camera follows from PnP. Then least squares
    over all fifteen unknowns, touches and pixels each weighted by their own scatter. With ``X_FC`` the camera has that
    pose, and touches give tablet and pen; it is for data without an image. Raises TooFewLandmarks, CollinearLandmarks,
    EqualRotations, LandmarksNotFound (PnP), TabletDataError (no image).
    """
    if not data.views and X_FC is None:
        raise TabletDataError("There is no image of the tablet; take at least one before touching.")
    check_layout(data.landmark_m)
    check_turns(_turns(data.X_BF))
    X_BT, p_FP = _start(data, pen_length_m)
    if X_FC is None:
        X_BF0, rays = data.views[0]
        X_FC = X_BF0.inverse() @ X_BT @ tablet_pose(rays, data.landmark_m).inverse()
    sigma_t, sigma_p = np.full(3, 0.3e-3), 0.3
    result, covariance = (X_BT, p_FP, X_FC), np.eye(15)
    for _ in range(3):
        result, covariance, touch, pixel = _refine(data, result, sigma_t, sigma_p, pen_length_m)
        sigma_t = _touch_sigmas(touch @ result[0].rotation().matrix())
        sigma_p = max(float(np.sqrt((pixel**2).sum() / max(pixel.size - 6, 1))), _PIXEL_FLOOR)
    X_BT, p_FP, X_FC = result
    fit = WristFit(
        X_FC=X_FC,
        p_FP=p_FP,
        X_BT=X_BT,
        joint_covariance=covariance,
        touch_residuals_m=touch,
        pixel_residuals=pixel,
        leave_one_out_m=np.full(len(data.X_BF), np.nan),
        unobservable=open_directions(data, covariance[6:9, 6:9]),
    )
    if not leave_one_out:
        return fit
    return replace(fit, leave_one_out_m=left_out(data, lambda d: fit_wrist(d, pen_length_m, leave_one_out=False)))


def left_out(data: WristTouches, fit: Callable[[WristTouches], WristFit]) -> Array:
    """Error (n,) m at each landmark by a fit to the others; NaN where they are too few."""
    n = len(data.X_BF)
    if n <= MIN_LANDMARKS:
        return np.full(n, np.nan)
    return np.array([_missed(fit(data.pick(np.arange(n) != i)), data, i) for i in range(n)])


def _touch_sigmas(touch_T: Array) -> Array:
    """Scatter (3,) m of touch residuals (n, 3) in the tablet's frame.

    In its plane as the glass feels, across it as the arm stands.

    Nine unknowns are the touches', six of them in the plane. Few touches say little of each: both lean to what all say.
    """
    n = len(touch_T)
    free, squares = (
        np.array([2.0 * n - 6.0, n - 3.0]),
        np.array([(touch_T[:, :2] ** 2).sum(), (touch_T[:, 2] ** 2).sum()]),
    )
    pooled = squares.sum() / max(free.sum(), 1.0)
    along, across = np.sqrt((squares + _LEAN * pooled) / (free + _LEAN))
    return np.maximum([along, along, across], _TOUCH_FLOOR_M)


def measured_point(fit: WristFit, X_BF: RigidTransform, ray: Array) -> Array:
    """Intersect a ray (2,) of the camera with the tablet's plane: a point (3,) m in the base.

    The flange is at ``X_BF``.
    """
    X_BC = X_BF @ fit.X_FC
    direction = X_BC.rotation().multiply(np.array([ray[0], ray[1], 1.0]))
    normal = fit.X_BT.rotation().matrix()[:, 2]
    depth = normal @ (fit.X_BT.translation() - X_BC.translation()) / (normal @ direction)
    return np.asarray(X_BC.translation() + depth * direction)


def _missed(fit: WristFit, data: WristTouches, i: int) -> float:
    """Distance m in the tablet's plane between where the pen stood and what the first image says of landmark i."""
    R = fit.X_BT.rotation().matrix()
    at = fit.X_BT.multiply(np.r_[data.landmark_m[i], 0.0])
    if data.views:
        X_BF0, rays = data.views[0]
        at = measured_point(fit, X_BF0, rays[i])
    off = data.X_BF[i].multiply(fit.p_FP) - (at + R[:, :2] @ (data.touched_m[i] - data.landmark_m[i]))
    return float(np.linalg.norm(R[:, :2].T @ off))


def _turns(poses: tuple[RigidTransform, ...]) -> Array:
    """Angle (n,) rad of each pose from the first, signed about the axis that they share best."""
    vectors = [(poses[0].rotation().inverse() @ X.rotation()).ToAngleAxis() for X in poses]
    turns = np.array([a.angle() * a.axis() for a in vectors])
    axis = np.linalg.svd(turns)[2][0] if np.abs(turns).max() > 0.0 else np.array([0.0, 0.0, 1.0])
    return np.asarray(turns @ axis)


def _axis_spread(poses: tuple[RigidTransform, ...]) -> float:
    """Largest angle (rad) between the flange's z axes."""
    z = np.array([X.rotation().matrix()[:, 2] for X in poses])
    return float(np.arccos(np.clip((z @ z.T).min(), -1.0, 1.0)))


def linear_system(data: WristTouches) -> tuple[Array, Array]:
    """Return a (3 n, 12) and b (3 n,) of R_BF p_FP + p_BF = r1 x + r2 y + p_BT in r1, r2, p_BT and p_FP, three each."""
    A = np.zeros((len(data.X_BF), 3, 12))
    for k, (X, (x, y)) in enumerate(zip(data.X_BF, data.touched_m, strict=True)):
        A[k, :, 0:3], A[k, :, 3:6], A[k, :, 6:9] = x * np.eye(3), y * np.eye(3), np.eye(3)
        A[k, :, 9:12] = -X.rotation().matrix()
    return A.reshape(-1, 12), np.concatenate([X.translation() for X in data.X_BF])


def _start(data: WristTouches, pen_length_m: float | None) -> tuple[RigidTransform, Array]:
    """Solve R_BF p_FP + p_BF = r1 x + r2 y + p_BT in closed form for twelve unknowns, the open ones at the prior."""
    A, b = linear_system(data)
    # columns to a like size, so that what is open is left at its prior and not shared out by units
    guess = np.r_[np.zeros(11), 0.0 if pen_length_m is None else pen_length_m]
    unit = np.r_[np.full(6, 1.0 / max(float(np.abs(data.touched_m).max()), 1e-6)), np.ones(6)]
    flat, rest = A * unit, b - A @ guess
    prior = 1e-4 * np.eye(12)[9:]
    x = guess + unit * np.linalg.lstsq(np.vstack([flat, prior]), np.r_[rest, np.zeros(3)], rcond=None)[0]
    U, _, Vt = np.linalg.svd(np.c_[x[0:3], x[3:6]], full_matrices=False)
    columns = U @ Vt
    R = RotationMatrix(np.c_[columns, np.cross(columns[:, 0], columns[:, 1])])
    return RigidTransform(R, x[6:9] + data.tip_radius_m * R.matrix()[:, 2]), x[9:12]


def _refine(
    data: WristTouches,
    start: tuple[RigidTransform, Array, RigidTransform],
    sigma_t: Array,
    sigma_p: float,
    pen_length_m: float | None,
) -> tuple[tuple[RigidTransform, Array, RigidTransform], Array, Array, Array]:
    """Least squares over (X_BT, p_FP, X_FC); returns them, their covariance (15, 15) and both kinds of residuals."""
    R_BT = start[0].rotation().matrix()
    spread = np.array([_OPEN_PRIOR_M] * 2 + [_OPEN_PRIOR_M if pen_length_m is None else _KNOWN_PRIOR_M])
    expected = np.array([0.0, 0.0, 0.0 if pen_length_m is None else pen_length_m])

    def moved(x: Array) -> tuple[RigidTransform, Array, RigidTransform]:
        return move(start[0], x[:6]), start[1] + x[6:9], move(start[2], x[9:]) if data.views else start[2]

    def residuals(x: Array) -> Array:
        touch, pixel = differences(data, *moved(x))
        pen = (start[1] + x[6:9] - expected) / spread
        return np.concatenate([(touch @ R_BT / sigma_t).ravel(), pixel.ravel() / sigma_p, pen])

    unit = np.r_[np.full(3, 1e-2), np.full(6, 1e-3), np.full(3, 1e-2), np.full(3, 1e-3)][: 15 if data.views else 9]
    found = least_squares(residuals, np.zeros(len(unit)), x_scale=unit, method="lm", xtol=1e-12, ftol=1e-12)
    result, J = moved(np.asarray(found.x)), np.asarray(found.jac, dtype=float)
    covariance = np.linalg.inv(J.T @ J)
    return result, covariance, *differences(data, *result)


def differences(data: WristTouches, X_BT: RigidTransform, p_FP: Array, X_FC: RigidTransform) -> tuple[Array, Array]:
    """Residuals of the touches (n, 3) m in the base, and of the images (v, n, 2) px."""
    touched = np.c_[data.touched_m, np.full(len(data.touched_m), -data.tip_radius_m)]
    landmarks = np.c_[data.landmark_m, np.zeros(len(data.landmark_m))]
    tip = np.array([X.multiply(p_FP) for X in data.X_BF])
    pixel = []
    for X_BF, rays in data.views:
        p_C = (X_FC.inverse() @ X_BF.inverse() @ X_BT).multiply(landmarks.T)
        pixel.append(data.focal_px * ((p_C[:2] / p_C[2]).T - rays))
    return tip - X_BT.multiply(touched.T).T, np.array(pixel)


def move(X: RigidTransform, x: Array) -> RigidTransform:
    """(exp(x_0..2) R, p + x_3..5)."""
    return RigidTransform(RotationMatrix(exp_rotation(x[:3])) @ X.rotation(), X.translation() + x[3:])


def open_directions(data: WristTouches, pen_covariance: Array) -> tuple[str, ...]:
    """Say what of the pen its covariance (3, 3) m^2 leaves open, and what to do."""
    values, vectors = np.linalg.eigh(pen_covariance)
    if np.sqrt(values[-1]) < UNSURE_M:
        return ()
    spread = _axis_spread(data.X_BF)
    axis = "xyz"[int(np.abs(vectors[:, -1]).argmax())]
    return (
        (
            f"The pen's length along the flange's {axis} and the camera's height over the pen's tip are not fixed by"
            f" these touches (the hand's axis tilts by {np.degrees(spread):.0f} deg): tilt the hand by 10 deg or more"
            " in some, or give the pen's length. Positions in the tablet's plane do not need it."
        ),
    )
