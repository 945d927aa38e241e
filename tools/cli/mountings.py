"""weldcal hand-eye live and weldcal benchmark mountings: the command lines, heavy imports inside."""

from __future__ import annotations

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


def live(
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="A scenario with a mounting part, by name or path.")
    ] = "eye_in_hand",
    out: OutOption = None,
    seed: SeedOption = 0,
    record: Annotated[bool, typer.Option("--record", help="Also write recording.html, the run in 3D.")] = False,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Where is the scanner? Live, in any mounting: the robot looks at its own flange, foot, or a second arm's flange."""
    from weldcal.tools.cli.options import fresh_folder

    folder = out or fresh_folder("hand-eye", Path(scenario).stem, seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("hand-eye live") as progress:
        from weldcal.models.errors import InputError
        from weldcal.systems.jobs.discovery import job_of
        from weldcal.systems.scenario.loading import load_scenario
        from weldcal.tools.commands.mounting_live import run_mounting_live
        from weldcal.tools.outcomes.options import RunOptions

        loaded = load_scenario(scenario)
        if job_of(loaded).key != "mounting":
            raise InputError(f"Scenario '{scenario}' has no mounting part: run it with weldcal calibrate --scenario.")
        options = RunOptions(scenario=scenario, out=folder, seed=seed, recording=record)
        report = run_mounting_live(loaded, options, progress)
    if json:
        console.emit_json(report.summary())
    else:
        typer.echo(report.text())
        typer.echo(f"\nwritten      {folder}")
    if report.state != "done":
        console.emit_warning(report.reason)
        raise typer.Exit(1)


def benchmark_mountings(
    runs: Annotated[int, typer.Option("--runs", metavar="N", min=1, help="How many seeds of each.")] = 5,
    names: Annotated[
        list[str] | None, typer.Option("--scenario", metavar="NAME", help="Only these; may be given again.")
    ] = None,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Every mounting live over several seeds: errors against the truth, at poses kept aside, and in units of the covariance."""
    from weldcal.tools.cli.options import finish, fresh_folder

    folder = out or fresh_folder("benchmark", "mountings", seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark mountings") as progress:
        from weldcal.tools.studies.hand_eye.mountings import run_mountings

        summary, table = run_mountings(folder, range(seed, seed + runs), tuple(names or ()), progress)
    if not json:
        typer.echo(table)
    finish("benchmark mountings", summary, folder, json_wanted=json)
