"""Decide on errors of the arm by nested held-out errors, write its kinematics, and read what a result states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.common.yaml import yaml_dump
from pydrake.math import RollPitchYaw, RotationMatrix

from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import DatasetError, TooFewPoses
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, HeldOut, corrected_observation, with_scanner
from weldcal.calibration.eye_on_base.joint_fit import solve_jointly
from weldcal.calibration.eye_on_base.scanner_fit import from_holes
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import flange_poses, log_rotation
from weldcal.calibration.planning.observability import turn_deg
from weldcal.calibration.refinement.kinematics_fit import (
    KINDS,
    ArmErrors,
    FactoryPrior,
    KinematicsFit,
    arm_errors,
    fit_kinematics,
    unsought,
)
from weldcal.calibration.refinement.local_field import GAIN
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import LINKS, Chain
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

if TYPE_CHECKING:
    from weldcal.calibration.data.dataset import Dataset

_SAME_M, _SAME_RAD = (
    1e-4,
    float(np.radians(0.01)),
)  # what a controller rounds, and less than a factory calibration changes

LEAST = 12
"""Poses from which on errors of an arm are sought."""
LEAST_TURN_DEG = 20.0  # a choice: at 20 deg a lever's error changes by a third of itself
"""Turn between poses from which on they show in more than one orientation."""
WRONG_FILE = 8.0  # a choice: nominal arms are off by some millimetres, factory files by some tenths
"""Times a factory's errors: the prior of an arm whose kinematics are those of another robot, or nominal."""
_FOLDS = 10
# growth of a standard deviation by the scanner's factors at which an error counts as not separable
_MIXED = 1.5
_NAMED = 6  # errors in a sentence; the JSON object has all
_SHOWN = 0.8  # of the prior: below it the poses have said something


def require_joint_angles(data: Dataset, ids: Sequence[str], arm: Chain, stated: Array) -> Array:
    """Joint angles (n, arm.n) rad that lead the arm to the stated flange poses (n, 4, 4).

    Raises DatasetError without angles, InputError where they lead elsewhere: to another arm, or to one whose controller
    has a factory calibration of its own.
    """
    from weldcal.calibration.data.dataset import joint_angles  # the readers of files

    q = joint_angles(data, ids, arm.n)
    if q is None:
        raise DatasetError(
            f"poses.csv or pairs.csv in '{data.folder.name}' has no joint angles: add the columns q1 to q{arm.n}"
            " (radians), or omit --refine."
        )
    reached = flange_poses(arm, q, np.zeros((arm.n, 6)))
    off_m = float(np.linalg.norm(stated[:, :3, 3] - reached[:, :3, 3], axis=1).max())
    turn = log_rotation(np.swapaxes(reached[:, :3, :3], 1, 2) @ stated[:, :3, :3])
    if off_m > _SAME_M or float(np.linalg.norm(turn, axis=1).max()) > _SAME_RAD:
        raise InputError(
            f"The joint angles lead this {arm.name} up to {1e3 * off_m:.2f} mm from the stated poses. A real controller"
            " computes with the factory calibration of its arm: give that file (--kinematics). Else check the robot's"
            " name, radians, and that the TCP is zero."
        )
    return q


def arm_document(fit: KinematicsFit) -> dict[str, Any]:
    """Return the errors as plain types for calibration.yaml (rad, m).

    The covariance is that of X_BC, scanner factors and errors / prior.
    """
    found = fit.errors
    return {
        "names": list(found.names),
        "which": [int(i) for i in found.which],
        "prior": [float(v) for v in found.scale],
        "values": [float(v) for v in fit.values],
        "sigma": [float(v) for v in fit.sigma],
        "covariance": [[float(v) for v in row] for row in fit.covariance],
    }


def shared_error(
    result: CalibrationResult,
    kinematics: Path,
    correction: ScannerCorrection | None,
    observations: Sequence[Observation],
    q: Array,
) -> tuple[Array, Array] | None:
    """Derivatives (n, 3, p) of positions of new scans by what the result estimated, and its covariance (p, p).

    None where it states none.

    ``observations`` (n) as seen, with the poses that the arm of ``kinematics`` reaches at q (n, joints).

    Raises:
        InputError: what the result states of its arm cannot be read.
    """
    if result.arm_errors is None:
        return None
    correction = correction or ScannerCorrection()
    try:
        which = np.array(result.arm_errors["which"], dtype=int)
        scale = np.array(result.arm_errors["prior"], dtype=float)
        covariance = np.array(result.arm_errors["covariance"], dtype=float)
        size = 6 + len(correction.values) + len(which)
        if covariance.shape != (size, size) or scale.shape != which.shape or not np.isfinite(covariance).all():
            raise ValueError("sizes differ")
        arm = load_chain(result.robot, kinematics)
        if which.min() < 0 or which.max() >= 6 * arm.n:
            raise ValueError("no joint of this arm")
    except (KeyError, TypeError, ValueError) as problem:
        raise InputError(
            "The arm's errors (arm_errors) in the result cannot be read; run 'weldcal calibrate --refine' again."
        ) from problem
    errors = ArmErrors(arm, which, scale, tuple(str(i) for i in which))
    fit = KinematicsFit(
        X_BC=result.X_BC,
        correction=correction,
        u=np.zeros(len(which)),
        covariance=covariance,
        sigma_position_m=1.0,
        sigma_normal_rad=1.0,
        redundancy=1.0,
        errors=errors,
    )
    return fit.sensitivity(observations, q)[:, :3], covariance


@dataclass(frozen=True, eq=False)
class KinematicsChoice:
    """A fit and the errors of poses (n,) that neither it nor the plain calibration saw.

    ``plain_m`` and ``refined_m``, ``tilt_rad`` with the fit, NaN where the others fix none. ``accepted``: the fit is
    applied; ``sentence``: why, and what it found.
    """

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
    correct_scanner: bool = True,
    seed: int = 0,
) -> KinematicsChoice:
    """Fit errors of the arm to n inlier observations at joint angles q (n, joints), and decide on them.

    The fit starts from the observations' plain estimate.

    In ten folds both calibrations, choices included, are repeated without the held-out poses. The errors are applied if
    the mean falls by 5 %, beside that of the plain calibration and that of the same fit without errors of the arm. The
    prior is a factory's, or the wider one of a wrong kinematics file where that lets the mean fall by 5 % more.

    Raises TooFewPoses below twelve, InputError for poses of one orientation or an unknown ``kind``.
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
            f"The orientation of the flange varies by {turned:.1f} degrees only. Errors of the arm (--refine {kind})"
            f" cannot then be separated from errors of the scanner. Turn and tilt the flange by {LEAST_TURN_DEG:.0f}"
            " degrees or more, or use --refine local."
        )
    factory = arm_errors(arm, kind)
    none = replace(factory, which=factory.which[:0], scale=factory.scale[:0], names=())
    candidates = [none, factory, arm_errors(arm, kind, FactoryPrior().times(WRONG_FILE))]
    plain = np.full(n, np.nan)
    new_m, new_tilt = np.full((2, len(candidates), n), np.nan)
    place = np.random.default_rng(seed).permutation(n)
    for f in range(_FOLDS):
        test = np.sort(place[f::_FOLDS])
        rest = np.setdiff1d(np.arange(n), test)
        train, new = [observations[i] for i in rest], [observations[i] for i in test]
        try:
            X, c = solve_jointly(train, patterns, correct_scanner=correct_scanner, seed=seed)
        except InputError:
            continue
        plain[test] = position_errors(X, [corrected_observation(c, o) for o in new])
        for k, sought in enumerate(candidates):
            holes = from_holes(train, patterns)
            without = fit_kinematics(train, q[rest], sought, X, c, holes=holes, fixed_scanner=not correct_scanner)
            seen = without.applied(new, q[test])
            new_m[k, test], new_tilt[k, test] = position_errors(without.X_BC, seen), tilt_errors(without.X_BC, seen)
    known = np.isfinite(plain)
    before, *means = (1e3 * float(np.mean(e[known])) if known.any() else float("nan") for e in (plain, *new_m))
    large = means[2] < GAIN * means[1]
    used = 2 if large else 1
    refined, tilt, after = new_m[used], new_tilt[used], means[used]
    holes = from_holes(observations, patterns)
    start = estimate.correction or ScannerCorrection()
    fit = fit_kinematics(
        observations,
        q,
        candidates[used],
        estimate.X_BC,
        start,
        holes=holes,
        fixed_scanner=not correct_scanner,
        considered=unsought(arm, kind),
    )
    # the same fit without errors of the arm: what the scanner's part of it gains is not theirs
    scanner = means[0]
    accepted = bool(after < GAIN * min(before, scanner))
    said = (
        f"mean held-out error {before:.3f} mm without, {after:.3f} mm with them ({scanner:.3f} mm with the scanner's"
        " part alone)"
    )
    if not accepted:
        return KinematicsChoice(
            fit,
            plain,
            refined,
            tilt,
            False,
            f"Errors of the arm ({kind}) do not help: {said}. The plain calibration is used.",
        )
    mixed = _mixed(observations, q, fit) if correct_scanner else []
    why = f" Not separable from the scanner's distortion: {', '.join(mixed)}." if mixed else ""
    if large:
        why += (
            f" They are larger than a factory calibration leaves (a prior {WRONG_FILE:.0f} times as wide predicts the"
            " held-out poses better): the kinematics are probably those of another robot."
        )
    sentence = (
        f"Errors of the arm are applied ({_told(fit)}): {said}.{why} X_BC belongs to the arm with the kinematics of the"
        " file written beside it."
    )
    return KinematicsChoice(fit, plain, refined, tilt, True, sentence)


def with_kinematics(
    estimate: CalibrationEstimate, choice: KinematicsChoice, observations: Sequence[Observation], q: Array
) -> tuple[CalibrationEstimate, list[Observation]]:
    """Return the estimate of the accepted fit, and all observations as corrected by it."""
    f = choice.fit
    size = 6 + len(f.correction.values)
    moved = f.applied(observations, q)
    position, tilt = estimate.held_out.position_m.copy(), estimate.held_out.tilt_rad.copy()
    position[estimate.inliers], tilt[estimate.inliers] = choice.refined_m, choice.tilt_rad
    refined = with_scanner(estimate, f.correction, f.X_BC, f.covariance[:size, :size], f.redundancy)
    return (
        CalibrationEstimate(
            X_BC=refined.X_BC,
            covariance=refined.covariance,
            inliers=estimate.inliers,
            position_residuals_m=position_errors(f.X_BC, moved),
            tilt_residuals_rad=tilt_errors(f.X_BC, moved),
            held_out=HeldOut(position, tilt),
            sigma_position_m=f.sigma_position_m,
            sigma_normal_rad=f.sigma_normal_rad,
            unobservable=estimate.unobservable,
            warnings=estimate.warnings,
            scanner=refined.scanner,
            joint=refined.joint,
        ),
        moved,
    )


def kinematics_text(fit: KinematicsFit, note: str) -> str:
    """Return the arm's link transforms with the errors found, as a file of Universal Robots' schema.

    Units are m and rad; load_arm reads it.
    """
    links = {}
    for link, moved in zip(LINKS, fit.corrected_stack(), strict=True):
        rpy = RollPitchYaw(RotationMatrix.ProjectToRotationMatrix(moved[:3, :3])).vector()
        links[link] = dict(
            zip(("x", "y", "z", "roll", "pitch", "yaw"), (*map(float, moved[:3, 3]), *map(float, rpy)), strict=True)
        )
    return f"# {note}\n{yaml_dump({'kinematics': links})}"


def _mixed(observations: Sequence[Observation], q: Array, fit: KinematicsFit) -> list[str]:
    """Errors that would be known much better if the scanner were known."""
    fit = replace(fit, sigma_considered=None)
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
    """Return the errors that differ from zero by two sigma, the surest first."""
    rows = sorted(
        zip(fit.errors.names, fit.values, fit.sigma, strict=True), key=lambda row: -abs(float(row[1] / row[2]))
    )
    found = [
        (
            f"{name} {1e3 * v:+.2f} +- {1e3 * s:.2f} mm"
            if "shift" in name
            else f"{name} {np.degrees(v):+.3f} +- {np.degrees(s):.3f} deg"
        )
        for name, v, s in rows
        if abs(v) > 2.0 * s
    ]
    return (
        ", ".join(found[:_NAMED]) + (f" and {len(found) - _NAMED} more" if len(found) > _NAMED else "")
        or "none beyond two sigma"
    )
