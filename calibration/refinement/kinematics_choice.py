"""Decides on errors of the arm by nested held-out errors, and writes the kinematics that follow from them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.common.yaml import yaml_dump
from pydrake.math import RollPitchYaw, RotationMatrix

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, HeldOut, with_scanner
from weldcal.calibration.eye_on_base.nested import calibrate_by_choice
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.eye_on_base.scanner_fit import CorrectionEstimate, correction_of, from_holes
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, pose
from weldcal.calibration.planning.observability import turn_deg
from weldcal.calibration.refinement.kinematics_fit import KINDS, ArmErrors, KinematicsFit, arm_errors, fit_kinematics
from weldcal.calibration.refinement.local_choice import GAIN
from weldcal.models.arms.chain import Chain
from weldcal.models.arms.kinematics import LINKS
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

LEAST = 12
"""Poses from which on errors of an arm are sought."""
LEAST_TURN_DEG = 20.0
"""Turn between poses from which on they show in more than one orientation."""
_FOLDS = 10
_MIXED = (
    1.5  # growth of a standard deviation by the scanner's factors at which an error counts as not separable from them
)
_SHOWN = 0.8  # of the prior: below it the poses have said something


@dataclass(frozen=True, eq=False)
class KinematicsChoice:
    """A fit and the errors of poses (n,) that neither it nor the plain calibration saw: ``plain_m`` and ``refined_m``, ``tilt_rad`` with the
    fit, NaN where the others fix none. ``accepted``: the fit is applied; ``sentence``: why, and what it found."""

    fit: KinematicsFit
    plain_m: Array
    refined_m: Array
    tilt_rad: Array
    accepted: bool
    sentence: str


def choose_kinematics(
    observations: Sequence[Observation],
    q: Array,
    arm: Chain,
    kind: str,
    patterns: Mapping[str, HolePattern],
    estimate: CalibrationEstimate,
    *,
    seed: int = 0,
) -> KinematicsChoice:
    """Fit errors of the arm to n inlier observations at joint angles q (n, joints), from their plain estimate, and decide on them.

    In ten folds both calibrations, choices included, are repeated without the held-out poses; the errors are applied if the mean falls by
    5 %. Raises TooFewPoses below twelve, InputError for poses of one orientation or an unknown ``kind``.
    """
    if kind not in KINDS:
        raise InputError(f"There is no refinement '{kind}' of an arm; choose one of {', '.join(KINDS)}.")
    n = len(observations)
    if n < LEAST:
        raise TooFewPoses(
            f"Errors of the arm (--refine {kind}) need {LEAST} usable poses, and there are {n}; add poses."
        )
    turned = turn_deg([o.X_BR for o in observations])
    if turned < LEAST_TURN_DEG:
        raise InputError(
            f"The orientation varies by {turned:.1f} degrees only: errors of the arm (--refine {kind}) cannot be told from the scanner's; turn "
            f"and tilt the flange by {LEAST_TURN_DEG:.0f} degrees and more, or use --refine local."
        )
    sought = arm_errors(arm, kind)
    fit = _fit(observations, q, sought, estimate, patterns)
    plain, refined, tilt = np.full((3, n), np.nan)
    place = np.random.default_rng(seed).permutation(n)
    for f in range(_FOLDS):
        test = np.sort(place[f::_FOLDS])
        rest = np.setdiff1d(np.arange(n), test)
        train, new = [observations[i] for i in rest], [observations[i] for i in test]
        try:
            X, c = calibrate_by_choice(train, patterns, seed=seed)
        except InputError:
            continue
        plain[test] = position_errors(X, [corrected_observation(c, o) for o in new])
        without = fit_kinematics(train, q[rest], sought, X, _shape(c), holes=from_holes(train, patterns))
        seen = without.applied(new, q[test])
        refined[test], tilt[test] = position_errors(without.X_BC, seen), tilt_errors(without.X_BC, seen)
    known = np.isfinite(plain)
    before, after = (1e3 * float(np.mean(e[known])) if known.any() else float("nan") for e in (plain, refined))
    accepted = bool(after < GAIN * before)
    said = f"mean held-out error {before:.3f} mm without, {after:.3f} mm with them"
    if not accepted:
        return KinematicsChoice(
            fit,
            plain,
            refined,
            tilt,
            False,
            f"Errors of the arm ({kind}) do not help: {said}. The plain calibration is used.",
        )
    mixed = _mixed(observations, q, fit)
    why = f" Not separable from the scanner's distortion: {', '.join(mixed)}." if mixed else ""
    sentence = f"Errors of the arm are applied ({_told(fit)}): {said}.{why} X_BC belongs to the arm with the kinematics of the file written beside it."
    return KinematicsChoice(fit, plain, refined, tilt, True, sentence)


def with_kinematics(
    estimate: CalibrationEstimate, choice: KinematicsChoice, observations: Sequence[Observation], q: Array
) -> tuple[CalibrationEstimate, list[Observation]]:
    """The estimate of the accepted fit, and all observations as corrected by it."""
    f = choice.fit
    size = 6 + len(f.correction.values)
    moved = f.applied(observations, q)
    position, tilt = estimate.held_out.position_m.copy(), estimate.held_out.tilt_rad.copy()
    position[estimate.inliers], tilt[estimate.inliers] = choice.refined_m, choice.tilt_rad
    refined = with_scanner(estimate, f.correction, f.X_BC, f.covariance[:size, :size], f.redundancy)
    return (
        CalibrationEstimate(
            refined.X_BC,
            refined.covariance,
            estimate.inliers,
            position_errors(f.X_BC, moved),
            tilt_errors(f.X_BC, moved),
            HeldOut(position, tilt),
            f.sigma_position_m,
            f.sigma_normal_rad,
            estimate.unobservable,
            estimate.warnings,
            refined.scanner,
            refined.joint,
        ),
        moved,
    )


def kinematics_text(fit: KinematicsFit, note: str) -> str:
    """The arm's link transforms with the errors found, as a file of Universal Robots' schema (m, rad; load_arm reads it)."""
    errors = fit.errors.errors(fit.u)
    links = {}
    for link, X, e in zip(LINKS, fit.errors.arm.stack, errors, strict=True):
        moved = X @ pose(exp_rotation(e[:3]), e[3:])
        rpy = RollPitchYaw(RotationMatrix.ProjectToRotationMatrix(moved[:3, :3])).vector()
        links[link] = dict(
            zip(("x", "y", "z", "roll", "pitch", "yaw"), (*map(float, moved[:3, 3]), *map(float, rpy)), strict=True)
        )
    return f"# {note}\n{yaml_dump({'kinematics': links})}"


def _shape(correction: ScannerCorrection) -> ScannerCorrection:
    return correction_of(correction.values - np.eye(len(correction.values))[0], correction.field_m)


def _fit(
    observations: Sequence[Observation],
    q: Array,
    sought: ArmErrors,
    estimate: CalibrationEstimate,
    patterns: Mapping[str, HolePattern],
) -> KinematicsFit:
    holes: CorrectionEstimate | None = from_holes(observations, patterns)
    return fit_kinematics(observations, q, sought, estimate.X_BC, estimate.scanner or ScannerCorrection(), holes=holes)


def _mixed(observations: Sequence[Observation], q: Array, fit: KinematicsFit) -> list[str]:
    """Errors that would be known much better if the scanner were known."""
    sure = fit_kinematics(observations, q, fit.errors, fit.X_BC, fit.correction, fixed_scanner=True)
    # at the same scatter: only what the scanner leaves open counts
    better = sure.sigma * fit.sigma_position_m / sure.sigma_position_m
    shown = fit.sigma < _SHOWN * fit.errors.scale
    return [
        name
        for name, s, b, seen in zip(fit.errors.names, fit.sigma, better, shown, strict=True)
        if seen and s > _MIXED * b
    ]


def _told(fit: KinematicsFit) -> str:
    rows = zip(fit.errors.names, fit.values, fit.sigma, fit.errors.scale, strict=True)
    found = [
        f"{name} {1e3 * v:+.2f} +- {1e3 * s:.2f} mm"
        if "shift" in name
        else f"{name} {np.degrees(v):+.3f} +- {np.degrees(s):.3f} deg"
        for name, v, s, prior in rows
        if s < _SHOWN * prior
    ]
    return ", ".join(found) or "none better than its prior"
