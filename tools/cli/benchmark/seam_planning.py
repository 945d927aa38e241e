"""`weldcal benchmark seam-planning`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console


def seam_planning(
    runs: Annotated[int, typer.Option("--runs", metavar="N", min=1, help="Random poses of each part.")] = 2,
    preset: Annotated[
        list[str] | None,
        typer.Option("--preset", metavar="NAME", help="A scanner; again for more.", show_default="all"),
    ] = None,
    full: Annotated[
        bool, typer.Option("--full-resolution", help="Images as wide as the scanner has them, not 824 pixels at most.")
    ] = False,
    troubles: Annotated[
        bool, typer.Option("--troubles/--no-troubles", help="Occlusion, clutter and wrong workpieces as well.")
    ] = True,
    out: Annotated[Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write.")] = None,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Other poses and noise.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """How well a seam is planned from one scan, by drawing and from the cloud alone, for each scanner."""
    from weldcal.tools.cli.options import finish, fresh_folder

    folder = out or fresh_folder("benchmark", "seam-planning", seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark seam-planning") as progress:
        from weldcal.models.scanners import get_scanner
        from weldcal.tools.studies.seam_planning.benchmark import run_seam_planning_benchmark

        names = [get_scanner(name).name for name in preset] if preset else None
        summary, rows = run_seam_planning_benchmark(folder, runs, seed, names, progress, full=full, troubles=troubles)
    finish("benchmark seam-planning", summary, folder, json_wanted=json, rows=rows)
