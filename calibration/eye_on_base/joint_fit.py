"""Estimates X_BC and the scanner's own errors together, the latter held to what scanners are usually off."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, HeldOut, with_scanner
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.eye_on_base.scanner_fit import CorrectionEstimate, from_motion
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.observation import Observation
from weldcal.models.errors import InputError

LEAST = 4
"""Poses from which on the scanner's errors are estimated, too."""
_ORDER = 2  # of the correction: scale, gradient and bends


def estimate_jointly(observations: Sequence[Observation], *, seed: int = 0) -> CalibrationEstimate:
    """X_BC with a scanner correction of second order from n poses (n >= 4), without a decision on either.

    The correction is held to its usual size (scale 0.2 %, gradient 0.15 % per 100 mm, bends 0.1 % at the image's edge), so
    that few poses state what they know: the covariance contains what they leave open of the scanner. ``held_out`` repeats
    both without each pose in turn. Outliers are those of the rigid estimate. With fewer inliers than four it is the rigid
    estimate. Deterministic for ``seed``. Raises what estimate_eye_on_base raises.
    """
    observations = tuple(observations)
    rigid = estimate_eye_on_base(observations, SolveConfig(seed=seed, leave_one_out=False))
    good = [o for o, keep in zip(observations, rigid.inliers, strict=True) if keep]
    if len(good) < LEAST:
        return estimate_eye_on_base(observations, SolveConfig(seed=seed))
    found = from_motion(good, {}, seed=seed, order=_ORDER, usual=True, start=rigid.X_BC)
    assert found.X_BC is not None
    corrected = [corrected_observation(found.correction, o) for o in observations]
    return replace(
        with_scanner(rigid, found.correction, found.X_BC, found.joint, found.redundancy),
        position_residuals_m=position_errors(found.X_BC, corrected),
        tilt_residuals_rad=tilt_errors(found.X_BC, corrected),
        held_out=_held_out(observations, rigid, found, seed),
        sigma_position_m=found.sigma_position_m,
        sigma_normal_rad=found.sigma_normal_rad,
    )


def solve_jointly(
    observations: Sequence[Observation], start: RigidTransform, *, correct_scanner: bool = True, seed: int = 0
) -> tuple[RigidTransform, ScannerCorrection]:
    """X_BC and correction of estimate_jointly (without ``correct_scanner``: of estimate_eye_on_base) from poses without outliers, near
    ``start``. Raises InputError where they do not fix it."""
    if not correct_scanner:
        return estimate_eye_on_base(
            tuple(observations), SolveConfig(seed=seed, leave_one_out=False)
        ).X_BC, ScannerCorrection()
    found = from_motion(observations, {}, seed=seed, order=_ORDER, usual=True, start=start)
    assert found.X_BC is not None
    return found.X_BC, found.correction


def _held_out(
    observations: Sequence[Observation], rigid: CalibrationEstimate, found: CorrectionEstimate, seed: int
) -> HeldOut:
    """Errors of each pose under estimates that did not see it; outliers are measured against the estimate from the others."""
    position, tilt = np.full((2, len(observations)), np.nan)
    for i, o in enumerate(observations):
        rest = [other for k, other in enumerate(observations) if k != i and rigid.inliers[k]]
        try:
            without = from_motion(rest, {}, seed=seed, order=_ORDER, usual=True, start=found.X_BC)
        except InputError:
            continue
        assert without.X_BC is not None
        seen = [corrected_observation(without.correction, o)]
        position[i], tilt[i] = float(position_errors(without.X_BC, seen)[0]), float(tilt_errors(without.X_BC, seen)[0])
    return HeldOut(position, tilt)
