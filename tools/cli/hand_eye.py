"""weldcal hand-eye: cameras calibrated from files of robot and camera poses."""

from pathlib import Path
from typing import Annotated, Any

import typer

from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option, switch

FileArgument = Annotated[
    Path,
    typer.Argument(
        help="npz (pairs, or streams hand and eye), CSV, JSON, or a sample file of easy_handeye2 or MoveIt.",
        show_default=False,
    ),
]
MountingOption = Annotated[
    str | None, option("--mounting", "NAME", "eye_in_hand, eye_on_base ..., if the file does not name it.")
]
UnitOption = Annotated[str | None, option("--unit", "UNIT", "Unit of the positions: m, mm or cm.", show_default="m")]
RobotOption = Annotated[
    str | None,
    option("--robot", "NAME", "The arm, for example ur10e or my_arm.urdf: the next pose is then within its reach."),
]
ScannerOption = Annotated[
    str | None, option("--camera", "NAME", "The scanner, for example phoxi_s: the next pose is then in its view.")
]


@command("hand-eye ax-xb", short_help="Solve AX = XB for the camera's pose.")
def ax_xb(
    call: Call,
    file: FileArgument,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    motions: Annotated[bool, switch("--motions", "The file holds motions (A and B of A X = X B), not poses.")] = False,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Solve AX = XB for the camera's pose. With poses, the target's pose is estimated too, so that each counts once."""
    return _solve("ax-xb", call, file, mounting=mounting, unit=unit, motions=motions, limit_mm=limit_mm)


@command("hand-eye ax-yb", short_help="Solve AX = YB for the poses of camera and target.")
def ax_yb(
    call: Call,
    file: FileArgument,
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
    limit_mm: LimitOption = None,
) -> Outcome:
    """Solve AX = YB for the poses of camera and target together, and propose the next pose to add."""
    return _solve(
        "ax-yb",
        call,
        file,
        mounting=mounting,
        unit=unit,
        corners=corners,
        robot=robot,
        camera=camera,
        refine=refine,
        kinematics=kinematics,
        limit_mm=limit_mm,
    )


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
    return _solve("axb-ycz", call, file, mounting=mounting, unit=unit, robot=robot, camera=camera, limit_mm=limit_mm)


def _solve(equation: str, call: Call, file: Path, **options: Any) -> Outcome:
    from weldcal.tools.commands.hand_eye import run_hand_eye

    def say(sentence: str) -> None:
        if not call.json:
            typer.echo(sentence)

    folder = call.folder("hand-eye", file.resolve().stem)
    report = run_hand_eye(equation, file, folder, seed=call.seed, say=say, **options)
    return Outcome(report.summary(), text=report.text(), first=report.first)
