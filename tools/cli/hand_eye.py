"""weldcal hand-eye and weldcal benchmark hand-eye: the command lines, heavy imports inside."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console

hand_eye = typer.Typer(help="Where is the camera? From pairs of robot and camera poses.", no_args_is_help=True)

FileArgument = Annotated[
    Path, typer.Argument(help="npz, CSV, JSON, or a sample file of easy_handeye2 or MoveIt.", show_default=False)
]
MountingOption = Annotated[
    str | None,
    typer.Option("--mounting", metavar="NAME", help="eye_in_hand, eye_on_base ..., where the file does not say it."),
]
UnitOption = Annotated[
    str | None, typer.Option("--unit", metavar="UNIT", help="Unit of the positions: m, mm or cm.", show_default="m")
]
OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
]
SeedOption = Annotated[
    int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from this number.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")]
MotionsOption = Annotated[
    bool, typer.Option("--motions", help="The file holds motions (A X = X B as they stand), not poses.")
]
CornersOption = Annotated[
    bool | None,
    typer.Option(
        "--corners/--no-corners",
        help="Use the board's corners: reproject, and look for a shifted principal point.",
        show_default="where the file holds them",
    ),
]
RobotOption = Annotated[
    str | None,
    typer.Option("--robot", metavar="NAME", help="The arm, ur10e for example: the next pose is then one it reaches."),
]
ScannerOption = Annotated[
    str | None,
    typer.Option("--camera", metavar="NAME", help="The scanner, phoxi_s for example: the next pose is in its view."),
]
RefineOption = Annotated[
    str | None,
    typer.Option(
        "--refine", metavar="KIND", help="joints or links: look for errors of the robot (--robot, joint angles q)."
    ),
]


@hand_eye.callback()
def _group() -> None:
    """Where is the camera? From pairs of robot and camera poses, in every mounting."""


@hand_eye.command("ax-xb")
def ax_xb(
    file: FileArgument,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    motions: MotionsOption = False,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """AX = XB: the camera's pose alone. Poses are solved with the target's pose beside it, so that each counts once."""
    _run("ax-xb", file, mounting, unit, motions, out, seed, json, debug)


@hand_eye.command("ax-yb")
def ax_yb(
    file: FileArgument,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    corners: CornersOption = None,
    robot: RobotOption = None,
    camera: ScannerOption = None,
    refine: RefineOption = None,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """AX = YB: the poses of camera and target together, with the next pose to add."""
    _run("ax-yb", file, mounting, unit, False, out, seed, json, debug, corners, robot, camera, refine)


@hand_eye.command("axb-ycz")
def axb_ycz(
    file: FileArgument,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    robot: RobotOption = None,
    camera: ScannerOption = None,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """AXB = YCZ: two robots, one with the camera and one with the target; camera, second base and target."""
    _run("axb-ycz", file, mounting, unit, False, out, seed, json, debug, False, robot, camera)


def benchmark(
    data: Annotated[
        Path | None,
        typer.Option("--data", metavar="FOLDER", help="A folder of sets, each a folder with pairs.npz."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Few trials of each kind: seconds instead of minutes.")
    ] = False,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Hand-eye solvers on others' data beside OpenCV's, and on simulations: outliers, invariance, uncertainty, speed."""
    from weldcal.tools.cli.options import fresh_folder

    folder = out or fresh_folder("benchmark", "hand-eye", seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark hand-eye") as progress:
        from weldcal.tools.studies.hand_eye.comparison import run_hand_eye_benchmark, write_table

        report = run_hand_eye_benchmark(data, quick=quick, seed=seed, progress=progress)
        text = write_table(report, folder)
    if json:
        console.emit_json(report.summary())
    else:
        typer.echo(text)


def _run(
    equation: str,
    file: Path,
    mounting: str | None,
    unit: str | None,
    motions: bool,
    out: Path | None,
    seed: int,
    json: bool,
    debug: bool,
    corners: bool | None = False,
    robot: str | None = None,
    camera: str | None = None,
    refine: str | None = None,
) -> None:
    from weldcal.tools.cli.options import fresh_folder

    folder = out or fresh_folder("hand-eye", file.resolve().stem, seed)
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.tools.commands.hand_eye import run_hand_eye

        def say(sentence: str) -> None:
            if not json:
                typer.echo(sentence)

        report = run_hand_eye(
            equation,
            file,
            folder,
            mounting=mounting,
            unit=unit,
            motions=motions,
            corners=corners,
            robot=robot,
            camera=camera,
            refine=refine,
            seed=seed,
            say=say,
        )
    if json:
        console.emit_json(report.summary())
    else:
        typer.echo(report.text())
        typer.echo(f"\nwritten      {folder}")
