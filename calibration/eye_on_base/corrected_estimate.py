"""Corrects the scanner where its data ask for it: the estimate, the corrected observations and honest held-out errors."""

from collections.abc import Mapping
from dataclasses import replace

from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, HeldOut, with_scanner
from weldcal.calibration.eye_on_base.nested import nested_errors
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.eye_on_base.self_calibration import SelfCalibration, self_calibrate
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.models.arrays import Array


def apply_self_calibration(
    observations: list[Observation],
    rigid: CalibrationEstimate,
    patterns: Mapping[str, HolePattern],
    *,
    seed: int = 0,
    wanted: bool = True,
    nested: bool = True,
) -> tuple[SelfCalibration | None, list[Observation], CalibrationEstimate]:
    """The verdict on the scanner (None where it is not ``wanted``), the observations as corrected by it, and their estimate.

    ``rigid`` is the estimate without a correction. Held-out errors of the one returned come from calibrations that never saw
    the pose, whose correction was chosen without it, too, unless ``nested`` is off (for studies: the choice takes most of
    the time); its covariance contains that of the correction.
    """
    if not wanted:
        return None, observations, rigid
    good = [o for o, keep in zip(observations, rigid.inliers, strict=True) if keep]
    scanner = self_calibrate(good, patterns, rigid.held_out.position_m[rigid.inliers], seed=seed)
    errors = nested_errors(good, patterns, seed=seed) if nested and scanner.could_choose else None
    if scanner.found is None or scanner.accepted is None:
        return scanner, observations, rigid if errors is None else _with_held_out(rigid, *errors)
    corrected = [corrected_observation(scanner.accepted, o) for o in observations]
    found = scanner.found
    assert found.X_BC is not None
    estimate = replace(
        with_scanner(rigid, found.correction, found.X_BC, found.joint, found.redundancy),
        position_residuals_m=position_errors(found.X_BC, corrected),
        tilt_residuals_rad=tilt_errors(found.X_BC, corrected),
        sigma_position_m=found.sigma_position_m,
        sigma_normal_rad=found.sigma_normal_rad,
    )
    errors = (scanner.held_out_m, scanner.held_out_tilt_rad) if errors is None else errors
    return scanner, corrected, _with_held_out(estimate, *errors)


def _with_held_out(estimate: CalibrationEstimate, errors: Array, tilts: Array) -> CalibrationEstimate:
    """The estimate with these held-out errors (k,) m and tilts (k,) rad of its inliers."""
    position, tilt = estimate.held_out.position_m.copy(), estimate.held_out.tilt_rad.copy()
    position[estimate.inliers], tilt[estimate.inliers] = errors, tilts
    return replace(estimate, held_out=HeldOut(position, tilt))
