"""weldcal emulate-cell: the physical world of a cell as a process, behind the wires of its devices."""

import json
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import typer

from weldcal.systems.addresses import loopback_address
from weldcal.systems.drivers.power.modbus import ModbusPowerSource
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.options import Call, command, option
from weldcal.tools.emulators.cell.world import run_world
from weldcal.tools.emulators.power_source import PowerSourceEmulator
from weldcal.tools.report.render import write_atomic

WIRED = "wired_"


@command("emulate-cell", common=("seed", "debug"), short_help="Play a cell's hardware on loopback.")
def emulate_cell(
    call: Call,
    scenario: Annotated[
        str, option("--scenario", "NAME", "The world: a scenario with simulated devices, by name or path.")
    ] = "s_groove",
    cell: Annotated[
        str | None, option("--cell", "NAME", "Scenario with the devices' addresses; without it wired_NAME.")
    ] = None,
    truth: Annotated[Path | None, option("--truth", "FILE", "Write here what is true and how the weld was.")] = None,
    pace: Annotated[float | None, option("--pace", "P", "Fastest speed relative to real time, 0.05 to 1.")] = None,
    control_port: Annotated[
        int, option("--control-port", "PORT", "Port that takes injected faults, as JSON lines.")
    ] = 30090,
    parent: Annotated[int | None, option("--parent", "PID", "End when this process ends.")] = None,
) -> None:
    """Play robot, scanner, finger camera, torch, power source and workpiece on loopback, until it is interrupted."""
    world = scenario.removeprefix(WIRED)

    def write(found: dict[str, object]) -> None:
        """Keep the truth file: what the world knows, whenever that has changed."""
        if truth is not None:
            write_atomic(truth, json.dumps({"scenario": world, "seed": call.seed} | found, indent=1) + "\n")

    known = cell or f"{WIRED}{Path(world).stem}"
    source = load_scenario(known).power_source
    with ExitStack() as stack:
        if isinstance(source, ModbusPowerSource):
            where = (source.checked(), loopback_address(source.host), source.port)
            # a process of its own, which answers while the world draws
            player = get_context("spawn").Process(target=PowerSourceEmulator.serve, args=where, daemon=True)
            player.start()
            stack.callback(player.terminate)
        run_world(
            world,
            known,
            call.seed,
            write=write,
            ready=lambda s: typer.echo(f"ready: {s}"),
            pace=pace,
            control_port=control_port,
            parent=parent,
        )
