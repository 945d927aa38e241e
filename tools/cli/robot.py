"""weldcal emulate-ur, check-robot, benchmark robot and robot-faults: a controller on loopback, and what a robot is fit for."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console
from weldcal.tools.cli.options import (
    AddressOption,
    DebugOption,
    JsonOption,
    OutOption,
    SeedOption,
    finish,
    fresh_folder,
)


def mount(app: typer.Typer, benchmarks: typer.Typer) -> None:
    """Adds the four commands."""
    app.command("emulate-ur", short_help="A UR controller on loopback.")(emulate_ur)
    app.command("check-robot", short_help="Is this robot ready? Looks, moves nothing.")(check_robot)
    benchmarks.command("robot-faults")(benchmark_robot_faults)
    benchmarks.command("robot")(benchmark_robot)


def benchmark_robot_faults(
    sequences: Annotated[int, typer.Option("--sequences", metavar="N", min=0, help="Random fault sequences.")] = 20,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", min=1.0, help="Length of each.")] = 60.0,
    address: AddressOption = "127.0.0.1",
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Every fault of the robot link at 0.05 m/s on an emulated controller: does the arm stop, stay, and say why."""
    folder = out or fresh_folder("benchmark", "robot-faults", seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark robot-faults") as progress:
        from weldcal.tools.studies.robot.faults import run_fault_benchmark

        report = run_fault_benchmark(
            folder, address=address, sequences=sequences, seconds=seconds, seed=seed, progress=progress
        )
    rows = {outcome.name: outcome.line for outcome in report.outcomes}
    finish("benchmark robot-faults", report.summary(), folder, json_wanted=json, rows=rows)


def benchmark_robot(
    minutes: Annotated[float, typer.Option("--minutes", metavar="M", min=0.05, help="Length of the stream.")] = 10.0,
    address: AddressOption = "127.0.0.1",
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """A 125 Hz command stream to an emulated controller: periods, latencies, and every deadline missed by 20 ms."""
    folder = out or fresh_folder("benchmark", "robot", seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark robot") as progress:
        from weldcal.tools.studies.robot.stream import run_robot_benchmark

        report = run_robot_benchmark(folder, address=address, minutes=minutes, seed=seed, progress=progress)
    finish("benchmark robot", report.summary(), folder, json_wanted=json)


def emulate_ur(
    polyscope: Annotated[
        str, typer.Option("--polyscope", metavar="VERSION", help="Controller version: 5.12, 5.21, 10.7 ...")
    ] = "5.21",
    kinematics: Annotated[
        Path | None, typer.Option("--kinematics", metavar="FILE", help="A robot's factory calibration.")
    ] = None,
    host: Annotated[str, typer.Option("--host", metavar="ADDRESS", help="Loopback address 127.x.y.z.")] = "127.0.0.1",
    control_port: Annotated[
        int, typer.Option("--control-port", metavar="PORT", help="Where faults are injected, as JSON lines.")
    ] = 30090,
    pace: Annotated[
        float, typer.Option("--pace", metavar="P", help="Controller seconds per host second, 0.05 to 1.")
    ] = 1.0,
    seed: SeedOption = 0,
    debug: DebugOption = False,
) -> None:
    """A UR controller on loopback that executes the URScript it is sent; runs until it is interrupted."""
    with console.boundary(json_wanted=False, debug=debug):
        from weldcal.tools.emulators.ur.main import run_emulator

        run_emulator(
            host=host,
            control_port=control_port,
            polyscope=polyscope,
            kinematics=kinematics,
            pace=pace,
            seed=seed,
            ready=typer.echo,
        )


def check_robot(
    host: Annotated[str, typer.Argument(metavar="HOST", help="Name or address of the robot's controller.")],
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Is this robot ready? A table of what is right and what to change; nothing moves and nothing is written."""
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.systems.drivers.ur.readiness.preflight import preflight
        from weldcal.tools.commands.check_robot import as_json, emit_table

        report = preflight(host)
        if json:
            console.emit_json(as_json(report))
        else:
            emit_table(report)
    if report.first_problem is not None:
        console.emit_warning(report.first_problem.remedy)
        raise typer.Exit(1)
