"""weldcal reproduce profiler-seeds: every target of the profiler over many seeds, beside its bound."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console


def profiler_seeds(
    seeds: Annotated[int, typer.Option("--seeds", metavar="N", min=2, help="How many seeds.")] = 12,
    data: Annotated[
        Path | None, typer.Option("--data", metavar="FOLDER", help="The fixed files, to be shown among the seeds.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="The first seed; everything random follows from it.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """How each target of 'reproduce profiler' spreads over seeds, beside the Cramer-Rao bound; twenty seconds a seed."""
    from weldcal.tools.cli.options import fresh_folder

    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("reproduce profiler-seeds") as progress:
        from weldcal.tools.studies.profiler.seeds import run_profiler_seeds

        folder = out or fresh_folder("reproduce", "profiler-seeds", seed)
        study = run_profiler_seeds(folder, seed, seeds, data, progress)
    if json:
        console.emit_json(study.summary())
        return
    rows = {}
    for line in study.lines:
        fixed = "" if line.fixed is None else f"; fixed files {line.fixed.value:.3f}"
        rows[line.what] = (
            f"{float(line.values.min()):.3f} to {float(line.values.max()):.3f} {line.unit}, {line.over_bound:.2f} of the bound, "
            f"target {line.target:g} met in {line.met} of {len(line.seeds)}{fixed}"
        )
    rows["edge, squared error in units of the bound"] = f"{study.nees:.2f} of 6 expected, {study.trials} trials"
    console.emit_summary("reproduce profiler-seeds: done", {**rows, "written to": str(folder)})
