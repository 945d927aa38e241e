"""Calibrate a scanner beside the robot from recorded scans of the flange, and check it on scans that it did not use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.calibrate import REFINEMENTS, Calibration, Steps, calibrate, refine
from weldcal.calibration.data.dataset import Dataset, joint_angles, load_dataset
from weldcal.calibration.data.results import CalibrationResult, statistics
from weldcal.calibration.doctor.case import FEWEST, DoctorCase, dataset_case
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
from weldcal.calibration.eye_on_base.few_poses import ENOUGH, axis_turn
from weldcal.calibration.eye_on_base.joint_fit import ScannerVerdict, estimate_jointly, left_uncorrected, solve_jointly
from weldcal.calibration.eye_on_base.observations import FlangeObservations, FlangeScan, fit_flanges, require_flange
from weldcal.calibration.eye_on_base.solve import SolveConfig
from weldcal.calibration.eye_on_base.stated_error import disagreeing, estimate_result
from weldcal.calibration.eye_on_base.validation import Convergence, convergence, k_fold, sampling_advice
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.planning.observability import turn_deg
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import known_arms
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.flanges import FlangeStandard, get_flange

if TYPE_CHECKING:
    from weldcal.calibration.eye_on_base.arm_start import ArmStart

Tell = Callable[[str, float], None]
"""Takes the name of a step and the fraction that is done."""
Examine = Callable[[WeldcalError, DoctorCase], None]
"""Takes a refusal and the scans that led to it."""

_CONFIRMING = 3  # hole circles without which the robot's motion alone does not change the scanner
_FOLDED = 6  # inliers from which on folds are left out
_TURN_DEG = 3.0  # orientations closer than this are one orientation to a calibration


@dataclass(frozen=True, kw_only=True)
class FlangeOptions:
    """What is asked of a dataset, and what is known of it beforehand.

    Attributes:
        robot, flange: in place of those of dataset.yaml.
        correct_scanner: estimate and apply a scanner correction.
        axis_turn_deg: rotation of the hole pattern about the flange axis; one to three scans are then enough.
        poses: "FROM:TO" takes the scans from one id to another, in the order of the dataset; either may be left out.
        refine: "local" adds a field of what the calibration leaves, "joints" or "links" errors of the arm, each where
            nested held-out errors fall.
        kinematics: factory calibration of that arm.
    """

    robot: str | None = None
    flange: str | None = None
    correct_scanner: bool = True
    axis_turn_deg: float | None = None
    poses: str | None = None
    refine: str | None = None
    kinematics: Path | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class RecordedFlange:
    """A calibration from a dataset: the result, what led to it, and its errors on scans that were left out.

    Attributes:
        observations: with the scanner correction, where one was accepted.
        seen: the scans as measured; ``notes`` say in which form they were read.
        refused: id and reason of each scan that is not used; ``outliers`` are those whose centre disagrees.
        refinement: the document of what ``refine`` found, and ``kinematics`` the text of the arm's file.
        case: the scans as `weldcal doctor` examines them.
    """

    result: CalibrationResult
    estimate: CalibrationEstimate
    observations: tuple[Observation, ...]
    scanner: ScannerVerdict | None
    seen: FlangeObservations
    refused: tuple[tuple[str, str], ...]
    outliers: tuple[str, ...]
    convergence: Convergence
    k_fold_mm: dict[str, float]
    advice: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    refinement: dict[str, Any] | None = None
    kinematics: str = ""
    case: DoctorCase | None = None

    @property
    def inliers(self) -> list[Observation]:
        """The scans that the estimate uses, as measured."""
        return [o for o, keep in zip(self.seen.observations, self.estimate.inliers, strict=True) if keep]


@dataclass(frozen=True, eq=False)
class _Scans:
    """The scans of a dataset and what is asked. ``start``: the start from the visible arm; None: there was no need."""

    asked: FlangeOptions
    data: Dataset
    standard: FlangeStandard
    seen: FlangeObservations
    start: ArmStart | None = None
    robot: str = field(default="", kw_only=True)

    @property
    def few(self) -> bool:
        """Whether the usual errors must stand for what the scans cannot show."""
        return len(self.seen.observations) < ENOUGH

    @property
    def confirmed(self) -> bool:
        """Whether the flange's holes can confirm a scanner correction."""
        return len(self.seen.patterns) >= _CONFIRMING

    @property
    def corrects(self) -> bool:
        """Whether a scanner correction may be applied."""
        return self.asked.correct_scanner and self.confirmed

    @property
    def X_FR(self) -> RigidTransform | None:
        """Pose of the feature in the flange; None for pairs, whose poses are the feature's."""
        return None if self.data.pairs else self.data.X_FR


def calibrate_flange(
    folder: Path,
    asked: FlangeOptions | None = None,
    tell: Tell = lambda step, fraction: None,
    examine: Examine = lambda problem, case: None,
    known: dict[str, FlangeScan] | None = None,
) -> RecordedFlange:
    """Calibrate from a dataset folder.

    A cloud that cannot be used is refused and reported, as long as enough remain. Where five scans or more contradict
    each other, ``examine`` gets the refusal and the case before it is raised. ``known``: see fit_flanges.

    Raises:
        InputError: the data cannot be used; TooFewPoses: too few scans can be used.
    """
    asked = asked or FlangeOptions()
    if asked.refine is not None and asked.refine not in REFINEMENTS:
        raise InputError(f"There is no refinement '{asked.refine}'. Choose one of {', '.join(REFINEMENTS)}.")
    scans = _find_flanges(folder, asked, tell, known)
    measured = scans.seen.observations
    found, agreement = _solve(scans, tell, examine)
    inliers = found.inliers(measured)
    outliers = disagreeing(found.estimate, measured)
    refused = (*scans.seen.refused, *outliers.items())
    tell("cross-validating", 0.75)
    curve, k_fold_mm = _held_out(scans, inliers)
    estimate, unconfirmed = _unconfirmed(scans, found, inliers)
    warnings = (*found.warnings, *found.estimate.warnings, *_warnings(scans, found, inliers, agreement), *unconfirmed)
    refined, case = found.refined, dataset_case(scans.data, scans.seen, scans.standard, scans.standard)
    return RecordedFlange(
        result=_result(scans, replace(found, estimate=estimate), inliers, warnings),
        estimate=estimate,
        observations=found.observations,
        scanner=found.scanner,
        seen=scans.seen,
        refused=refused,
        outliers=tuple(outliers),
        convergence=curve,
        k_fold_mm=k_fold_mm,
        advice=sampling_advice(estimate, found.observations),
        notes=scans.data.notes,
        refinement=None if refined is None else refined.document(asked.refine or ""),
        kinematics="" if refined is None else refined.kinematics,
        case=replace(case, asked="".join(unconfirmed)),
    )


def _find_flanges(folder: Path, asked: FlangeOptions, tell: Tell, known: dict[str, FlangeScan] | None) -> _Scans:
    """Read the dataset and fit the flange in each scan; with too few, start from the visible arm."""
    require_flange(folder, asked.flange, asked.robot)
    data = load_dataset(folder, robot=asked.robot or "")
    if asked.poses is not None:
        data = data.between(asked.poses)
    robot, standard = asked.robot or data.header.robot, get_flange(asked.flange or data.header.flange)
    seen = fit_flanges(
        data, standard, seed=asked.seed, tell=lambda part: tell("fitting flanges", 0.7 * part), known=known
    )
    start: ArmStart | None = None
    if len(seen.observations) < ENOUGH and seen.refused and not data.pairs and data.header.scanner_guess is None:
        tell("comparing the visible arm", 0.7)
        from weldcal.calibration.eye_on_base.arm_start import see_with_arm

        seen, start = see_with_arm(data, seen, standard, robot, seed=asked.seed)
    return _Scans(asked, seen.data or data, standard, seen, start, robot=robot)


def _solve(scans: _Scans, tell: Tell, examine: Examine) -> tuple[Calibration, str]:
    """Estimate X_BC, refined where that is asked, and say how the visible arm agrees with it."""
    asked, seen, observations = scans.asked, scans.seen, scans.seen.observations
    steps = Steps(
        patterns=seen.patterns,
        correct_scanner=scans.corrects,
        axis_turn_rad=None if asked.axis_turn_deg is None else float(np.radians(asked.axis_turn_deg)),
        X_FR=scans.X_FR,
        feature_m=0.5 * scans.standard.outer_m,
        coplanar=bool(seen.fits),
        seed=asked.seed,
    )
    try:
        _require_enough(scans)
        found = calibrate(observations, steps, lambda step: tell(step, 0.72))
        p_BR = np.array([o.p_BR for o in observations])
        agreement = "" if scans.start is None else scans.start.agreement(found.X_rigid, p_BR)
    except WeldcalError as problem:
        if (case := _refused_case(scans)) is not None:
            examine(problem, case)
        raise
    if asked.refine is None:
        return found, agreement
    tell("refining", 0.73)
    return refine(found, observations, _refining(scans, steps, asked.refine)), agreement


def _require_enough(scans: _Scans) -> None:
    """Require one usable scan.

    Where others were refused: four (then more can be taken), or two that the visible arm confirms.

    Raises:
        InputError, TooFewPoses: there are fewer.
    """
    n, refused, start = len(scans.seen.observations), scans.seen.refused, scans.start
    arm = "" if start is None else f" {start.sentence}"
    if n == 0:
        same = len({r for _, r in refused}) == 1 and len(refused) > 1
        which = "every cloud" if same else f"the first, {refused[0][0]}"
        raise InputError(f"None of the {len(refused)} clouds can be used. Reason for {which}: {refused[0][1]}{arm}")
    confirmed = start is not None and start.accepted and n > 1
    if n < ENOUGH and refused and not confirmed:
        names = "; ".join(f"{i}: {t}" for i, t in refused[:3])
        raise TooFewPoses(
            f"Only {n} usable poses remain of {n + len(refused)}; at least {ENOUGH} are needed. Refused: {names}{arm}"
        )


def _refused_case(scans: _Scans) -> DoctorCase | None:
    """Return the case of refused scans; None for fewer than five.

    Where the dataset's guess of X_BC left too few scans, each scan is searched whole: the guess or the poses may be
    wrong.
    """
    data, seen, standard = scans.data, scans.seen, scans.standard
    if len(seen.observations) < FEWEST and data.header.scanner_guess is not None:
        anywhere = replace(data, header=replace(data.header, scanner_guess=None))
        seen = fit_flanges(anywhere, standard, holes=False, seed=scans.asked.seed)
    return dataset_case(data, seen, standard, standard) if len(seen.observations) >= FEWEST else None


def _refining(scans: _Scans, steps: Steps, kind: str) -> Steps:
    """The steps with a refinement of REFINEMENTS. Raises InputError where the arm or its joint angles are not known."""
    if kind == "local":
        return replace(steps, refine=kind)
    data, robot = scans.data, scans.robot
    if robot not in known_arms():
        raise InputError(
            f"Errors of the arm (--refine {kind}) are written as Universal Robots' kinematics: name one of"
            f" {', '.join(known_arms())} with --robot, or use --refine local."
        )
    arm = load_chain(robot, scans.asked.kinematics)
    ids = [o.id for o in scans.seen.observations]
    poses = {p.id: p.X_BR for p in data.pairs} or data.poses
    from weldcal.calibration.refinement.kinematics_choice import require_joint_angles

    q = require_joint_angles(data, ids, arm, np.array([poses[id].GetAsMatrix4() for id in ids]))
    note = f"{robot}, refined by weldcal calibrate --refine {kind}"
    # errors of the arm are found beside those of the scanner, as motion shows both
    correct = scans.asked.correct_scanner and not scans.few
    return replace(steps, refine=kind, arm=arm, joints=q, note=note, correct_scanner=correct)


def _held_out(scans: _Scans, inliers: list[Observation]) -> tuple[Convergence, dict[str, float]]:
    """Return the errors on unused scans by the number of scans, and those of folds (mm)."""
    seed, correct = scans.asked.seed, scans.corrects and not scans.few
    solve = partial(solve_jointly, patterns=scans.seen.patterns, correct_scanner=correct, seed=seed)
    folds = np.full((1, 1), np.nan)
    if len(inliers) >= _FOLDED:
        folds = k_fold(inliers, folds=min(5, len(inliers)), repeats=5, seed=seed, solve=solve)
    return convergence(inliers, orders=8, seed=seed, solve=solve), statistics(1e3 * folds[np.isfinite(folds)])


def _unconfirmed(
    scans: _Scans, found: Calibration, inliers: list[Observation]
) -> tuple[CalibrationEstimate, tuple[str, ...]]:
    """Return the estimate, and a sentence on the scanner correction that the robot's motion alone asks for.

    Many programs could not apply it, and without it X_BC would be off by what it takes over: the covariance says so.
    """
    if not scans.asked.correct_scanner or scans.confirmed or scans.few:
        return found.estimate, ()
    wanted, verdict = estimate_jointly(inliers, config=SolveConfig(seed=scans.asked.seed, allow_coplanar=True))
    estimate = left_uncorrected(found.estimate, wanted) if found.refined is None else found.estimate
    if verdict is None or verdict.accepted is None:
        return estimate, ()
    left = 1e3 * float(np.nanmean(wanted.held_out.position_m))
    shown = (
        f"fewer than {_CONFIRMING} scans show the flange's hole circle"
        if scans.standard.n_holes
        else "no hole circle is there"
    )
    sentence = (
        "The scanner is not corrected: the robot's motion asks for a scale of"
        f" {1e2 * (verdict.accepted.scale - 1.0):+.2f} %, with which the held-out errors would be {left:.3f} mm (mean),"
        f" but {shown} to confirm it."
    )
    return estimate, (sentence,)


def _warnings(scans: _Scans, found: Calibration, inliers: list[Observation], agreement: str) -> list[str]:
    """Return sentences on what these scans cannot show, and on what was corrected."""
    warnings, fits = [], scans.seen.fits
    if scans.data.pairs and not any(p.has_orientation for p in scans.data.pairs):
        warnings.append(
            "The pairs have no orientations. A constant error of the flange centre would not show in these figures."
        )
    elif turn_deg([o.X_BR for o in inliers]) < _TURN_DEG:
        warnings.append(
            "The poses hardly differ in orientation, so they cannot show a TCP that is set at the robot: it would shift"
            " X_BC by its own length, and no figure here would tell. Check that the TCP is zero, or tilt the flange in"
            " some poses."
        )
    loose = [id for id, fit in fits.items() if not fit.on_grid]
    if loose:
        warnings.append(
            f"{len(loose)} of {len(fits)} clouds have no pixel grid that could be rebuilt ({', '.join(loose[:3])}):"
            " fused, thinned, or not in the scanner's frame. Their centres are two to three times less precise; export"
            " single scans as the scanner takes them."
        )
    if agreement:
        warnings.append(agreement)
    if found.refined is not None:
        warnings.append(found.refined.sentence)
    if found.scanner is not None and found.scanner.worth_saying:
        warnings.append(found.scanner.sentence)
    return warnings


def _result(
    scans: _Scans, found: Calibration, inliers: list[Observation], warnings: tuple[str, ...]
) -> CalibrationResult:
    """Return the contents of calibration.yaml."""
    estimate, refined, data = found.estimate, found.refined, scans.data
    turned = scans.asked.axis_turn_deg is None
    return estimate_result(
        estimate,
        scans.seen.observations,
        scans.seen.refused,
        scans.X_FR,
        _angles(data, inliers),
        warnings=warnings,
        robot=scans.robot,
        flange=scans.standard.designation,
        scanner=data.header.scanner,
        seed=scans.asked.seed,
        data_hashes=data.hashes,
        scanner_correction=None if found.correction is None else found.correction.document(),
        axis_turn_deg=_axis_turn(inliers, scans.seen.patterns, found.X_rigid) if turned else None,
        local_field=None if refined is None or refined.field is None else refined.field.document(),
        arm_errors=None if refined is None else refined.arm,
        kinematics="" if refined is None else refined.kinematics,
        **({} if scans.seen.fits else {"sigma_normal_deg": 0.0}),
        # positions alone say nothing of the flange's orientation
        **({} if all(p.has_orientation for p in data.pairs) else {"orientations": None, "observed": None}),
    )


def _angles(data: Dataset, inliers: list[Observation]) -> list[Array]:
    """Joint angles (n, joints) rad of the poses; none where the table has none."""
    found = (joint_angles(data, [o.id for o in inliers], joints) for joints in (7, 6))
    return list(next((q for q in found if q is not None), ()))


def _axis_turn(
    inliers: list[Observation], patterns: dict[str, HolePattern], X_BC: RigidTransform
) -> tuple[float, float] | None:
    """Estimate the rotation of the hole pattern about the flange axis and its spread over the scans (deg).

    It is for later use as axis_turn_deg; None where fewer than four scans show it. From uncorrected scans, as in a
    calibration from one scan.
    """
    seen = [o for o in inliers if o.id in patterns and patterns[o.id].turn_known]
    if len(seen) < ENOUGH:
        return None
    turn, spread = axis_turn(seen, patterns, X_BC)
    return float(np.degrees(turn)), float(np.degrees(spread))
