"""weldcal reproduce cell: the weld in the whole simulated cell, its contact and its rendered tag, against its targets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console


def cell(
    seeds: Annotated[int, typer.Option("--seeds", metavar="N", min=1, help="How many seeds of each scenario.")] = 3,
    scenarios: Annotated[
        str, typer.Option("--scenarios", metavar="NAMES", help="Which scenarios, with commas between.")
    ] = "s_groove,l_groove",
    seam_mm: Annotated[
        float | None, typer.Option("--seam-mm", metavar="MM", min=10.0, help="Weld only this much; default: all.")
    ] = None,
    law: Annotated[str, typer.Option("--law", metavar="NAME", help="Steering law, for comparison.")] = "guarded",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="The first seed; everything random follows from it.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """The weld in the whole cell, contact and rendered tag included: seam points, torch and real-time factor."""
    from weldcal.tools.cli.options import fresh_folder

    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("reproduce cell") as progress:
        from weldcal.tools.studies.cell.study import CellStudyOptions, run_cell_study

        names = tuple(name.strip() for name in scenarios.split(",") if name.strip())
        folder = out or fresh_folder("reproduce", "cell", seed)
        study = run_cell_study(CellStudyOptions(folder, names, seeds, seed, seam_mm, law), progress)
    if json:
        console.emit_json(study.summary())
    else:
        from weldcal.tools.studies.cell.study import print_cell_study

        print_cell_study(study)
    if not study.met:
        console.emit_warning("Some targets were missed; the table says which.")
        raise typer.Exit(1)
