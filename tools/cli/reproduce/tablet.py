"""weldcal reproduce tablet and weldcal benchmark tablet."""

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


def reproduce_tablet(
    evolution_seeds: Annotated[
        int,
        typer.Option(
            "--evolution-seeds",
            metavar="N",
            min=0,
            help="Seeds of differential evolution per table, some seconds each.",
        ),
    ] = 1,
    trials: Annotated[
        int, typer.Option("--trials", metavar="N", min=1, help="Simulated trials for the unseen error.")
    ] = 60,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """The tablet paper: Tables 7 to 12 beside ours, the sign of Eq. 20, and the models that predict better."""
    from weldcal.tools.cli.options import fresh_folder

    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("reproduce tablet") as progress:
        from weldcal.tools.studies.tablet.command import run_tablet_study
        from weldcal.tools.studies.tablet.results import TabletOptions, limit_words

        folder = out or fresh_folder("reproduce", "tablet", seed)
        study = run_tablet_study(TabletOptions(folder, seed, evolution_seeds, trials), progress)
    if json:
        console.emit_json(study.summary())
    else:
        rows = {t.what: f"{t.value:.4f}  ({limit_words(t)}: {t.verdict})" for t in study.targets}
        minutes = study.cost.published / 60.0
        rows["the paper's 1e8 evaluations"] = f"{minutes:.0f} min, extrapolated from one"
        console.emit_summary("reproduce tablet: done", {**rows, "written to": str(folder)})
    if not study.met:
        console.emit_warning("Some targets were missed; the table says which.")
        raise typer.Exit(1)


def benchmark_tablet(
    out: OutOption = None, seed: SeedOption = 0, json: JsonOption = False, debug: DebugOption = False
) -> None:
    """How long each tablet calibration takes, and how many times faster than the published search."""
    from weldcal.tools.cli.options import finish, fresh_folder

    folder = out or fresh_folder("benchmark", "tablet", seed)
    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("benchmark tablet") as progress:
        from weldcal.tools.studies.tablet.speed import run_tablet_benchmark

        summary = run_tablet_benchmark(folder, seed, progress)
    finish("benchmark tablet", summary, folder, json_wanted=json)
