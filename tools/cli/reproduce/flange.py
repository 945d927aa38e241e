"""weldcal reproduce flange: the flange paper's tables and figures, ours beside theirs, and the truth on other poses."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console


def flange(
    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DATA]",
            help="The folder that holds the recorded datasets; without it only the simulated parts are run.",
            show_default=False,
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer noise levels, realisations, shuffled orders and splits.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from this number.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """Flange calibration as published: Table 1, Fig. 9, 10 and 11, the Kinect, and what Algorithm 1's cost does."""
    from weldcal.tools.cli.options import fresh_folder

    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("reproduce flange") as progress:
        from weldcal.tools.studies.flange.published.command import run_study
        from weldcal.tools.studies.flange.published.results import StudyOptions

        folder = out or fresh_folder("reproduce", "flange", seed)
        study = run_study(StudyOptions(folder, data, seed, quick), progress)
        found = study.summary()
    if json:
        console.emit_json(found)
        return
    from weldcal.tools.studies.flange.published.report import print_study

    print_study(study)
