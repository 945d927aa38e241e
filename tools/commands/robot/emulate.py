"""weldcal emulate-ur: an emulated UR controller on loopback."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import Call, command, option
from weldcal.tools.emulators.ur.main import HOME, run_emulator

Joints = tuple[float, float, float, float, float, float]


@command("emulate-ur", common=("seed", "debug"), short_help="Run an emulated UR controller on loopback.")
def emulate_ur(
    call: Call,
    polyscope: Annotated[str, option("--polyscope", "VERSION", "Controller version: 5.12, 5.21, 10.7 ...")] = "5.21",
    robot: Annotated[str, option("--arm", "NAME", "The arm: ur3e, ur5e, ur10e, ur16e, ur20, ur30 ...")] = "ur10e",
    kinematics: Annotated[Path | None, option("--kinematics", "FILE", "A robot's factory calibration.")] = None,
    q: Annotated[Joints, option("--q", "RAD...", "Six joint angles at the start.")] = HOME,
    safety_limits: Annotated[
        str, option("--safety-limits", "DEG", "Six joint ranges LOWER:UPPER, commas between; reported and obeyed.")
    ] = "",
    operational_mode: Annotated[str, option("--operational-mode", "MODE", "none, manual or automatic.")] = "none",
    host: Annotated[str, option("--host", "ADDRESS", "Loopback address 127.x.y.z.")] = "127.0.0.1",
    control_port: Annotated[
        int, option("--control-port", "PORT", "Port that takes injected faults, as JSON lines.")
    ] = 30090,
    pace: Annotated[float, option("--pace", "P", "Speed relative to real time, 0.05 to 1.")] = 1.0,
    lockstep: Annotated[float, option("--lockstep", "S", "Seconds for which time waits for a late client.")] = 0.0,
) -> None:
    """Run a UR controller on loopback that executes the URScript it is sent, until it is interrupted."""
    settings = {name: value for name, value in locals().items() if name != "call"}
    run_emulator(**settings, seed=call.seed, ready=typer.echo)
