"""The sphere paper's method: X_FS from sphere centres in two linear steps, then compensation by touches.

Kept as published, beside sphere_joint, which needs neither the side of the centre nor the pure translations.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from weldcal.calibration.errors import DegenerateMotion, RadiusError, TooFewRotations, TooFewTranslations
from weldcal.calibration.geometry.se3 import exp_rotation, nearest_rotation
from weldcal.calibration.profiler.motion import FlangePoses, Floats, rotation_axes_spread
from weldcal.models.errors import InputError

RADIUS_TOLERANCE_M = 0.2e-3  # a choice: three times the radius error at the paper's noise (0.035 to 0.067 mm)
PLANAR = 0.05  # second over first singular value of the translations
ONE_AXIS = 0.02  # ratio of singular values, a choice as PLANAR: below, the error along the axis is 50 times that across
MINIMUM_TOUCHES = 4
ONE_SPOT = 0.05  # of the radius: rms of the touches across the plane through them
CLEARLY = 0.7  # of the spread that is left when a side is mirrored


@dataclass(frozen=True, eq=False)
class SphereLinear:
    """R_FS (3, 3) and p_FS (3,) m."""

    rotation: Floats
    translation: Floats


@dataclass(frozen=True, eq=False)
class TouchSphere:
    """A sphere felt with the tip.

    Its centre (3,) m in B, the tip (3,) m in F, the radius and the rms of the touches in m.
    """

    center: Floats
    tip: Floats
    radius_m: float
    rms_m: float


def sphere_center(circle: ArrayLike, radius_m: float, sign: float) -> Floats:
    """Centre (3,) m in S of the sphere whose cut is the circle [x, z, r] m.

    Sign: on which side of the scan plane (y) it is.

    Raises:
        RadiusError: the cut is larger than the sphere.
    """
    x, z, r = np.asarray(circle, float)
    if r > radius_m + RADIUS_TOLERANCE_M:
        raise RadiusError(
            f"An arc of radius {1e3 * r:.2f} mm is no cut of a sphere of {1e3 * radius_m:.2f} mm: check the sphere's"
            " radius."
        )
    return np.array([x, np.sign(sign) * np.sqrt(max(radius_m**2 - r**2, 0.0)), z])


def sphere_linear(
    rotation: ArrayLike, translation: ArrayLike, centers: ArrayLike, translated: ArrayLike
) -> SphereLinear:
    """Rotation from the poses of one orientation (SVD), translation from all by linear least squares.

    Args:
        rotation: (n, 3, 3) R_BF; translation: (n, 3) p_BF m; centers: (n, 3) sphere centres in S, m.
        translated: (n,) bool, which poses share the first one's orientation.

    Raises:
        TooFewTranslations, TooFewRotations, DegenerateMotion: the motion does not determine the answer. InputError:
            shapes.

    Source: sphere and touch paper, Eq. 2-8.
    """
    poses = FlangePoses.checked(rotation, translation)
    P, moved = np.asarray(centers, float), np.asarray(translated, bool)
    if P.shape != (len(poses), 3) or moved.shape != (len(poses),):
        raise InputError(
            f"{len(poses)} poses need centres ({len(poses)}, 3) and as many marks, not {P.shape} and {moved.shape}."
        )
    if moved.sum() < 4:
        raise TooFewTranslations(f"{moved.sum()} poses of one orientation are too few: take 4 or more, not on a line.")
    R_BF, p_BF = poses.rotation[moved], poses.translation[moved]
    shifts = (p_BF[0] - p_BF[1:]) @ R_BF[0]
    s = np.linalg.svd(shifts, compute_uv=False)
    if s[1] < PLANAR * s[0]:
        raise DegenerateMotion("The poses of one orientation lie on a line: move the flange in a plane or in space.")
    free = poses.rotation[~moved]
    if len(free) < 2:
        raise TooFewRotations(
            f"{len(free)} poses of other orientations are too few: take 2 or more, about different axes."
        )
    if rotation_axes_spread(np.concatenate([R_BF[:1], free])) < ONE_AXIS:
        raise DegenerateMotion(
            "The flange turns about one axis only, which leaves the translation along it open: tilt it as well."
        )
    R = nearest_rotation(shifts.T @ (P[moved][1:] - P[moved][0]))
    seen = np.einsum("nij,nj->ni", poses.rotation, P @ R.T) + poses.translation
    first = int(np.flatnonzero(moved)[0])
    A = (poses.rotation[first] - poses.rotation).reshape(-1, 3)
    t = np.linalg.lstsq(A, (seen - seen[first]).ravel(), rcond=None)[0]
    return SphereLinear(np.asarray(R), t)


def wrong_sides(
    rotation: ArrayLike, translation: ArrayLike, centers: ArrayLike, translated: ArrayLike
) -> tuple[int, ...]:
    """Return the scans whose centre is not on the stated side of the scan plane.

    With it mirrored, all centres agree far better.

    One after the other, the most telling first, as long as each helps by itself: one wrong side is found, several may
    not be, and all of them wrong cannot be told. Arguments as for `sphere_linear`.
    """
    P = np.array(centers, float)
    found: list[int] = []
    spread = _spread(rotation, translation, P, translated)
    while len(found) < len(P) // 4:
        trials = []
        for k in range(len(P)):
            P[k, 1] *= -1.0
            trials.append(_spread(rotation, translation, P, translated))
            P[k, 1] *= -1.0
        k = int(np.argmin(trials))
        if k in found or not trials[k] < CLEARLY * spread:
            break
        found.append(k)
        P[k, 1] *= -1.0
        spread = trials[k]
    return tuple(sorted(found))


def _spread(rotation: ArrayLike, translation: ArrayLike, centers: Floats, translated: ArrayLike) -> float:
    """Rms distance m of the centres in B from their mean, by the linear method itself."""
    e = sphere_linear(rotation, translation, centers, translated)
    at = np.einsum("nij,nj->ni", np.asarray(rotation, float), centers @ e.rotation.T + e.translation)
    at = at + np.asarray(translation, float)
    return float(np.sqrt(np.mean(np.sum((at - at.mean(axis=0)) ** 2, axis=1))))


def fit_touch_sphere(
    rotation: ArrayLike,
    translation: ArrayLike,
    tip: ArrayLike,
    radius_m: float,
    *,
    solve_tip: bool = False,
    solve_radius: bool = False,
) -> TouchSphere:
    """Return the sphere that the tip touched, and on wish the tip (orientations must vary) or the radius with it.

    Args:
        rotation: (n, 3, 3) R_BF; translation: (n, 3) p_BF m, at each touch; tip: (3,) m in F, as far as it is known.

    Raises:
        InputError: fewer than four touches. DegenerateMotion: the touches lie on one spot or circle, or the tip is
            asked for and the orientations do not vary.
        RadiusError: the freed radius is off by more than four of its sigmas.
    """
    poses = FlangePoses.checked(rotation, translation)
    if len(poses) < MINIMUM_TOUCHES + 3 * solve_tip + solve_radius:
        raise InputError(
            f"{len(poses)} touches are too few: touch the sphere all around, {MINIMUM_TOUCHES + 4} times or more."
        )
    if solve_tip and rotation_axes_spread(poses.rotation) < ONE_AXIS:
        raise DegenerateMotion(
            "The tip cannot be solved: the flange has one orientation in all touches. Tilt it between touches."
        )
    tip_0 = np.asarray(tip, float)
    at = np.einsum("nij,j->ni", poses.rotation, tip_0) + poses.translation
    A = np.column_stack([2.0 * at, np.ones(len(at))])
    start = np.linalg.lstsq(A, np.einsum("ni,ni->n", at, at), rcond=None)[0][:3]

    out = at - start
    singular = np.linalg.svd(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9), compute_uv=False)
    spread = np.linalg.svd(at - at.mean(axis=0), compute_uv=False)[-1] / (np.sqrt(len(at)) * radius_m)
    if not (singular[-1] > ONE_SPOT * singular[0] and spread > ONE_SPOT):
        raise DegenerateMotion(
            "The touches lie on one spot or one circle of the sphere, which leaves its centre open: touch it from above"
            " and all around."
        )

    def unpack(x: Floats) -> tuple[Floats, Floats, float]:
        return x[:3], tip_0 + (x[3:6] if solve_tip else 0.0), radius_m + (x[-1] if solve_radius else 0.0)

    def residual(x: Floats) -> Floats:
        c, t, r = unpack(x)
        return np.asarray(np.linalg.norm(np.einsum("nij,j->ni", poses.rotation, t) + poses.translation - c, axis=1) - r)

    found = least_squares(
        residual, np.concatenate([start, np.zeros(3 * solve_tip + solve_radius)]), method="lm", x_scale=1e-2
    )
    center, t, r = unpack(found.x)
    freedom = max(len(poses) - len(found.x), 1)
    rms = float(np.sqrt(np.mean(found.fun**2)))
    if solve_radius:
        J = np.asarray(found.jac)
        sigma = float(np.sqrt(np.linalg.pinv(J.T @ J)[-1, -1] * (found.fun @ found.fun) / freedom))
        if abs(r - radius_m) > max(4.0 * sigma, 1e-6):
            text = (
                f"The touches fit a sphere of {1e3 * r:.3f} mm, not of {1e3 * radius_m:.3f} mm: check the radius and"
                " the tip."
            )
            raise RadiusError(text)
    return TouchSphere(np.asarray(center), np.asarray(t), float(r), rms)


def compensate(
    start: SphereLinear, rotation: ArrayLike, translation: ArrayLike, centers: ArrayLike, touched: ArrayLike
) -> SphereLinear:
    """Fit the paper's compensation (Eq. 9): six parameters from measured centres (n, 3) to the touched one (3,)."""
    poses = FlangePoses.checked(rotation, translation)
    P, c = np.asarray(centers, float), np.asarray(touched, float)

    def moved(x: Floats) -> tuple[Floats, Floats]:
        return exp_rotation(x[:3]) @ start.rotation, start.translation + x[3:]

    def residual(x: Floats) -> Floats:
        R, t = moved(x)
        return np.asarray((np.einsum("nij,nj->ni", poses.rotation, P @ R.T + t) + poses.translation - c).ravel())

    found = least_squares(residual, np.zeros(6), method="lm", x_scale=[1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    return SphereLinear(*moved(found.x))
