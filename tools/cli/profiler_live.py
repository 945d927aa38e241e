"""weldcal profiler live: edge, sphere with touches and seam in the simulated cell, held against its truth; one seed or many."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console


def live(
    name: Annotated[
        str | None, typer.Argument(metavar="SCENARIO", help="The same as --scenario.", show_default=False)
    ] = None,
    scenario: Annotated[
        str, typer.Option("--scenario", metavar="NAME", help="profiler_edge, profiler_sphere, profiler_seam or a YAML.")
    ] = "profiler_seam",
    runs: Annotated[int, typer.Option("--runs", metavar="N", min=1, help="So many seeds, from --seed on.")] = 1,
    record: Annotated[bool, typer.Option("--record", help="Also write recording.html, the run in 3D.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from this number.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """A profiler on the simulated arm: calibrated live by an edge and a touched sphere, then a seam scanned and followed."""
    from weldcal.tools.cli.options import finish, fresh_folder

    scenario = name or scenario
    folder = out or fresh_folder("profiler-live", scenario, seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("profiler live") as progress:
        from weldcal.systems.scenario.loading import load_scenario
        from weldcal.tools.commands.profiler.live import run_profiler_live, run_profiler_seeds
        from weldcal.tools.outcomes.options import RunOptions

        options = RunOptions(scenario=scenario, out=folder, seed=seed, recording=record)
        loaded = load_scenario(scenario)
        one = runs == 1
        summary = (
            run_profiler_live(loaded, options, progress).summary()
            if one
            else run_profiler_seeds(loaded, options, runs, progress)
        )
    finish("profiler live", summary, folder, json_wanted=json)
