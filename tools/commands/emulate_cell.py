"""Plays the world of a cell on loopback and keeps the truth file."""

import json
from collections.abc import Callable
from pathlib import Path

from weldcal.tools.emulators.cell.world import run_world
from weldcal.tools.report.render import write_atomic

WIRED = "wired_"


def emulate(
    scenario: str,
    cell: str | None,
    seed: int,
    *,
    truth: Path | None,
    pace: float | None,
    control_port: int,
    parent: int | None = None,
    ready: Callable[[str], None],
) -> None:
    """Serve until the process is asked to end; see run_world. `truth` holds what the world knows whenever that has changed.

    Raises:
        InputError: a scenario cannot be loaded or played, or an address is taken.
    """
    world = scenario.removeprefix(WIRED)

    def write(found: dict[str, object]) -> None:
        if truth is not None:
            write_atomic(truth, json.dumps({"scenario": world, "seed": seed} | found, indent=1) + "\n")

    known = cell or f"{WIRED}{Path(world).stem}"
    run_world(world, known, seed, write=write, ready=ready, pace=pace, control_port=control_port, parent=parent)
