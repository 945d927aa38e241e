"""`weldcal calibrate`: estimates X_BC and its uncertainty from a folder of scans, and writes exports and a report."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from pydrake.math import RigidTransform

from weldcal.calibration.calibrate import KINEMATICS_FILE, REFINEMENTS, Steps
from weldcal.calibration.calibrate import calibrate as calibrate_observations
from weldcal.calibration.calibrate import refine as refine_calibration
from weldcal.calibration.data.checks import is_carried, is_motion
from weldcal.calibration.data.dataset import Dataset, joint_angles, load_dataset
from weldcal.calibration.data.results import CalibrationResult, IcpRecord, export_all, save_result, software_version
from weldcal.calibration.doctor.case import FEWEST, dataset_case, write_case
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
from weldcal.calibration.eye_on_base.few_poses import ENOUGH, axis_turn
from weldcal.calibration.eye_on_base.joint_fit import ScannerVerdict, estimate_jointly, left_uncorrected, solve_jointly
from weldcal.calibration.eye_on_base.observations import FlangeObservations, fit_flanges, require_flange
from weldcal.calibration.eye_on_base.solve import SolveConfig
from weldcal.calibration.eye_on_base.stated_error import observed_document, orientations_of
from weldcal.calibration.eye_on_base.validation import convergence, k_fold, sampling_advice
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.planning.observability import turn_deg
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import known_arms
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.flanges import FlangeStandard, get_flange
from weldcal.tools.cli.options import (
    MOTION,
    Call,
    CorrectionOption,
    FlangeOption,
    LimitOption,
    Outcome,
    command,
    option,
    switch,
)
from weldcal.tools.console import Progress
from weldcal.tools.report.calibration import (
    Algorithm1Outcome,
    CalibrationReport,
    calibration_report,
    pose_records,
    tilt_summary,
)
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.render import csv_text, statistics, write_atomic

if TYPE_CHECKING:
    from weldcal.calibration.eye_on_base.arm_start import ArmStart

_CONFIRMING = 3  # hole circles without which the robot's motion alone does not change the scanner
_TURN_DEG = 3.0  # orientations closer than this are one orientation to a calibration


@command("calibrate", options=(*MOTION, "record"), short_help="Calibrate a scanner from scans, or live in a scenario.")
def calibrate(
    call: Call,
    dataset: Annotated[
        Path | None, typer.Argument(help="A folder with poses and clouds (docs/datasets.md), or a ROS recording.")
    ] = None,
    scenario: Annotated[str | None, option("--scenario", "NAME", "Calibrate live in this scenario instead.")] = None,
    robot: Annotated[
        str | None,
        option(
            "--robot",
            "NAME",
            "For a dataset: the arm, if dataset.yaml does not name it. Live: simulated, emulated or a controller's"
            " address.",
        ),
    ] = None,
    flange: FlangeOption = None,
    centres: Annotated[
        bool, switch("--centres", "Also write centres.csv: the flange centre found in each scan of a dataset.")
    ] = False,
    scanner_correction: CorrectionOption = True,
    poses: Annotated[
        str | None,
        option("--poses", "FROM:TO", "Of a dataset: use only the scans from one id to another, such as p09: or :p08."),
    ] = None,
    refine: Annotated[
        str | None,
        option(
            "--refine",
            "KIND",
            "Of a dataset: local (a field of what the calibration leaves), joints or links (errors of the arm; needs"
            " its joint angles).",
        ),
    ] = None,
    kinematics: Annotated[
        Path | None,
        option(
            "--kinematics",
            "FILE",
            "With --refine joints or links: the arm's factory calibration, which the controller uses.",
        ),
    ] = None,
    axis_turn: Annotated[
        float | None,
        option(
            "--axis-turn",
            "DEG",
            "Known rotation of the hole pattern about the flange axis; one to three scans are then enough.",
        ),
    ] = None,
    compare: Annotated[
        bool, switch("--compare", "Of a dataset: also run the published method (Algorithm 1, ICP) on the same scans.")
    ] = False,
    limit_mm: LimitOption = None,
) -> Outcome | Mapping[str, object] | None:
    """Calibrate a scanner from a folder of flange scans and robot poses, or live in a scenario."""
    if (dataset is None) == (scenario is None):
        raise typer.BadParameter("give either a dataset folder or --scenario NAME")
    if scenario is not None:
        if poses is not None or refine is not None or kinematics is not None or compare:
            raise typer.BadParameter(
                "--poses, --refine, --kinematics and --compare are for a dataset; omit them with --scenario"
            )
        if limit_mm is not None:
            raise typer.BadParameter("--limit-mm is for a dataset; a scenario states calibration.required_error_mm")
        from weldcal.tools.commands.demo import calibrate_live

        return calibrate_live(call, scenario, robot)
    assert dataset is not None
    if is_motion(dataset):
        if poses is not None or axis_turn is not None or refine is not None or compare:
            raise typer.BadParameter(
                "--poses, --refine, --axis-turn and --compare are for scans at rest; omit them with a recording in"
                " motion"
            )
        from weldcal.tools.commands.calibrate_motion import calibrate_recording

        return calibrate_recording(call, dataset, robot, flange, centres=centres, limit_mm=limit_mm)
    if is_carried(dataset):
        if axis_turn is not None or refine is not None or compare or centres or not scanner_correction:
            raise typer.BadParameter(
                "--refine, --axis-turn, --compare, --centres and --no-scanner-correction are for a scanner beside the"
                " robot; omit them"
            )
        from weldcal.tools.commands.mounting_live import calibrate_recorded

        return calibrate_recorded(call, dataset, robot, flange, poses=poses, limit_mm=limit_mm)
    report = calibrate_dataset(
        dataset,
        call.folder("calibrate", dataset.resolve().name),
        robot=robot,
        flange=flange,
        seed=call.seed,
        progress=call.progress,
        centres=centres,
        correct_scanner=scanner_correction,
        axis_turn_deg=axis_turn,
        poses=poses,
        refine=refine,
        kinematics=kinematics,
        compare=compare,
        limit_mm=limit_mm,
    )
    rows = {} if report.algorithm1 is None else {"Algorithm 1": report.algorithm1.sentence}
    if report.refinement is not None:
        rows["refinement"] = str(report.refinement["sentence"])
    interval = report.held_out_interval_mm
    if interval is not None:
        rows |= report.interval_rows
        rows["mean error of as many new scans"] = f"{interval[0]:.3f} to {interval[1]:.3f} mm (95 %)"
    rows["error budget"] = report.budget.sentence
    return Outcome(report.summary(), rows=rows, first=report.first)


def calibrate_dataset(
    folder: Path,
    out: Path,
    *,
    robot: str | None = None,
    flange: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    centres: bool = False,
    correct_scanner: bool = True,
    axis_turn_deg: float | None = None,
    poses: str | None = None,
    refine: str | None = None,
    kinematics: Path | None = None,
    compare: bool = False,
    limit_mm: float | None = None,
) -> CalibrationReport:
    """Calibrate from a dataset folder and write ``calibration.yaml``, exports and ``report.html`` to ``out``.

    ``robot`` and ``flange`` override dataset.yaml. ``centres`` also writes centres.csv (camera frame, metres,
    uncorrected). ``correct_scanner``: estimate and apply a scanner correction. ``axis_turn_deg``: rotation of the hole
    pattern about the flange axis; with it, one to three scans that show the holes are enough. ``poses`` ("FROM:TO",
    ids, either may be left out) takes the scans from one id to another, in the order of the dataset. ``refine``:
    "local" adds a field of what the calibration leaves, "joints" or "links" errors of the arm (beyond its factory
    calibration ``kinematics``), each applied where nested held-out errors fall. ``compare`` runs the published method
    on the same scans, for the report. A cloud that cannot be used is refused and reported, as long as enough remain.
    Where five scans or more contradict each other only observations.csv is written, for `weldcal doctor`. ``limit_mm``
    is the error, at 95 %, that the job allows.

    Raises:
        InputError: the data cannot be used; TooFewPoses: too few scans can be used.
    """
    started = time.monotonic()
    check_limit(limit_mm)
    if refine is not None and refine not in REFINEMENTS:
        raise InputError(f"There is no refinement '{refine}'. Choose one of {', '.join(REFINEMENTS)}.")
    tell: Progress = progress or (lambda stage, fraction: None)
    if Path(out).exists() and not Path(out).is_dir():
        raise InputError(f"'{out}' is a file. Give a folder for the result.")
    require_flange(Path(folder), flange, robot)
    data = load_dataset(Path(folder), robot=robot or "")
    if poses is not None:
        data = data.between(poses)
    standard = get_flange(flange or data.header.flange)
    seen = fit_flanges(data, standard, seed=seed, tell=lambda fraction: tell("fitting flanges", 0.7 * fraction))
    start: ArmStart | None = None
    if len(seen.observations) < ENOUGH and seen.refused and not data.pairs and data.header.scanner_guess is None:
        tell("comparing the visible arm", 0.7)
        from weldcal.calibration.eye_on_base.arm_start import see_with_arm

        seen, start = see_with_arm(data, seen, standard, robot or data.header.robot, seed=seed)
    data = seen.data or data
    observations, fits, refused = list(seen.observations), seen.fits, list(seen.refused)
    few = len(observations) < ENOUGH
    confirmed = len(seen.patterns) >= _CONFIRMING
    with _examined_where_refused(Path(out), data, seen, standard, seed):
        _enough(observations, refused, start)
        steps = Steps(
            patterns=seen.patterns,
            correct_scanner=correct_scanner and confirmed,
            axis_turn_rad=None if axis_turn_deg is None else float(np.radians(axis_turn_deg)),
            X_FR=None if data.pairs else data.X_FR,
            feature_m=0.5 * standard.outer_m,
            coplanar=bool(fits),
            seed=seed,
        )
        found = calibrate_observations(observations, steps, lambda step: tell(step, 0.72))
        agreement = "" if start is None else start.agreement(found.X_rigid, np.array([o.p_BR for o in observations]))
    if refine is not None:
        tell("refining", 0.73)
        steps = _refinement(refine, steps, data, observations, robot or data.header.robot, kinematics)
        if refine != "local":  # errors of the arm are found beside those of the scanner, as motion shows both
            steps = replace(steps, correct_scanner=correct_scanner and not few)
        found = refine_calibration(found, observations, steps)
    estimate, corrected, scanner, refined = found.estimate, found.observations, found.scanner, found.refined
    outliers = tuple(o.id for o, keep in zip(observations, estimate.inliers, strict=True) if not keep)
    errors = dict(zip((o.id for o in observations), estimate.position_residuals_m, strict=True))
    refused += [
        (i, f"Its centre disagrees by {1e3 * errors[i]:.1f} mm with the other poses; it is not used.") for i in outliers
    ]
    inliers = [o for o, keep in zip(observations, estimate.inliers, strict=True) if keep]
    tell("cross-validating", 0.75)
    solve = partial(
        solve_jointly, patterns=seen.patterns, correct_scanner=correct_scanner and confirmed and not few, seed=seed
    )
    folds = (
        k_fold(inliers, folds=min(5, len(inliers)), repeats=5, seed=seed, solve=solve)
        if len(inliers) >= 6
        else np.full((1, 1), np.nan)
    )
    curve = convergence(inliers, orders=8, seed=seed, solve=solve)
    algorithm1: Algorithm1Outcome | None = None
    icp: tuple[IcpRecord, ...] = ()
    if compare:
        tell("Algorithm 1 for comparison", 0.8)
        from weldcal.tools.commands.algorithm1_comparison import compare_algorithm1

        algorithm1, icp = compare_algorithm1(seen, inliers, curve.counts, standard, seed)
    warnings = [*found.warnings, *estimate.warnings]
    if data.pairs and not any(p.has_orientation for p in data.pairs):
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
    if refined is not None:
        warnings.append(refined.sentence)
    if scanner is not None and scanner.worth_saying:
        warnings.append(scanner.sentence)
    unconfirmed: list[str] = []
    if correct_scanner and not confirmed and not few:
        asked, verdict = estimate_jointly(inliers, config=SolveConfig(seed=seed, allow_coplanar=True))
        unconfirmed = _unconfirmed(asked, verdict)
        warnings += unconfirmed
        if refined is None:
            estimate = left_uncorrected(estimate, asked)
    correction = None if found.correction is None else found.correction.document()
    values = {
        "residual_mm": 1e3 * estimate.position_residuals_m,
        "held_out_mm": 1e3 * estimate.held_out.position_m,
        "tilt_deg": np.degrees(estimate.tilt_residuals_rad),
        "held_out_tilt_deg": np.degrees(estimate.held_out.tilt_rad),
    }
    result = CalibrationResult(
        X_BC=estimate.X_BC,
        covariance=estimate.covariance,
        held_out_mm=statistics(1e3 * estimate.held_out.position_m[estimate.inliers]),
        tilt_deg=tilt_summary(estimate.held_out.tilt_rad[estimate.inliers]),
        poses=pose_records([o.id for o in observations], estimate.inliers, values, refused),
        icp=icp,
        unobservable=estimate.unobservable,
        warnings=tuple(warnings),
        robot=robot or data.header.robot,
        flange=standard.designation,
        scanner=data.header.scanner,
        sigma_position_mm=1e3 * estimate.sigma_position_m,
        sigma_normal_deg=float(np.degrees(estimate.sigma_normal_rad)) if fits else 0.0,
        seed=seed,
        data_hashes=data.hashes,
        scanner_correction=correction,
        joint_covariance=estimate.joint,
        axis_turn_deg=_axis_turn(inliers, seen.patterns, found.X_rigid) if axis_turn_deg is None else None,
        local_field=None if refined is None or refined.field is None else refined.field.document(),
        orientations=(
            orientations_of(inliers, None if data.pairs else data.X_FR)
            if not data.pairs or all(p.has_orientation for p in data.pairs)
            else None
        ),
        observed=(
            observed_document(inliers, RigidTransform() if data.pairs else data.X_FR, _angles(data, inliers))
            if not data.pairs or all(p.has_orientation for p in data.pairs)
            else None
        ),
        arm_errors=None if refined is None else refined.arm,
        kinematics_file=KINEMATICS_FILE if refined is not None and refined.kinematics else "",
        software=software_version(),
    )
    report = CalibrationReport(
        result=result,
        estimate=estimate,
        observations=corrected,
        scanner=scanner,
        fits=fits,
        refused=tuple(refused),
        outliers=outliers,
        algorithm1=algorithm1,
        convergence=curve,
        k_fold_mm=statistics(1e3 * folds[np.isfinite(folds)]),
        seconds=time.monotonic() - started,
        out=Path(out),
        advice=sampling_advice(estimate, corrected),
        patterns=seen.patterns,
        clouds=seen.clouds,
        notes=data.notes,
        refinement=None if refined is None else refined.document(refine or ""),
        limit_mm=limit_mm,
    )
    tell("writing the report", 0.95)
    html = calibration_report(report, dataset=Path(folder).name)
    write_atomic(Path(out) / "report.html", html)
    export_all(result, Path(out))
    if refined is not None and refined.kinematics:
        write_atomic(Path(out) / KINEMATICS_FILE, refined.kinematics)
    if centres:
        write_atomic(Path(out) / "centres.csv", _centres_csv(observations))
    write_case(Path(out), replace(dataset_case(data, seen, standard, standard), asked="".join(unconfirmed)))
    # last, so that its presence means that everything else is there
    save_result(result, Path(out))
    report = replace(report, seconds=time.monotonic() - started)
    tell("done", 1.0)
    return report


@contextmanager
def _examined_where_refused(
    out: Path, data: Dataset, seen: FlangeObservations, standard: FlangeStandard, seed: int
) -> Iterator[None]:
    """Write the case to ``out`` where the block refuses five scans or more; the error goes on, with its likely cause.

    Where the dataset's guess of X_BC left too few scans, each scan is searched whole: the guess or the poses may be
    wrong.
    """
    try:
        yield
    except WeldcalError as problem:
        if len(seen.observations) < FEWEST and data.header.scanner_guess is not None:
            anywhere = replace(data, header=replace(data.header, scanner_guess=None))
            seen = fit_flanges(anywhere, standard, holes=False, seed=seed)
        if len(seen.observations) >= FEWEST:
            case = dataset_case(data, seen, standard, standard)
            write_case(out, case)
            from weldcal.tools.report.doctor import name_cause

            name_cause(problem, case)
        raise


def _refinement(
    kind: str, steps: Steps, data: Dataset, observations: list[Observation], robot: str, kinematics: Path | None
) -> Steps:
    """The steps with a refinement of REFINEMENTS. Raises InputError where the arm or its joint angles are not known."""
    if kind == "local":
        return replace(steps, refine=kind)
    if robot not in known_arms():
        raise InputError(
            f"Errors of the arm (--refine {kind}) are written as Universal Robots' kinematics: name one of"
            f" {', '.join(known_arms())} with --robot, or use --refine local."
        )
    arm = load_chain(robot, kinematics)
    ids = [o.id for o in observations]
    poses = {p.id: p.X_BR for p in data.pairs} or data.poses
    from weldcal.calibration.refinement.kinematics_choice import require_joint_angles

    q = require_joint_angles(data, ids, arm, np.array([poses[id].GetAsMatrix4() for id in ids]))
    note = f"{robot}, refined by weldcal calibrate --refine {kind}"
    return replace(steps, refine=kind, arm=arm, joints=q, note=note)


def _unconfirmed(asked: CalibrationEstimate, verdict: ScannerVerdict | None) -> list[str]:
    """Name the scanner correction that the robot's motion alone asks for, in a sentence.

    Many programs could not apply it, and without it X_BC would be off by what it takes over.
    """
    if verdict is None or verdict.accepted is None:
        return []
    left = 1e3 * float(np.nanmean(asked.held_out.position_m))
    return [
        "The scanner is not corrected: the robot's motion asks for a scale of"
        f" {1e2 * (verdict.accepted.scale - 1.0):+.2f} %, with which the held-out errors would be {left:.3f} mm (mean),"
        f" but fewer than {_CONFIRMING} scans show the flange's hole circle to confirm it."
    ]


def _angles(data: Dataset, inliers: list[Observation]) -> list[Array]:
    """Joint angles (n, joints) rad of the poses; none where the table has none."""
    for joints in (7, 6):
        q = joint_angles(data, [o.id for o in inliers], joints)
        if q is not None:
            return list(q)
    return []


def _enough(observations: list[Observation], refused: list[tuple[str, str]], start: "ArmStart | None") -> None:
    """Require one usable scan.

    Where others were refused: four (then more can be taken), or two that the visible arm confirms.

    Raises:
        InputError, TooFewPoses: there are fewer.
    """
    n = len(observations)
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


def _centres_csv(observations: list[Observation]) -> str:
    rows = []
    for o in observations:
        normal = ["", "", ""] if o.n_C is None else [f"{v:.9f}" for v in o.n_C]
        rows.append([o.id, *(f"{v:.9f}" for v in o.p_CR), *normal])
    return csv_text(("id", *(f"{what}_{axis}" for what in ("centre", "normal") for axis in "xyz")), rows)
