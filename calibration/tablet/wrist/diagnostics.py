"""Diagnoses touches from full robot poses: scale, single wrong landmarks, wrong order; refuses what does not fit."""

import dataclasses as dc

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.errors import TabletDataError
from weldcal.calibration.tablet.touches import MIN_LANDMARKS
from weldcal.calibration.tablet.wrist.fit import WristFit, WristTouches, linear_system

_SCALE_SIGMAS, _SCALE_LEAST = 3.0, 2.5e-3
_BAD_TOUCH_M, _BAD_PIXEL = 1.5e-3, 2.0  # residuals above these are no noise
_GOOD_TOUCH_M = 3e-3  # what the others must come to where one landmark alone is to blame
_LEAST_TO_DOUBT = 6  # landmarks
_BETTER = 0.4  # what a change must leave of the residuals to be told
_REFUSED_M = 3e-3  # derived below
"""Rms of the touches, or of the image on the page, beyond which nothing is written.

A touch scatters by 0.3 mm an axis and an arm is 1 mm off over a page: 1.1 mm together, of which nine touches exceed 2.1
times once in 1e9 (chi-square, 18 free).
"""
_BEHIND_M, _BEHIND_SIGMAS = 1e-2, 4.0  # how far behind the page the pen may seem to be when the picture is taken


def check_wrist(data: WristTouches, fit: WristFit, names: tuple[str, ...]) -> None:
    """Refuse a fit that is none: touches, poses and image that contradict each other; `names` of the landmarks.

    Raises:
        TabletDataError: with the likeliest cause.
    """
    touch = float(np.sqrt((fit.touch_residuals_m**2).sum(axis=1).mean()))
    if touch > _REFUSED_M:
        raise TabletDataError(f"{_why_touches(data, touch, names)} Nothing is written.")
    if not data.views:
        return
    X_BF, _ = data.views[0]
    X_TB = fit.X_BT.inverse()
    p_TC = (X_TB @ X_BF @ fit.X_FC).translation()
    across = float(X_TB.multiply(X_BF.multiply(fit.p_FP))[2])
    # by how much an open pen length moves the tip, where the flange leaned otherwise for the picture than for the
    # touches
    n_B = fit.X_BT.rotation().matrix()[:, 2]
    lean = n_B @ X_BF.rotation().matrix() - np.mean([n_B @ X.rotation().matrix() for X in data.X_BF], axis=0)
    unsure = float(np.sqrt(max(lean @ fit.pen_covariance @ lean, 0.0)))
    if -np.sign(p_TC[2]) * across > _BEHIND_M + _BEHIND_SIGMAS * unsure:
        raise TabletDataError(
            f"Camera and pen are on different sides of the page ({1e3 * abs(p_TC[2]):.0f} and {1e3 * abs(across):.0f}"
            " mm from it). The touches or the image are mirrored: check that x is before y in touches and landmarks,"
            " and u before v in the image."
        )
    pixel = float(np.sqrt((fit.pixel_residuals**2).sum(axis=-1).mean()))
    depth = float(np.linalg.norm(p_TC - np.r_[data.landmark_m.mean(axis=0), 0.0]))
    if pixel / data.focal_px * depth > _REFUSED_M:
        raise TabletDataError(f"{_why_pixels(pixel)} Nothing is written.")


def wrist_diagnostics(data: WristTouches, fit: WristFit, names: tuple[str, ...]) -> tuple[str, ...]:
    """Sentences for the result's warnings; `names` of the landmarks."""
    found = []
    scale, deviation = touched_scale(data)
    if abs(scale - 1.0) > max(_SCALE_SIGMAS * deviation, _SCALE_LEAST) and deviation < 0.02:
        found.append(
            f"Tablet and robot differ by {100 * (scale - 1.0):+.1f} % in length (deviation {100 * deviation:.1f} %):"
            " check the page's size with a card, or mm_per_px."
        )
    touch = float(np.sqrt((fit.touch_residuals_m**2).sum(axis=1).mean()))
    if touch > _BAD_TOUCH_M and not found:
        found.append(_why_touches(data, touch, names))
    pixel = float(np.sqrt((fit.pixel_residuals**2).sum(axis=-1).mean())) if data.views else 0.0
    if pixel > _BAD_PIXEL:
        found.append(_why_pixels(pixel))
    return tuple(found)


def touched_scale(data: WristTouches) -> tuple[float, float]:
    """How much farther the hand moved than the tablet says, by touches alone: (value, standard deviation).

    R p_FP + p_BF = x a + y b + p_BT is linear in a, b (3,), p_BT and p_FP; a and b are as long as the scale. Infinite
    deviation where the touches are too few for it, or leave the pen open.
    """
    n = len(data.X_BF)
    flat, b = linear_system(data)
    if len(b) <= flat.shape[1]:
        return 1.0, np.inf
    unit = 1.0 / np.maximum(np.linalg.norm(flat, axis=0), 1e-12)
    flat = flat * unit
    # an upright pen leaves its own length open, which no scale in the plane asks for
    N = np.linalg.pinv(flat.T @ flat, rcond=1e-10)
    v = N @ (flat.T @ b)
    e = flat @ v - b
    sigma2 = float(e @ e) / max(3 * n - np.linalg.matrix_rank(flat, tol=1e-5), 1)
    v, N = v * unit, sigma2 * N * np.outer(unit, unit)
    area = np.cross(v[0:3], v[3:6])
    scale = float(np.sqrt(np.linalg.norm(area)))
    if not scale > 0.0:
        return 1.0, np.inf
    z = area / np.linalg.norm(area)
    J = np.concatenate([np.cross(v[3:6], z), np.cross(z, v[0:3])]) / (2.0 * scale)
    return scale, float(np.sqrt(max(J @ N[:6, :6] @ J, 0.0)))


def _why_touches(data: WristTouches, left_m: float, names: tuple[str, ...]) -> str:
    """Return the likeliest cause of touches that do not fit, in a sentence."""
    plain = f"The touches fit to {1e3 * left_m:.1f} mm only"
    if len(names) >= _LEAST_TO_DOUBT:
        without = [_misfit(data.pick(np.arange(len(names)) != k)) for k in range(len(names))]
        worst = int(np.argmin(without))
        if without[worst] < min(_BETTER * left_m, _GOOD_TOUCH_M):  # else more than one of them is wrong
            return (
                f"{plain}, without landmark {names[worst]} to {1e3 * without[worst]:.2f}: touch it again or exclude it."
            )
    changed = {
        "the quaternions' w where z is written": tuple(_rolled(X, 1) for X in data.X_BF),
        "the quaternions' w where x is written": tuple(_rolled(X, -1) for X in data.X_BF),
        "poses that are inverted: they are of the flange in the base": tuple(X.inverse() for X in data.X_BF),
    }
    for what, poses in changed.items():
        left = _misfit(dc.replace(data, X_BF=poses))
        if left < _BETTER * left_m:
            return f"{plain}, to {1e3 * left:.2f} mm with {what}. Check the file."
    return f"{plain}: check that poses and touches belong to the same landmarks, and that the tablet did not move."


def _why_pixels(pixel: float) -> str:
    return (
        f"The image shows the landmarks {pixel:.1f} px from the positions of the fit: check the camera's intrinsics,"
        " its distortion, and that image and page belong together."
    )


def _misfit(data: WristTouches) -> float:
    """Rms distance (m) that the best affine plane and pen leave between touches and hands.

    Infinite where they are too few.
    """
    n = len(data.X_BF)
    if n < MIN_LANDMARKS + 1:
        return np.inf
    flat, b = linear_system(data)
    e = flat @ np.linalg.lstsq(flat, b, rcond=1e-8)[0] - b
    return float(np.sqrt(e @ e / n))


def _rolled(X: RigidTransform, places: int) -> RigidTransform:
    """Return the pose whose quaternion's numbers stand so many places off their columns w, x, y, z."""
    wxyz = np.roll(X.rotation().ToQuaternion().wxyz(), places)
    return RigidTransform(RotationMatrix(Quaternion(wxyz)), X.translation())
