"""The command line: every command in its group, in the order of the help text."""

import signal
from typing import Annotated

import typer

from weldcal.tools.cli import (
    benchmark,
    benchmark_flange,
    benchmark_wired,
    calibrate,
    cell,
    doctor,
    emulate_cell,
    fleet,
    hand_eye,
    monitor,
    motion,
    part,
    plan_motion,
    plan_poses,
    profiler,
    replay,
    reproduce,
    robots,
    runs,
    scenarios,
    tablet,
    tool,
    verify,
    view,
)

PURPOSE = "Calibrate a 3D scanner to a robot by the robot's own flange, then weld along a seam that is felt by touch."
COMMANDS = (
    *(
        runs.demo,
        calibrate.calibrate,
        verify.verify,
        doctor.doctor,
        fleet.fleet,
        monitor.monitor,
        plan_motion.plan_motion,
        plan_poses.plan_poses,
        runs.weld,
        view.view,
        replay.replay,
    ),
    *(robots.robots, robots.emulate_ur, emulate_cell.emulate_cell, robots.check_robot),
    *(scenarios.new, scenarios.schema, part.part),
    *(cell.check_cell, cell.print_board, cell.finger_calibrate, tool.tool_check),
    *benchmark.COMMANDS,
    *benchmark_flange.COMMANDS,
    *benchmark_wired.COMMANDS,
    *reproduce.COMMANDS,
    *monitor.COMMANDS,
    *motion.COMMANDS,
    *(tablet.serve, tablet.calibrate, runs.tablet_demo),
    *(hand_eye.ax_xb, hand_eye.ax_yb, hand_eye.axb_ycz, runs.hand_eye_live),
    *(profiler.edge, profiler.sphere, profiler.compensate, profiler.seam, profiler.clock, runs.profiler_live),
)
GROUPS = {
    "benchmark": "Measure speed and accuracy.",
    "reproduce": "Repeat the published studies.",
    "finger": "Calibrate the finger camera and the soft tip.",
    "tool": "Check a tool of your own.",
    "tablet": "Calibrate a wrist camera with a tablet as target.",
    "hand-eye": "Calibrate a camera from pairs of poses.",
    "profiler": "Calibrate a laser profiler and map a seam.",
}


def main() -> None:
    """Entry point of the `weldcal` console script and of `python -m weldcal.tools`.

    SIGTERM ends a command as Ctrl-C does: a run is held and leaves its result folder.
    """

    def end(*_: object) -> None:
        raise KeyboardInterrupt("SIGTERM")

    signal.signal(signal.SIGTERM, end)
    app(prog_name="weldcal")


def version(wanted: bool) -> None:
    """Prints the installed version and ends."""
    if wanted:
        from importlib.metadata import version as installed_version

        typer.echo(f"weldcal {installed_version('weldcal')}")
        raise typer.Exit()


def weldcal(
    _version: Annotated[
        bool, typer.Option("--version", callback=version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """The program itself, without a command: only --version."""


def build_app() -> typer.Typer:
    """The Typer application with all groups and commands."""
    root = typer.Typer(
        name="weldcal",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    root.callback(help=PURPOSE)(weldcal)
    groups = {name: typer.Typer(help=text, no_args_is_help=True) for name, text in GROUPS.items()}
    for name, group in groups.items():
        root.add_typer(group, name=name)
    for command in COMMANDS:
        *parents, name = command.title.split(" ")
        (groups[parents[0]] if parents else root).command(name, short_help=command.short_help, hidden=command.hidden)(
            command.function
        )
    return root


app = build_app()
