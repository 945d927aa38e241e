"""Advises which poses to add and when to stop, from what the poses so far leave uncertain."""

from collections.abc import Sequence

import numpy as np

from weldcal.calibration.eye_on_base.solve import CalibrationEstimate, point_error_covariance
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.planning.observability import has_orientations, turn_deg
from weldcal.models.arrays import Array

_TURN_DEG = 15.0  # orientations that differ by less hardly tell a bias of the centre from a shift of the camera
_FLAT = 0.25  # of the widest spread of positions: less in a direction leaves the rotation about the others weak
_WEAK_FACTOR = 1.5  # of the error in the middle: a corner that is worse is worth a pose
_FEW = 4
_LITTLE = 0.1  # gain by one more pose, as a share of the error, that is not worth a scan


def sampling_advice(
    estimate: CalibrationEstimate, observations: Sequence[Observation], *, required_m: float | None = None
) -> tuple[str, ...]:
    """Advice from an estimate and the observations that made it (outliers are ignored).

    It names the directions in which positions vary too little, and whether orientations vary. It also names where in
    the poses' own field a scanned point is worst known, and the gain of one more pose like these. With ``required_m``
    (standard deviation of a scanned point, 3-D) it says when that is reached. Distances in B.
    """
    used = [o for o, keep in zip(observations, estimate.inliers, strict=True) if keep]
    if len(used) < 2:
        return ("Add poses: fewer than two can be used.",)
    p = np.array([o.p_BR for o in used])
    middle = p.mean(axis=0)
    spread = np.linalg.svd(p - middle, full_matrices=False)
    width = spread[1] / np.sqrt(len(used))
    out = []
    if len(used) < _FEW:
        out.append(f"Add poses, to {_FEW} at least, whose flange centres do not lie in one plane.")
    for k in (1, 2) if len(used) >= _FEW else ():
        if width[k] < _FLAT * width[0]:
            out.append(
                f"Spread the poses along {_direction(spread[2][k])} of the robot's base: they vary by only "
                f"{1e3 * width[k]:.0f} mm there (rms), by {1e3 * width[0]:.0f} mm along {_direction(spread[2][0])}."
            )
    turned = turn_deg([o.X_BR for o in used])
    if not has_orientations([o.X_BR for o in used]):
        out.append(
            "Give the orientations of the poses (base_qw ... base_qz in pairs.csv): without them a constant error of"
            " the flange centre or of the tool's offset cannot be seen."
        )
    elif turned < _TURN_DEG:
        out.append(
            f"Turn and tilt the flange between poses by 20 degrees or more: these poses differ by {turned:.1f} degrees,"
            " so a constant error of the flange centre or of the tool's offset cannot be seen."
        )
    sigma = sigma_at(estimate, middle)
    weak = weakest_place(estimate, p)
    if sigma_at(estimate, weak) > _WEAK_FACTOR * sigma:
        x, y, z = 1e3 * weak
        out.append(
            f"The most informative next pose is near ({x:.0f}, {y:.0f}, {z:.0f}) mm in the base: the uncertainty of a"
            f" scanned point is {1e3 * sigma_at(estimate, weak):.2f} mm there and {1e3 * sigma:.2f} mm in the middle."
        )
    n = len(used)
    gain = 1.0 - np.sqrt(n / (n + 1.0))
    if required_m is not None and sigma <= required_m and not out:
        out.append(
            f"Stop: the uncertainty of a scanned point is {1e3 * sigma:.2f} mm, {1e3 * required_m:.2f} mm is required."
        )
    elif gain < _LITTLE and not out:
        out.append(
            f"Stop if {1e3 * sigma:.2f} mm is enough: one more pose would reduce it by {100 * gain:.0f} %, and would "
            f"not reduce the scatter of a single scan, {1e3 * estimate.sigma_position_m:.2f} mm per axis."
        )
    elif gain >= _LITTLE:
        want = int(np.ceil(1.0 / (1.0 - (1.0 - _LITTLE) ** 2)))
        out.append(
            f"Add poses, up to {want} or more: each reduces the uncertainty of {1e3 * sigma:.2f} mm by {100 * gain:.0f}"
            " % or more."
        )
    return tuple(out)


def weakest_place(estimate: CalibrationEstimate, p_B: Array) -> Array:
    """Find the place (3,) m with the largest uncertainty of a scanned point.

    It is one of the ends of the principal axes of poses (n, 3) m, half as far again.
    """
    middle = p_B.mean(axis=0)
    spread = np.linalg.svd(p_B - middle, full_matrices=False)
    reach = spread[2] * (spread[1] / np.sqrt(len(p_B)))[:, None]
    corners = middle + 1.5 * np.vstack([reach, -reach])
    errors = [sigma_at(estimate, c) for c in corners]
    return np.asarray(corners[int(np.argmax(errors))])


def sigma_at(estimate: CalibrationEstimate, p_BQ: Array) -> float:
    """Return the standard deviation (3-D, m) of a scanned point at ``p_BQ`` (3,) m."""
    return float(np.sqrt(np.trace(point_error_covariance(estimate, p_BQ))))


def _direction(axis: Array) -> str:
    """Return the base axis that a direction follows most, or the two that share it."""
    order = np.argsort(-np.abs(axis))
    names = "xyz"
    if abs(axis[order[0]]) > 0.9:
        return names[int(order[0])]
    first, second = sorted((int(order[0]), int(order[1])))
    return f"{names[first]} and {names[second]}"
