"""Estimates X_BC from one, two or three scans, from normals or from whole poses by the hole pattern."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.scanner_correction import ScannerCorrection, expected_factors
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, HeldOut, corrected_observation
from weldcal.calibration.eye_on_base.solve import USUAL_SPREAD_M, USUAL_TILT_RAD, SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, rotation_vector, skew
from weldcal.calibration.planning.observability import unobservable_sentences
from weldcal.models.arrays import Array

ENOUGH = 4
"""Poses from which on a calibration needs no such help."""

_TURN_KNOWN_RAD = float(np.radians(0.1))  # as well as a calibration from many poses states it, and as an operator would
# radius of the hole circle of ISO 9409-1-50; on one of twice the size the sigma is stated twice too large
_HOLE_CIRCLE_M = 0.025
_TURN_STATED = (
    "The rotation about the flange's axis is as stated with --axis-turn: a degree of error there turns the scanner by a"
    " degree. A calibration from many scans reports it."
)
_TERMS = 6  # of the correction that few scans leave open
_USUAL_WEIGHT = 4.0  # residuals' worth of what is usual of robot and scanner


@dataclass(frozen=True, eq=False)
class FewPosesEstimate:
    """X_BC from ``ids``, and the residuals (m) of the flange centres; zero where there is only one."""

    X_BC: RigidTransform
    ids: tuple[str, ...]
    residuals_m: Array


def estimate_from_whole_poses(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], turn_rad: float = 0.0
) -> FewPosesEstimate:
    """X_BC from the observations whose hole pattern shows its rotation (n >= 1): each gives all six degrees of freedom.

    ``turn_rad`` is how far the drilled pattern is turned about the face normal from where the robot's flange frame says
    it is. ``axis_turn`` finds it once from a calibration by many poses, and a flange keeps it. Rotations are averaged
    (chordal mean), then centres. Raises TooFewPoses where no scan shows one.
    """
    seen = _with_turn(observations, patterns)
    turn = RotationMatrix.MakeZRotation(turn_rad).matrix()
    total = np.zeros((3, 3))
    for o in seen:
        R_BR = o.X_BR.rotation().matrix() @ turn
        R_CR = patterns[o.id].X_CR.rotation().matrix()
        if o.n_C is not None:  # a correction of the scanner turns the face: the pattern with it
            R_CR = exp_rotation(np.cross(R_CR[:, 2], o.n_C)) @ R_CR
        total += R_BR @ R_CR.T
    u, _, vt = np.linalg.svd(total)
    R = u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt
    c, b = np.array([o.p_CR for o in seen]), np.array([o.p_BR for o in seen])
    p = (b - c @ R.T).mean(axis=0)
    X_BC = RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)
    return FewPosesEstimate(X_BC, tuple(o.id for o in seen), np.linalg.norm(c @ R.T + p - b, axis=1))


def axis_turn(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], X_BC: RigidTransform
) -> tuple[float, float]:
    """Measure how far (rad) the drilled pattern is turned from the robot's flange frame, and its spread over the scans.

    The turn is about the face normal, the spread a standard deviation (rad; NaN for one scan). Circular median over the
    scans that show the pattern's rotation; raises TooFewPoses where none does.
    """
    turns = []
    for o in _with_turn(observations, patterns):
        R = (o.X_BR.rotation().inverse() @ X_BC.rotation() @ patterns[o.id].X_CR.rotation()).matrix()
        turns.append(complex(R[0, 0], R[1, 0]))
    unit = np.array(turns) / np.abs(turns)
    # turns near half a circle wrap round: both figures are taken about the mean direction
    mean = np.angle(unit.sum())
    about = np.angle(unit * np.exp(-1j * mean))
    middle = float(np.angle(np.exp(1j * (mean + np.median(about)))))
    return middle, float(np.std(about, ddof=1)) if len(about) > 1 else float("nan")


def _with_turn(observations: Sequence[Observation], patterns: Mapping[str, HolePattern]) -> list[Observation]:
    """The observations whose hole pattern shows its rotation about the axis. Raises TooFewPoses where none does."""
    seen = [o for o in observations if o.id in patterns]
    known = [o for o in seen if patterns[o.id].turn_known]
    if known:
        return known
    if seen:
        turns = (0.0, *(np.degrees(t) % 360.0 for t in patterns[seen[0].id].other_turns_rad))
        raise TooFewPoses(
            "The scans show the flange's threads but not its dowel hole. The rotation about the axis is therefore"
            " one of "
            f"{', '.join(f'{t:.0f}' for t in sorted(turns))} degrees. Clear the dowel hole, or take four poses or more."
        )
    raise TooFewPoses("No scan shows the flange's holes well enough. Scan from nearer, or take four poses or more.")


def calibrate_from_few(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern],
    axis_turn_rad: float | None = None,
    *,
    seed: int = 0,
) -> CalibrationEstimate:
    """Estimate X_BC from one to three observations.

    The covariance takes the usual errors of robot and scanner where the data are too few.

    With ``axis_turn_rad`` (see estimate_from_whole_poses) one scan that shows the holes is enough; without it three
    pairs, or two scans with face normals. Held-out errors are those of each pose under the others, NaN where the others
    are too few. Raises TooFewPoses, RepeatedPoses, CoplanarPoses or InconsistentPoses.
    """
    n = len(observations)
    if axis_turn_rad is not None:
        estimate = _said(
            _from_whole_poses(observations, patterns, axis_turn_rad), len(_with_turn(observations, patterns))
        )
        return replace(estimate, warnings=(*estimate.warnings, _TURN_STATED))
    normals = all(o.n_C is not None for o in observations)
    need = 2 if normals else 3
    if n < need:
        there = "One scan leaves" if n == 1 else "Two centres leave"
        raise TooFewPoses(
            f"{there} a rotation open. Take {ENOUGH} poses or more, whose flange centres do not lie in one plane. Or"
            " state the rotation of the hole pattern about the flange's axis with --axis-turn DEGREES (a calibration"
            " from many scans reports it)."
        )
    config = SolveConfig(seed=seed, min_poses=need, allow_coplanar=True, usual_weight=_USUAL_WEIGHT)
    estimate = estimate_eye_on_base(tuple(observations), config)
    once = replace(config, leave_one_out=False)
    return _said(
        _with_open_scanner(estimate, observations, lambda some: estimate_eye_on_base(tuple(some), once).X_BC), n
    )


def _with_open_scanner(
    estimate: CalibrationEstimate,
    observations: Sequence[Observation],
    solve: Callable[[Sequence[Observation]], RigidTransform],
) -> CalibrationEstimate:
    """Return the estimate with a covariance that holds what scanners are usually off: so few scans do not show it.

    Had the scanner needed the factors v, ``solve`` would have found X_BC moved by L v (derivative by differences).
    """
    sigma = expected_factors(_TERMS, float(np.median([o.p_CR[2] for o in observations])))
    R, p = estimate.X_BC.rotation(), estimate.X_BC.translation()
    L = np.zeros((6, _TERMS))
    for k, step in enumerate(0.1 * sigma):
        values = ScannerCorrection.unchanged(_TERMS).values
        values[k] += step
        correction = ScannerCorrection(values[0], (values[1], values[2]), tuple(values[3:]))
        moved = solve([corrected_observation(correction, o) for o in observations])
        L[:, k] = np.concatenate([rotation_vector(moved.rotation() @ R.inverse()), moved.translation() - p]) / step
    left = L * sigma
    joint = np.block([[estimate.covariance + left @ left.T, left * sigma], [(left * sigma).T, np.diag(sigma**2)]])
    return replace(estimate, covariance=joint[:6, :6], joint=joint, scanner=ScannerCorrection.unchanged(_TERMS))


def _from_whole_poses(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], turn_rad: float
) -> CalibrationEstimate:
    seen = _with_turn(observations, patterns)
    ids = {o.id for o in seen}
    X = estimate_from_whole_poses(observations, patterns, turn_rad).X_BC
    n = len(seen)
    information, own = np.zeros((3, 3)), np.zeros((3, 3))
    for o in seen:
        R = o.X_BR.rotation().matrix()
        tilt = float(np.hypot(USUAL_TILT_RAD, o.normal_sigma or 0.0))
        sigma = np.array([tilt, tilt, max(patterns[o.id].rms_m / _HOLE_CIRCLE_M, USUAL_TILT_RAD)])
        information += R @ np.diag(1.0 / sigma**2) @ R.T
        if o.center_covariance is not None:
            R_BC = X.rotation().matrix()
            own += R_BC @ o.center_covariance @ R_BC.T / n**2
    axis = np.mean([o.n_B for o in seen], axis=0)
    # the turn is stated once for all scans: its error does not average out
    rotation = np.linalg.inv(information) + _TURN_KNOWN_RAD**2 * np.outer(axis, axis)
    covariance = np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = rotation, USUAL_SPREAD_M**2 / n * np.eye(3) + own
    T = np.eye(6)
    T[3:, :3] = -skew(np.asarray(X.translation()) - np.mean([o.p_BR for o in seen], axis=0))
    held_out = np.full((2, len(observations)), np.nan)
    for k, o in enumerate(observations):
        rest = [other for other in seen if other is not o]
        if rest:
            without = estimate_from_whole_poses(rest, patterns, turn_rad).X_BC
            held_out[:, k] = position_errors(without, [o])[0], tilt_errors(without, [o])[0]
    estimate = CalibrationEstimate(
        X_BC=X,
        covariance=T @ covariance @ T.T,
        inliers=np.array([o.id in ids for o in observations]),
        position_residuals_m=position_errors(X, observations),
        tilt_residuals_rad=tilt_errors(X, observations),
        held_out=HeldOut(held_out[0], held_out[1]),
        sigma_position_m=USUAL_SPREAD_M,
        sigma_normal_rad=USUAL_TILT_RAD,
        unobservable=unobservable_sentences([o.X_BR for o in seen], USUAL_SPREAD_M, True),
        warnings=(),
    )
    return _with_open_scanner(estimate, seen, lambda some: estimate_from_whole_poses(some, patterns, turn_rad).X_BC)


def _said(estimate: CalibrationEstimate, n: int) -> CalibrationEstimate:
    """With the sentence that says what the figures rest on."""
    scans = "one scan" if n == 1 else f"{n} scans"
    held = estimate.held_out.position_m
    judged = (
        "nothing could be held out"
        if not np.isfinite(held).any()
        else "each held-out error is that of one under the others"
    )
    text = (
        f"From {scans} only: the uncertainty is based on typical errors of robot and scanner"
        f" ({1e3 * USUAL_SPREAD_M:.2f} mm and {np.degrees(USUAL_TILT_RAD):.2f} degrees per axis); {judged}. A"
        f" calibration from {ENOUGH} poses or more estimates its own errors."
    )
    return replace(estimate, warnings=(*estimate.warnings, text))
