"""weldcal hand-eye: solves for the unknown poses from a file of pose pairs, compares all methods and writes exports."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from weldcal.calibration.hand_eye.exports import Provenance, digest, export_hand_eye, export_together, optical_frame
from weldcal.calibration.hand_eye.pairs.importing import StatedForms
from weldcal.calibration.hand_eye.pictures.boards import FORMS
from weldcal.calibration.recorded_hand_eye import (
    HandEyeOptions,
    Say,
    calibrate_recorded,
    calibrate_several,
    stated_forms,
)
from weldcal.models.errors import WeldcalError
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option, switch
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.hand_eye import (
    HandEyeReport,
    hand_eye_report,
    together_page,
    together_screen,
    together_summary,
)
from weldcal.tools.report.render import write_atomic

FileArgument = Annotated[
    Path,
    typer.Argument(
        help="A file or folder with the robot's and the camera's poses (docs/datasets.md), or two pose streams.",
        show_default=False,
    ),
]
FilesArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="FILE...",
        help="A file or folder with the robot's and the camera's poses (docs/datasets.md), or two pose streams; one for"
        " each of several sensors.",
        show_default=False,
    ),
]
MountingOption = Annotated[
    str | None, option("--mounting", "NAME", "eye_in_hand, eye_on_base ..., if the file does not name it.")
]
UnitOption = Annotated[
    str | None,
    option(
        "--unit",
        "UNIT",
        "Unit of all positions: m, mm, cm or inch; inch,mm for robot and camera.",
        show_default="by the robot's reach and the motions",
    ),
]
RobotPosesOption = Annotated[
    str | None, option("--robot-poses", "NAME", "The file, folder, array or label that holds the robot's poses.")
]
CameraPosesOption = Annotated[
    str | None, option("--camera-poses", "NAME", "The file, folder, array or label that holds the camera's poses.")
]
FORMS_OF_LISTS = ("robot-form", "camera-form")
"""Keys of --as: how the lists of poses are written."""
RobotOption = Annotated[
    str | None,
    option("--robot", "NAME", "The arm, for example ur10e or my_arm.urdf: the next pose is then within its reach."),
]
JointsOfOption = Annotated[
    str | None, option("--robot", "NAME", "The arm (ur10e, my_arm.urdf), where joint angles stand for its poses.")
]
ScannerOption = Annotated[
    str | None, option("--camera", "NAME", "The scanner, for example phoxi_s: the next pose is then in its view.")
]
BoardOption = Annotated[
    str | None,
    option(
        "--board",
        "BOARD",
        f"Calibrate from pictures of this board, lengths in mm: {', '.join(FORMS.values())}. COLSxROWS of a chessboard"
        " are inner corners.",
    ),
]


def stated_lists(call: Call, robot_poses: str | None, camera_poses: str | None) -> StatedForms:
    """Return what the options and --as state of the two lists of poses."""
    return stated_forms(robot_poses, camera_poses, *(call.reading.get(key) for key in FORMS_OF_LISTS))


@command(
    "hand-eye ax-xb",
    keys=("robot-form", "camera-form", "intrinsics", "motions"),
    short_help="Solve AX = XB for the camera's pose.",
)
def ax_xb(
    call: Call,
    file: FileArgument,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    robot: JointsOfOption = None,
    robot_poses: RobotPosesOption = None,
    camera_poses: CameraPosesOption = None,
    board: BoardOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Solve AX = XB for the camera's pose. With poses, the target's pose is estimated too, so that each counts once."""
    stated = stated_lists(call, robot_poses, camera_poses)
    known = HandEyeOptions(mounting=mounting, unit=unit, robot=robot, stated=stated, board=board)
    return _solve(call, file, replace(known, equation="ax-xb"), limit_mm)


@command(
    "hand-eye ax-yb",
    keys=("robot-form", "camera-form", "intrinsics"),
    short_help="Solve AX = YB for the poses of camera and target.",
)
def ax_yb(
    call: Call,
    files: FilesArgument,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    corners: Annotated[
        bool | None,
        switch(
            "--corners/--no-corners",
            "Use the board's corners: minimise the reprojection error, and test for a shifted principal point.",
            show_default="if the file holds them",
        ),
    ] = None,
    robot: RobotOption = None,
    camera: ScannerOption = None,
    refine: Annotated[
        str | None,
        option("--refine", "KIND", "joints or links: estimate errors of the robot (needs --robot and joint angles q)."),
    ] = None,
    kinematics: Annotated[
        Path | None,
        option("--kinematics", "FILE", "With --robot: the arm's own kinematics, such as calibrate --refine writes."),
    ] = None,
    robot_poses: RobotPosesOption = None,
    camera_poses: CameraPosesOption = None,
    board: BoardOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Solve AX = YB for the poses of camera and target, and propose the next pose to add. Several files are of several
    sensors that measured one target on one robot: they are solved together, with the poses between them."""
    stated = stated_lists(call, robot_poses, camera_poses)
    known = HandEyeOptions(mounting=mounting, unit=unit, robot=robot, stated=stated, board=board)
    asked = replace(known, camera=camera, corners=corners, refine=refine, kinematics=kinematics)
    if len(files) > 1:
        return _solve_several(call, files, asked, limit_mm)
    return _solve(call, files[0], asked, limit_mm)


@command("hand-eye axb-ycz", short_help="Solve AXB = YCZ for two robots.")
def axb_ycz(
    call: Call,
    file: FileArgument,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    robot: RobotOption = None,
    camera: ScannerOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Solve AXB = YCZ for camera, second base and target: one robot carries the camera, another the target."""
    asked = HandEyeOptions(equation="axb-ycz", mounting=mounting, unit=unit, robot=robot, camera=camera)
    return _solve(call, file, asked, limit_mm)


def _solve_several(call: Call, files: list[Path], asked: HandEyeOptions, limit_mm: float | None) -> Outcome:
    """Solve several sensors together; each has a folder with its own result."""
    said: list[str] = []
    check_limit(limit_mm)
    asked = replace(asked, seed=call.seed, **{k: call.reading[k] for k in ("intrinsics",) if k in call.reading})
    folder = call.folder("hand-eye", "together")
    found = calibrate_several(files, asked, said.append)
    hashes = [digest(file) for file in files]
    for file, name, one, sha in zip(files, found.together.names, found.each, hashes, strict=True):
        provenance = Provenance(file.name, sha, tuple(other for other in hashes if other != sha))
        sensor = replace(one.mounting.unknowns["X"], child=optical_frame(name))
        mounting = replace(one.mounting, unknowns=one.mounting.unknowns | {"X": sensor})
        wrote = export_hand_eye(one.result, mounting, folder / name, provenance)
        report = HandEyeReport(**vars(one), files=wrote, seconds=0.0, limit_mm=limit_mm, folder=folder / name)
        write_atomic(folder / name / "report.html", hand_eye_report(report, file.name, provenance.sha256))
    export_together(found.together, folder)
    first = together_screen(found, limit_mm)
    write_atomic(folder / "report.html", together_page(found, first))
    return Outcome({"state": "done", **together_summary(found)}, text="\n".join(said), first=first)


def _solve(call: Call, file: Path, asked: HandEyeOptions, limit_mm: float | None) -> Outcome:
    """Solve, and say how the file was read, also where it is refused."""
    said: list[str] = []
    asked = replace(asked, **{key: call.reading[key] for key in ("intrinsics", "motions") if key in call.reading})
    folder = call.folder("hand-eye", file.resolve().stem)
    try:
        report = run_hand_eye(file, folder, replace(asked, seed=call.seed), limit_mm=limit_mm, say=said.append)
    except WeldcalError:
        for sentence in said if not call.json else ():  # how the file was read is part of what a refusal says
            typer.echo(sentence)
        raise
    return Outcome(report.summary(), text="\n".join([*said, report.text()]), first=report.first)


def run_hand_eye(
    file: Path, out: Path, asked: HandEyeOptions, limit_mm: float | None = None, say: Say = lambda _: None
) -> HandEyeReport:
    """Calibrate from a file, see ``calibrate_recorded``, and write the exports and report.html.

    ``limit_mm`` is the held-out error at the target, 95 %, that the job allows.
    """
    begin = time.perf_counter()
    check_limit(limit_mm)
    found = calibrate_recorded(file, asked, say)
    provenance = Provenance(file.name, digest(file))
    files = export_hand_eye(found.result, found.mounting, out, provenance)
    seconds = time.perf_counter() - begin
    report = HandEyeReport(**vars(found), files=files, seconds=seconds, limit_mm=limit_mm, folder=out)
    write_atomic(out / "report.html", hand_eye_report(report, file.name, provenance.sha256))
    return report
