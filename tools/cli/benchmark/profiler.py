"""weldcal benchmark profiler: the edge without a guess, beside the paper's method and a search."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console


def profiler(
    data: Annotated[
        Path | None,
        typer.Option("--data", metavar="FOLDER", help="The fixed files; without them, sets made from the seed."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from this number.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """How fast an edge calibrates a profiler without a guess, beside the paper's method and a grid search."""
    from weldcal.tools.cli.options import fresh_folder

    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark profiler") as progress:
        from weldcal.tools.studies.profiler.speed import lines, run_profiler_benchmark

        folder = out or fresh_folder("benchmark", "profiler", seed)
        summary = run_profiler_benchmark(folder, seed, data, progress)
    if json:
        console.emit_json(summary)
    else:
        console.emit_summary("benchmark profiler: done", {**lines(summary), "written to": str(folder)})
