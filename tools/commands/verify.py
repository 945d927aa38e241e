"""`weldcal verify RESULT DATASET`: judges a calibration by its errors at the flange on scans that it did not use."""

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from pydrake.math import RigidTransform

from weldcal.calibration.data.dataset import Dataset, joint_angles, load_dataset
from weldcal.calibration.data.results import RESULT_FILE, CalibrationResult, load_result
from weldcal.calibration.data.scanner_correction import ScannerCorrection, correction_from_document
from weldcal.calibration.data.stated_pose import HAND_EYE_FILE, read_stated_pose
from weldcal.calibration.eye_on_base.estimate import corrected_observation
from weldcal.calibration.eye_on_base.observations import fit_flanges
from weldcal.calibration.eye_on_base.stated_error import FALSE_ALARM, scatter_elsewhere, stated_median_limit
from weldcal.calibration.eye_on_base.validation import offset_from, position_errors, scale_error, tilt_errors
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import as_transform
from weldcal.calibration.planning.observability import turn_deg
from weldcal.calibration.refinement.kinematics_choice import shared_error
from weldcal.calibration.refinement.local_field import field_from_document
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.tools.cli.options import Call, CorrectionOption, FlangeOption, Outcome, command, option
from weldcal.tools.commands.hand_eye import (
    BoardOption,
    CameraPosesOption,
    MountingOption,
    RobotPosesOption,
    UnitOption,
    stated_lists,
)
from weldcal.tools.commands.verify_pairs import holds_scans, verify_on_pairs
from weldcal.tools.console import Progress
from weldcal.tools.report.first_screen import CARE, DO_NOT, USE
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.verify import NONE, PoseError, Verdict, VerifyReport, verify_report

_FEW = 4
_TURN_DEG = 3.0  # orientations closer than this are one orientation to a verification
_GROSS = 10.0  # times the usual error: a gross outlier
_WORST_TILT_DEG = 10.0
_SAME_MM = 1e-6  # a scan of the same name whose error repeats the recorded residual to a nanometre is the same scan
_EVIDENT = 4.0  # standard errors of a scale error that is worth naming


_UNCORRECTED = (
    "The result's scanner correction is not applied, as requested. Its X_BC belongs to corrected points, so these are"
    " the errors of a program that does not correct its scans."
)


@command(
    "verify",
    keys=("robot-form", "camera-form", "intrinsics"),
    options=("browser", "share"),
    defaults={"browser": False},
    short_help="Verify a calibration on scans that it did not use.",
)
def verify(
    call: Call,
    result: Annotated[
        Path,
        typer.Argument(
            help="A result folder, its calibration.yaml, or any file with a camera's pose (docs/hand_eye.md)."
        ),
    ],
    dataset: Annotated[
        Path | None,
        typer.Argument(
            help=(
                "Scans: a folder with poses and clouds, or pairs.csv. Or pairs of poses or pictures, as hand-eye reads"
                " (docs/datasets.md)."
            )
        ),
    ] = None,
    touch: Annotated[
        Path | None,
        option(
            "--touch",
            "CSV",
            "Points that the robot's tip touched and the scanner measured (docs/datasets.md), in place of scans.",
        ),
    ] = None,
    scenario: Annotated[
        str | None,
        option(
            "--scenario", "NAME", "In place of scans let this scenario's robot touch the part that its scanner sees."
        ),
    ] = None,
    robot: Annotated[
        str | None, option("--robot", "NAME", "The arm of joint angles; with --scenario: simulated or an address ...")
    ] = None,
    flange: FlangeOption = None,
    scanner_correction: CorrectionOption = True,
    limit_mm: Annotated[
        float | None,
        option(
            "--limit-mm",
            "MM",
            "Largest median error of the new scans.",
            show_default="from what the calibration states; 1 % false alarms",
        ),
    ] = None,
    pose: Annotated[
        str | None, option("--pose", "NAME", "The key of the pose, where the file of RESULT holds several.")
    ] = None,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    robot_poses: RobotPosesOption = None,
    camera_poses: CameraPosesOption = None,
    board: BoardOption = None,
) -> Outcome:
    """Verify a calibration on scans, pairs of poses or pictures that it did not use: a verdict, and the error of each.

    Scans of the flange give position error and tilt at the flange. Pairs of robot and camera poses, or pictures of a
    board (--board), give the error of any stated pose of a camera. With --touch or --scenario: by points that the tip
    touched, each against the stated 95 % region. The exit code is 1 where the verdict is "do not use".
    """
    if sum(given is not None for given in (dataset, touch, scenario)) != 1:
        raise typer.BadParameter(
            "give a folder of new scans, touched points (--touch FILE) or a cell (--scenario NAME)"
        )
    if touch is not None or scenario is not None:
        from weldcal.tools.commands.touch import live_touches_outcome, touches_outcome
    if scenario is not None:
        return live_touches_outcome(call, result, scenario, robot or "simulated")
    if touch is not None or dataset is None:
        assert touch is not None
        return touches_outcome(call, result, touch)
    named = {"--unit": unit, "--robot-poses": robot_poses, "--camera-poses": camera_poses}
    of_pairs = [(name, value) for name, value in named.items() if value is not None]
    of_pairs += [("--as", f"{key}={value}") for key, value in call.reading.items()]
    if board is not None or not holds_scans(dataset):
        paired = verify_on_pairs(
            result,
            dataset,
            call.folder("verify", dataset.resolve().stem),
            mounting=mounting,
            unit=unit,
            pose=pose,
            limit_mm=limit_mm,
            board=board,
            intrinsics=call.reading.get("intrinsics"),
            stated=replace(stated_lists(call, robot_poses, camera_poses), arm=robot),
            seed=call.seed,
            options=tuple(word for name, value in of_pairs for word in (name, shlex.quote(value))),
        )
        return Outcome(paired.summary(), values={}, rows=paired.rows(), first=paired.first)
    if of_pairs or mounting is not None:
        surplus = of_pairs[0][0] if of_pairs else "--mounting"
        raise typer.BadParameter(f"{surplus} is for pairs of poses, and '{dataset.name}' holds scans of a flange")
    report = verify_dataset(
        result,
        dataset,
        call.folder("verify", dataset.resolve().name),
        flange=flange,
        seed=call.seed,
        progress=call.progress,
        correct_scanner=scanner_correction,
        limit_mm=limit_mm,
        pose=pose,
        robot=robot,
    )
    summary = report.summary()
    return Outcome(
        summary,
        values={key: value for key, value in summary.items() if key not in ("verdict", "reason")},
        rows=report.interval_rows,
        first=report.first,
    )


def verify_dataset(
    result: Path,
    dataset: Path,
    out: Path,
    *,
    flange: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    correct_scanner: bool = True,
    limit_mm: float | None = None,
    pose: str | None = None,
    robot: str | None = None,
) -> VerifyReport:
    """Verify a calibration on a dataset folder; write verification.json and report.html.

    The calibration is its folder or calibration.yaml, or any file with a pose. Errors are taken at the flange centre,
    in the base, after the result's scanner correction. A scan in which no flange is found is named and not used.
    Without ``correct_scanner`` the result's correction is not applied. ``flange`` overrides dataset.yaml; the fits
    follow ``seed``. ``limit_mm`` of the new scans' median replaces the one that follows from what the calibration
    states. ``pose`` names the pose in a file of several.
    ``robot`` is the arm of joint angles. Nothing is written unless at least one scan can be used.

    Raises:
        InputError: the result, the dataset or the output folder cannot be used.
    """
    tell: Progress = progress or (lambda stage, fraction: None)
    if limit_mm is not None and not (np.isfinite(limit_mm) and limit_mm > 0.0):
        raise InputError(f"The limit must be a positive number of millimetres, not {limit_mm:g}.")
    if Path(out).exists() and not Path(out).is_dir():
        raise InputError(f"'{out}' is a file. Give a folder for the verification.")
    calibrations, read_as = _calibrations(Path(result), pose)
    calibration = calibrations[0]
    correction = correction_from_document(calibration.scanner_correction) if correct_scanner else None
    data = load_dataset(Path(dataset), robot=robot or calibration.robot)
    standard = get_flange(flange or data.header.flange or calibration.flange)
    seen = fit_flanges(
        data,
        standard,
        X_BC=calibration.X_BC if len(calibrations) == 1 else None,
        holes=False,
        seed=seed,
        tell=lambda fraction: tell("fitting flanges", 0.9 * fraction),
    )
    data = seen.data or data
    differences = _differences(calibrations[0], data, standard.designation)
    other_arm = f"{differences[0]} " if differences and data.header.robot not in ("", calibrations[0].robot) else ""
    if not seen.observations:
        first, reason = seen.refused[0]
        raise InputError(
            f"{other_arm}None of the {len(seen.refused)} scans can be used. Reason for the first, {first}: {reason}"
        )
    calibration = min(calibrations, key=lambda one: float(np.median(position_errors(one.X_BC, seen.observations))))
    arm_used, moved, shared = _with_kinematics(Path(result), calibration, data, seen.observations, correction)
    seen = replace(seen, observations=moved)
    observations = tuple(o if correction is None else corrected_observation(correction, o) for o in seen.observations)
    local = field_from_document(calibration.local_field) if correct_scanner else None
    scatter = scatter_elsewhere(calibration, observations) if shared is None else None
    if local is not None:
        scatter = local.at([o.X_BR for o in observations])[1]
        observations = tuple(local.applied(calibration.X_BC, observations))
    poses = _judge(calibration, data, observations)
    uncorrected: tuple[str, ...] = () if correct_scanner or calibration.scanner_correction is None else (_UNCORRECTED,)
    uncorrected += arm_used
    gross = _gross(calibration, poses)
    new = [k for k, p in enumerate(poses) if not p.used_before]
    if limit_mm is None:
        spread = None if scatter is None else scatter[new]
        ours = None if shared is None else (shared[0][new], shared[1])
        limit_mm = stated_median_limit(calibration, [observations[k] for k in new], correction, spread, ours)
        source = f"which {100 * FALSE_ALARM:.0f} % of verifications of a calibration as good as it states exceed"
    else:
        source = "as given with --limit-mm"
    diagnostics = [*differences, *gross, *uncorrected, *_alike(data, observations)]
    verdict = _verdict([poses[k] for k in new], limit_mm, source, diagnostics)
    if other_arm.strip() not in verdict.reason:
        verdict = replace(verdict, reason=f"{other_arm}{verdict.reason}")
    without, evident = _uncorrected(calibration, observations)
    warnings = (
        *differences,
        *uncorrected,
        *(f"{id} was not used: {reason}" for id, reason in seen.refused),
        *_diagnostics(calibration, data, observations, poses),
        *(without if evident else ()),
    )
    report = VerifyReport(
        result=calibration,
        correction=correction,
        observations=observations,
        fits=seen.fits,
        poses=poses,
        refused=seen.refused,
        warnings=warnings,
        hashes=data.hashes,
        out=Path(out),
        verdict=verdict,
        source=source,
        dataset=str(dataset),
        calibration=str(result),
        notes=read_as if evident else (*read_as, *without),
        offset=offset_from(calibration.X_BC, [observations[k] for k in new], seed),
        flange=standard.designation if flange or not data.header.flange else "",
        pose=pose or "",
    )
    tell("writing the report", 0.9)
    write_atomic(Path(out) / "report.html", verify_report(report, dataset=Path(dataset).resolve().name))
    # last, so that its presence means that everything else is there
    write_atomic(Path(out) / "verification.json", json.dumps(report.summary(), indent=2, allow_nan=False) + "\n")
    tell("done", 1.0)
    return report


def _calibrations(path: Path, pose: str | None) -> tuple[list[CalibrationResult], tuple[str, ...]]:
    """Read what `calibrate` wrote, or a camera's pose in every reading that its numbers allow, with a sentence."""
    try:
        return [load_result(path)], ()
    except InputError:
        if not path.exists() or (
            (path / RESULT_FILE if path.is_dir() else path).name == RESULT_FILE and not (path / HAND_EYE_FILE).is_file()
        ):
            raise
    given = read_stated_pose(path, pose)
    if given.mounting not in (None, "eye_on_base"):
        raise InputError(
            f"'{given.name}' is the pose of a camera on the flange, which does not scan its own flange: give pairs of"
            " poses or pictures (--board) in place of scans."
        )
    covariance = np.zeros((6, 6)) if given.covariance is None else given.covariance
    found = [
        CalibrationResult(X_BC=as_transform(one.X), covariance=covariance, held_out_mm={}, tilt_deg={}, poses=())
        for one in given.readings
    ]
    best = f", the reading of {len(found)} that fits these scans best" if len(found) > 1 else ""
    return found, (f"RESULT is {given.form} in {given.unit}{best}. It states no errors of scans.",)


def _with_kinematics(
    file: Path,
    result: CalibrationResult,
    data: Dataset,
    observations: tuple[Observation, ...],
    correction: ScannerCorrection | None,
) -> tuple[tuple[str, ...], tuple[Observation, ...], tuple[Array, Array] | None]:
    """Move the observations to the poses that the arm of the result's kinematics file reaches.

    With what it states of their errors (see shared_error), or a sentence where the scans have no joint angles.
    """
    if not result.kinematics_file:
        return (), observations, None
    q = joint_angles(data, [o.id for o in observations], 6)
    if q is None:
        return (
            (
                (
                    f"The result belongs to the arm of {result.kinematics_file}, and these scans have no joint angles"
                    " (q1 to q6): the stated poses are used."
                ),
            ),
            observations,
            None,
        )
    folder = file if file.is_dir() else file.parent
    arm = load_arm(result.robot, folder / result.kinematics_file)
    X_FR = RigidTransform() if data.pairs else data.X_FR
    poses = (forward_kinematics(arm, each) @ X_FR for each in q)
    moved = tuple(replace(o, X_BR=X) for o, X in zip(observations, poses, strict=True))
    if correction is None and result.scanner_correction is not None:
        return (), moved, None  # what is stated is that of corrected scans
    return (), moved, shared_error(result, folder / result.kinematics_file, correction, moved, q)


def _judge(result: CalibrationResult, data: Dataset, observations: tuple[Observation, ...]) -> tuple[PoseError, ...]:
    errors = 1e3 * position_errors(result.X_BC, observations)
    tilts = np.degrees(tilt_errors(result.X_BC, observations))
    known = {digest for name, digest in result.data_hashes.items() if name.startswith("clouds/")}
    same_pairs = bool(data.pairs) and result.data_hashes.get("pairs.csv") == data.hashes["pairs.csv"]
    records = {p.id: p.residual_mm for p in result.poses if p.residual_mm is not None}
    poses = []
    for o, e, t in zip(observations, errors, tilts, strict=True):
        recorded = records.get(o.id)
        again = recorded is not None and abs(recorded - float(e)) < _SAME_MM
        if not data.pairs:
            again = again or data.hashes[f"clouds/{data.clouds[o.id].name}"] in known
        poses.append(PoseError(o.id, float(e), float(t) if np.isfinite(t) else None, again or same_pairs))
    return tuple(poses)


def _verdict(new: list[PoseError], limit_mm: float | None, source: str, diagnostics: list[str]) -> Verdict:
    """Return the verdict on the new scans alone; ``diagnostics`` are sentences that leave it at "use with care"."""
    if not new:
        return Verdict(NONE, None, "The calibration used all of these scans. Take new scans to verify it.")
    median = float(np.median([p.error_mm for p in new]))
    scans = f"{len(new)} new scan{'' if len(new) == 1 else 's'}"
    said = f"The median error on {scans} is {median:.3f} mm"
    tilts = [p.tilt_deg for p in new if p.tilt_deg is not None]
    if tilts and float(np.median(tilts)) > _WORST_TILT_DEG:
        return Verdict(
            DO_NOT, limit_mm, f"The scanned faces are turned by {np.median(tilts):.0f} degrees from the poses."
        )
    if limit_mm is None:
        return Verdict(CARE, None, f"{said}, and the calibration states no error of its own. Give a limit: --limit-mm.")
    if median > limit_mm:
        return Verdict(DO_NOT, limit_mm, f"{said}, above the limit of {limit_mm:.3f} mm, {source}. Calibrate again.")
    said += f", within the limit of {limit_mm:.3f} mm, {source}"
    if len(new) < _FEW:
        return Verdict(CARE, limit_mm, f"{said}; fewer than {_FEW} new scans say little.")
    if diagnostics:
        return Verdict(CARE, limit_mm, f"{said}. But: {diagnostics[0]}")
    return Verdict(USE, limit_mm, f"{said}.")


def _alike(data: Dataset, observations: tuple[Observation, ...]) -> list[str]:
    """Return a sentence where these scans cannot show an error that is constant in the flange's frame."""
    if data.pairs and not all(p.has_orientation for p in data.pairs):
        return ["The pairs have no orientations of the flange. Whether the orientation varies is not known."]
    turned = [o.X_BR for o in observations]
    if len(turned) > 1 and turn_deg(turned) < _TURN_DEG:
        return [
            f"The orientations hardly vary (by {turn_deg(turned):.1f} degrees). A constant error of the flange centre "
            "would not show in these figures."
        ]
    return []


def _gross(result: CalibrationResult, poses: tuple[PoseError, ...]) -> list[str]:
    """Return a sentence on scans far off all others."""
    n, median = len(poses), float(np.median([p.error_mm for p in poses]))
    gross = [p for p in poses if p.error_mm > _GROSS * max(median, result.held_out_mm.get("p95") or 0.0)]
    if not gross:
        return []
    names = ", ".join(f"{p.id} by {p.error_mm:.1f} mm" for p in gross[:8]) + (" ..." if len(gross) > 8 else "")
    are = "is a gross outlier" if len(gross) == 1 else "are gross outliers"
    return [f"{len(gross)} of the {n} scans {are}: {names}."]


def _differences(result: CalibrationResult, data: Dataset, flange: str) -> list[str]:
    """Names that differ between the calibration and these scans."""
    h = data.header
    pairs = (
        ("robot", result.robot, h.robot),
        ("flange", result.flange, flange),
        ("scanner", result.scanner, h.scanner),
    )
    return [
        f"The calibration was made with the {what} '{was}', these scans with '{now}'. The figures are valid only if"
        " both names mean the same one."
        for what, was, now in pairs
        if was and now and was != now
    ]


def _diagnostics(
    result: CalibrationResult, data: Dataset, observations: tuple[Observation, ...], poses: tuple[PoseError, ...]
) -> list[str]:
    """Warnings about the figures: what makes them too small, and what they indicate about the cell."""
    out = []
    again = [p.id for p in poses if p.used_before]
    n = len(poses)
    if again:
        names = ", ".join(again[:5]) + (f" and {len(again) - 5} more" if len(again) > 5 else "")
        out.append(
            f"{len(again)} of the {n} scans were used in the calibration ({names}), so their errors are too small. Take"
            " new scans."
        )
    if n < _FEW:
        out.append(f"Only {n} scan{' was' if n == 1 else 's were'} used. Take {_FEW} or more across the work space.")
    out += _alike(data, observations)
    stated = result.held_out_mm.get("p95")
    median = float(np.median([p.error_mm for p in poses]))
    if stated is not None and median > (stated if n >= _FEW else _GROSS * stated):
        out.append(
            f"The median error, {median:.2f} mm, is larger than the calibration's own held-out error at 95 %"
            f" ({stated:.2f} mm). Scanner, robot or flange has changed, or these scans are in another region: calibrate"
            " again."
        )
    out += _gross(result, poses)
    tilts = [p.tilt_deg for p in poses if p.tilt_deg is not None]
    if tilts and float(np.median(tilts)) > _WORST_TILT_DEG:
        out.append(
            f"The scanned faces are turned by {np.median(tilts):.0f} degrees from the flange's z axis in the poses."
            " Check the quaternion order (qw, qx, qy, qz), that the poses are the flange's, and the calibration."
        )
    return out


def _uncorrected(result: CalibrationResult, observations: tuple[Observation, ...]) -> tuple[tuple[str, ...], bool]:
    """Return a sentence on an absent scanner correction (none: there is one), and whether these scans show its lack."""
    if result.scanner_correction is not None:
        return (), False
    text = "The result holds no scanner correction, so these errors include the scale error of the scanner"
    scale, sigma = scale_error(result.X_BC, observations)
    if np.isfinite(sigma) and abs(scale) > _EVIDENT * sigma:
        return (f"{text}: these scans show {1e2 * scale:+.2f} % (one sigma {1e2 * sigma:.2f} %).",), True
    return (f"{text}, if there is one.",), False
