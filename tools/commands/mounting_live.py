"""Runs `weldcal hand-eye live`, a calibration in any mounting, and `weldcal calibrate` on its recorded scans."""

import contextlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from pydrake.math import RigidTransform

from weldcal.calibration.data.checks import unit_quaternion
from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.dataset import Dataset, load_dataset
from weldcal.calibration.data.header import DatasetHeader, ScannerGuess, SecondRobot
from weldcal.calibration.data.writing import JOINTS, SECOND_JOINTS, save_dataset
from weldcal.calibration.errors import FlangeNotFound, TooFewPoses
from weldcal.calibration.hand_eye.exports import Provenance, export_hand_eye
from weldcal.calibration.planning.mounting_estimate import (
    Circle,
    ObservedCircle,
    expected_error,
    fewest,
    off_prediction,
    see_circle,
    solve_mounting,
)
from weldcal.calibration.planning.mounting_scene import BASE, FLANGE, FOOT, MountingScene
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import LINKS, known_arms, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.models.robots import base_circle
from weldcal.models.scanners import get_scanner
from weldcal.systems.jobs.mounting.procedure import MountingStatus
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario, scenario_text
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import LIVE, Call, Outcome, RecordOption, command
from weldcal.tools.commands.run import JobRun, run_job, run_options
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.mounting import MountingReport, RecordedMounting, mounting_report, station_picture
from weldcal.tools.report.render import csv_text, write_atomic
from weldcal.tools.report.run import RunOptions

_HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])  # joints that a dataset does not state are taken near these
_WIDER_M = 0.25  # radius of the search about a guess that may be wrong
_TRIED_AGAIN = 3  # scans
_SAME = 1e-4  # m, and as a matrix: what a controller rounds


@command(
    "hand-eye live", short_help="Calibrate a scanner live in any mounting.", options=LIVE, defaults={"browser": False}
)
def hand_eye_live(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="A scenario with a mounting section, by name or path.")
    ] = "eye_in_hand",
    record: RecordOption = False,
) -> Outcome:
    """Calibrate a scanner live in any mounting: it scans the robot's flange, its foot, or a second arm's flange."""
    options = run_options(call, "hand-eye", scenario, recording=record)
    result = run_mounting_live(load_scenario(scenario), options, call.progress)
    return Outcome(result.summary(), text=result.text(), first=result.first)


def calibrate_recorded(
    call: Call, dataset: Path, robot: str | None, flange: str | None, *, poses: str | None, limit_mm: float | None
) -> Outcome:
    """Calibrate a scanner that an arm carries from scans at rest, as `weldcal calibrate` does for such a folder."""
    folder = call.folder("calibrate", dataset.resolve().name)
    report = calibrate_carried(
        dataset, folder, robot=robot, flange=flange, poses=poses, limit_mm=limit_mm, progress=call.progress
    )
    return Outcome(report.summary(), text=report.text(), first=report.first)


def run_mounting_live(scenario: Scenario, options: RunOptions, progress: Progress) -> MountingReport:
    """Build and run the cell and write the results.

    Raises:
        InputError, UnreachableScanner, RobotRefused: see run_job; nothing has been written or moved.
    """
    start = time.monotonic()
    finished = run_job(scenario, options, progress, "mounting")
    run, job = finished.run, finished.cell.job
    progress("write", 0.9)
    status, result = job.status(run.root), None
    if status.result is not None:
        result = solve_mounting(job.scene, status.seen, folds=5)
    report = MountingReport(run, result, options.out, time.monotonic() - start, finished.robot)
    write_mounting(report, finished)
    return report


def write_mounting(report: MountingReport, finished: JobRun | None = None) -> None:
    """Write hand_eye.yaml with its exports, sightings.csv, summary.txt and report.html.

    Of a live run also scenario.yaml, scans/ (a dataset for `weldcal calibrate`), station.png and recording.html.
    """
    folder, picture = report.folder, None
    source, text = "dataset.yaml", ""
    if report.run is not None:
        source, text = "scenario.yaml", scenario_text(report.run.cell.scenario)
        write_atomic(folder / source, text)
        write_scans(report)
        picture = station_picture(report)
    elif isinstance(report, RecordedMounting):
        text = report.digest
    if report.result is not None:
        export_hand_eye(report.result, report.mounting, folder, Provenance(source, sha256(text.encode()).hexdigest()))
    write_atomic(folder / "sightings.csv", _observations(report))
    poses = [f"{name}: {text}" for pose in report.first.poses for name, text in pose.rows().items()]
    write_atomic(folder / "summary.txt", "\n".join([report.text(), "", *poses, ""]))
    if picture is not None:
        write_atomic(folder / "station.png", picture)
    if finished is not None:
        finished.write_recording(folder)
    write_atomic(folder / "report.html", mounting_report(report, picture))


def write_scans(report: MountingReport) -> None:
    """Write the scans of a live run's calibration as a dataset, scans/ in its folder, for `weldcal calibrate`."""
    assert report.run is not None
    scene, scenario, kept = report.scene, report.run.cell.scenario, report.run.scans
    scanner, seen = scenario.scanner_config(), [s for s in report.status.seen if s.label in kept]
    if not seen or scanner is None:
        return
    preset, guess, second = scanner.scanner(), scene.X_LC, scene.X_BD
    header = DatasetHeader(
        robot=scenario.arm,
        flange=scenario.flange_name(),
        scanner=preset.name,
        configuration=scene.configuration,
        note="scans of a run",
        scanner_link="" if scene.link in (BASE, FLANGE) else LINKS[scene.link - 1],
        scanner_guess=ScannerGuess(*_pose(guess), 1e-3 * scenario.calibration.guess_radius_mm),
        second_robot=None if second is None or scene.arm_2 is None else SecondRobot(scene.arm_2.name, *_pose(second)),
        arm_error_mm=1e3 * scene.arm_error_m,
    )
    save_dataset(
        report.folder / "scans",
        header,
        {s.label: s.observation.X_BF for s in seen},
        {s.label: kept[s.label][0].points_C.astype(float) for s in seen},
        joints={s.label: np.concatenate([s.pose.q, *([] if s.pose.q_2 is None else [s.pose.q_2])]) for s in seen},
        intrinsics=(preset.fx, preset.fy, preset.cx, preset.cy),
    )


def calibrate_carried(
    folder: Path,
    out: Path,
    *,
    robot: str | None = None,
    flange: str | None = None,
    poses: str | None = None,
    limit_mm: float | None = None,
    progress: Progress = no_progress,
) -> RecordedMounting:
    """Calibrate a scanner that an arm carries from scans at rest, as the live job does; write the result to ``out``.

    ``robot``, ``flange`` override dataset.yaml; ``poses``, ``limit_mm``: see calibrate_dataset.

    Raises:
        InputError: the data cannot be used; TooFewPoses: too few scans can be used.
    """
    started = time.monotonic()
    check_limit(limit_mm)
    data = load_dataset(Path(folder), robot=robot or "", carried=True)
    data = data if poses is None else data.between(poses)
    scene, circle = recorded_scene(data, robot or data.header.robot, flange or data.header.flange)
    joints = recorded_joints(data, scene)
    seen: list[ObservedCircle] = []
    refused = dict(data.refused)
    result, left = None, list(data.clouds)
    for again in (False, True):  # what is not found about the guess may be found about the result
        for k, id in enumerate(left):
            progress("finding circles", 0.8 * k / len(left))
            belief = scene if result is None else scene.believing(result.poses)
            try:
                seen.append(see_circle(data.cloud(id), belief, id, *joints[id], circle))
            except (FlangeNotFound, CloudError) as problem:
                refused[id] = str(problem)
                continue
            refused.pop(id, None)
            if len(seen) >= fewest(scene):
                result = solve_mounting(scene, seen)
        left = [id for id in left if id in refused]
        if again or not left or result is None:
            break
    if result is None:
        raise TooFewPoses(_too_few(data, scene, joints, circle, len(seen), refused))
    progress("cross-validating", 0.8)
    report = recorded_report(
        scene,
        seen,
        tuple(refused.items()),
        limit_mm=limit_mm,
        started=started,
        folder=out,
        source=Path(folder).name,
        digest=json.dumps(data.hashes, sort_keys=True),
    )
    write_mounting(report)
    return report


def _too_few(
    data: Dataset,
    scene: MountingScene,
    joints: Mapping[str, tuple[Array, Array | None]],
    circle: Circle,
    seen: int,
    refused: Mapping[str, str],
) -> str:
    """Return the sentence where too few scans show the circle; a wider search says how far off the guess is."""
    begin = f"{seen} scan{'' if seen == 1 else 's'} show the circle, and {fewest(scene)} are needed."
    for id in list(refused)[:_TRIED_AGAIN]:
        with contextlib.suppress(FlangeNotFound, CloudError):
            found = see_circle(data.cloud(id), scene, id, *joints[id], replace(circle, guess_radius_m=_WIDER_M))
            off, turn = off_prediction(scene, found, None)
            return (
                f"{begin} In '{id}' a circle lies {1e3 * off:.0f} mm and {np.degrees(turn):.0f} degrees from where"
                f" dataset.yaml expects it. Correct scanner_guess or configuration, or write radius_m: {_WIDER_M} in"
                " scanner_guess."
            )
    why = "; ".join(f"{id}: {text}" for id, text in list(refused.items())[:3])
    return (
        f"{begin} {f'Refused: {why}' if why else ''} Record more scans that show the whole circle, or check"
        " configuration and scanner_guess in dataset.yaml."
    )


def recorded_report(
    scene: MountingScene,
    seen: Sequence[ObservedCircle],
    refused: tuple[tuple[str, str], ...] = (),
    *,
    limit_mm: float | None = None,
    started: float | None = None,
    **more: Any,
) -> RecordedMounting:
    """Write the report of the circles at known joint angles, with held-out errors of five folds."""
    result = solve_mounting(scene, seen, folds=5)
    sigma, within = expected_error(scene, result)
    status = MountingStatus(
        sequence=len(seen) + len(refused),
        seen=tuple(seen),
        refused=refused,
        result=result,
        sigma_work_m=sigma,
        error_95_m=within,
    )
    seconds = 0.0 if started is None else time.monotonic() - started
    return RecordedMounting(
        run=None,
        result=result,
        seconds=seconds,
        robot="recorded",
        recorded=status,
        place=scene,
        limit_mm=limit_mm,
        **more,
    )


def recorded_scene(data: Dataset, robot: str, flange: str) -> tuple[MountingScene, Circle]:
    """Return the scene and the circle that a dataset describes. Raises InputError for what dataset.yaml lacks."""
    header, guess = data.header, data.X_BC_guess
    if robot not in known_arms():
        raise InputError(
            f"The arm '{robot}' is not known. Name one of {', '.join(known_arms())} as robot in dataset.yaml, or with"
            " --robot."
        )
    if guess is None or header.scanner_guess is None:
        raise InputError(
            "dataset.yaml has no scanner_guess: measure the scanner's pose on what carries it, to 15 mm and 2 degrees,"
            " and add it."
        )
    on_arm = header.configuration.startswith("eye_on_arm")
    if on_arm and header.scanner_link not in LINKS[:-1]:
        raise InputError(
            f"dataset.yaml must name the link that carries the scanner: scanner_link, one of {', '.join(LINKS[:-1])}."
        )
    if header.scanner_link and not on_arm:
        raise InputError(
            f"dataset.yaml has scanner_link: {header.scanner_link}, but with the configuration {header.configuration}"
            " the flange carries the scanner. Remove scanner_link, or write a configuration that begins with"
            " eye_on_arm."
        )
    second = header.second_robot
    if (second is not None) != (header.configuration == "co_manipulation"):
        raise InputError("co_manipulation, and it alone, has second_robot in dataset.yaml: its robot, xyz and wxyz.")
    foot = base_circle(robot) if header.configuration in FOOT else None
    standard = get_flange(flange) if foot is None else foot.standard
    first = data.joints()
    scene = MountingScene(
        configuration=header.configuration,
        arm=load_arm(robot),
        link=1 + LINKS.index(header.scanner_link) if on_arm else FLANGE,
        X_LC=guess,
        X_HR=data.X_FR if foot is None else foot.X_BR,
        radius_m=0.5 * standard.outer_m,
        scanner=get_scanner(header.scanner or "phoxi_m"),
        q_home=np.median(list(first.values()), axis=0) if first else _HOME,
        arm_2=None if second is None else load_arm(second.robot),
        X_BD=None if second is None else RigidTransform(unit_quaternion(second.wxyz, "second_robot"), second.xyz),
        q_home_2=None if second is None else _HOME,
        arm_error_m=1e-3 * header.arm_error_mm,
    )
    return scene, Circle(standard, header.scanner_guess.radius_m, foot is not None)


def recorded_joints(data: Dataset, scene: MountingScene) -> dict[str, tuple[Array, Array | None]]:
    """Joint angles of both arms by id: they lead the arm as drawn to the stated poses.

    Raises InputError where that is not possible.
    """
    given, second, found = data.joints(), data.joints(SECOND_JOINTS) if scene.two else {}, {}
    on_arm = scene.link not in (BASE, FLANGE)
    if (on_arm and not given) or (scene.two and not second):
        names = SECOND_JOINTS if scene.two else JOINTS
        raise InputError(
            f"poses.csv needs the joint angles {names[0]} to {names[-1]} (rad): the pose of the flange alone does not"
            " say where the scanner is."
        )
    near = scene.q_home
    for id, X_BF in data.poses.items():
        q = given.get(id)
        reached = None if q is None else scene.frames(q)[FLANGE]
        if q is None or reached is None or not reached.IsNearlyEqualTo(X_BF, _SAME):
            if on_arm:
                raise InputError(
                    f"The joint angles of '{id}' do not lead the {scene.arm.name} to its stated pose. Check the robot's"
                    " name, radians, and that the TCP is zero."
                )
            q = nearest_solution(scene.arm, X_BF, near if q is None else q)
        if q is None:
            raise InputError(
                f"The {scene.arm.name} does not reach the stated pose of '{id}'. Check the robot's name, the unit, and"
                " that the TCP is zero."
            )
        near = q
        found[id] = (q, second.get(id))
    return found


def _pose(X: RigidTransform) -> tuple[list[float], list[float]]:
    return [float(v) for v in X.translation()], [float(v) for v in X.rotation().ToQuaternion().wxyz()]


def _observations(report: MountingReport) -> str:
    """List the rows of sightings.csv: joints (deg), centre (mm), normal in the camera frame, visible edge share."""
    two = report.scene.two
    joints = [f"q{i}_deg" for i in range(1, 7)] + ([f"second_q{i}_deg" for i in range(1, 7)] if two else [])
    columns = ["id", *joints, *(f"centre_{a}_mm" for a in "xyz"), *(f"normal_{a}" for a in "xyz"), "coverage"]
    rows = []
    for s in report.status.seen:
        q = np.degrees(s.pose.q if s.pose.q_2 is None else np.concatenate([s.pose.q, s.pose.q_2]))
        normal = np.zeros(3) if s.observation.n_CM is None else s.observation.n_CM
        values = [*q, *(1e3 * s.observation.p_CM), *normal, s.coverage]
        rows.append([s.label, *(json.dumps(round(float(v), 6)) for v in values)])
    return csv_text(columns, rows)
