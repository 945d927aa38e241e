"""weldcal reproduce: studies that hold the library's figures against their targets, from one command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools import console
from weldcal.tools.cli.reproduce.flange import flange
from weldcal.tools.cli.reproduce.profiler_seeds import profiler_seeds
from weldcal.tools.cli.reproduce.tablet import reproduce_tablet

reproduce = typer.Typer(help="Figures against their targets.", no_args_is_help=True)
reproduce.command("tablet")(reproduce_tablet)


@reproduce.callback()
def _group() -> None:
    """Figures against their targets."""


reproduce.command("flange")(flange)
reproduce.command("profiler-seeds")(profiler_seeds)


@reproduce.command("weld")
def weld(
    seeds: Annotated[
        int, typer.Option("--seeds", metavar="N", min=1, help="How many seeds each weld is run with.")
    ] = 10,
    rows: Annotated[
        str, typer.Option("--rows", metavar="NAMES", help="Only these rows, with commas between.", show_default="all")
    ] = "",
    quick: Annotated[
        bool, typer.Option("--quick", help="Two seeds of each weld, and two of the laws' side by side.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="The first seed; everything random follows from it.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """The weld law in a small kinematic world: every target, the paper's law beside it, pictures, one report."""
    from weldcal.tools.cli.options import fresh_folder

    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("reproduce weld") as progress:
        from weldcal.tools.studies.weld.command import run_study
        from weldcal.tools.studies.weld.results import StudyOptions

        wanted = tuple(name.strip() for name in rows.split(",") if name.strip())
        folder = out or fresh_folder("reproduce", "weld", seed)
        study = run_study(StudyOptions(folder, wanted, min(seeds, 2) if quick else seeds, seed, quick), progress)
    if json:
        console.emit_json(study.summary())
    else:
        from weldcal.tools.studies.weld.report import print_study

        print_study(study)
    if not study.met:
        console.emit_warning("Some targets were missed; the table says which.")
        raise typer.Exit(1)


@reproduce.command("profiler")
def profiler(
    data: Annotated[
        Path | None,
        typer.Option("--data", metavar="FOLDER", help="The fixed files; without them, worlds made from the seed."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Two sets of edges and two or three worlds.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="The first seed; everything random follows from it.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """A laser profiler on the flange: both papers' tables with ours beside them, pictures, one report."""
    from weldcal.tools.cli.options import fresh_folder

    with console.boundary(json_wanted=json, debug=debug), console.progress_bar("reproduce profiler") as progress:
        from weldcal.tools.studies.profiler.command import run_profiler_study
        from weldcal.tools.studies.profiler.results import ProfilerStudyOptions

        folder = out or fresh_folder("reproduce", "profiler", seed)
        study = run_profiler_study(ProfilerStudyOptions(folder, data, seed, quick), progress)
    if json:
        console.emit_json(study.summary())
    else:
        from weldcal.tools.studies.profiler.fixed import figure_text

        rows = {t.what: f"{figure_text(t.value, t.unit)}, target {t.limit:g}: {t.verdict}" for t in study.targets()}
        console.emit_summary("reproduce profiler: done", {**rows, "written to": str(folder)})
    if not study.met:
        console.emit_warning(
            "Some targets were missed; the table says which. They were set on the fixed files (--data)."
        )
        raise typer.Exit(1)
