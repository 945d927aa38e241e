"""What commands share: their options, the folder that each run gets, and how its outcome is told."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console

OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
]
SeedOption = Annotated[
    int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from this number.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")]
BrowserOption = Annotated[
    bool,
    typer.Option(
        "--browser/--no-browser", help="Open the live 3D view in the web browser, or not.", show_default="open it"
    ),
]
RobotOption = Annotated[
    str | None,
    typer.Option(
        "--robot",
        metavar="ROBOT",
        help="simulated, emulated (a controller on loopback), or the address of a controller.",
        show_default="the scenario's",
    ),
]
DryRunOption = Annotated[
    bool,
    typer.Option(
        "--dry-run", help="Only look at the robot, then run on a simulated arm like it: nothing is sent to it."
    ),
]
PaceOption = Annotated[
    float | None,
    typer.Option(
        "--pace", metavar="P", help="Emulated controller only: its seconds per second of the clock, 0.05 to 1."
    ),
]
SpeedFactorOption = Annotated[
    float | None,
    typer.Option(
        "--speed-factor", metavar="X", help="Make the arm's moves slower: 0.05 to 1. The weld keeps its speed."
    ),
]
AddressOption = Annotated[
    str, typer.Option("--address", metavar="ADDRESS", help="Loopback address 127.x.y.z of the emulated controller.")
]
CorrectionOption = Annotated[
    bool,
    typer.Option(
        "--scanner-correction/--no-scanner-correction",
        help="Of a dataset: look for the scanner's own scale error, or take its scans as they are.",
    ),
]
RealtimeOption = Annotated[bool, typer.Option("--realtime", help="Never run faster than the real robot would.")]
ScenarioOption = Annotated[
    str, typer.Option("--scenario", metavar="NAME", help="A scenario's name, or the path of a scenario YAML file.")
]


def fresh_folder(command: str, name: str, seed: int) -> Path:
    """The first unused weldcal-out/<command>-<name>-seed<N>[-2, -3 ...]: an earlier result is never written over."""
    first = Path("weldcal-out") / f"{command}-{Path(name).stem}-seed{seed}"
    folder, number = first, 1
    while folder.exists():
        number += 1
        folder = first.with_name(f"{first.name}-{number}")
    return folder


def finish(
    command: str,
    summary: Mapping[str, object],
    folder: Path,
    *,
    json_wanted: bool,
    rows: Mapping[str, str] | None = None,
) -> None:
    """Reports the outcome (with --json as JSON, else in rows) and ends with exit code 1 unless its `state` is done."""
    state = str(summary.get("state", "done"))
    if json_wanted:
        console.emit_json(summary)
    else:
        console.emit_summary(
            f"{command}: {state}", {**console.rows(summary), **(rows or {}), "written to": str(folder)}
        )
    if state != "done":
        console.emit_warning(str(summary.get("reason") or f"The {command} ended {state}; the report says why."))
        raise typer.Exit(1)
