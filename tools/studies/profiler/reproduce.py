"""`weldcal reproduce profiler`: both papers' tables and the joint method, with targets; writes table.json and report.html."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, Outcome, command, option, switch
from weldcal.tools.console import Progress
from weldcal.tools.report.files import write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.harness import MISSED
from weldcal.tools.studies.profiler.edge import EdgeRow, ball_points, edge_rows
from weldcal.tools.studies.profiler.fixed import figure_text, fixed_lines, published_lines, require_files
from weldcal.tools.studies.profiler.report import ProfilerStudy, ProfilerStudyOptions, profiler_report
from weldcal.tools.studies.profiler.sphere import WorldResult, measure
from weldcal.tools.studies.targets import Target
from weldcal.tools.worlds.edge_trials import SETS, EdgeTrial, fixed_edge_trials, made_edge_trials
from weldcal.tools.worlds.profiler_parts import fixed_worlds, made_worlds

TRIALS, WORLDS, GROOVES, BOSSES = 10, 8, 3, 2
QUICK_SETS = ("xy_paper", "tilt_nominal")


@command("reproduce profiler", short_help="Repeat both papers on laser profilers.")
def profiler(
    call: Call,
    data: Annotated[
        Path | None, option("--data", "FOLDER", "The fixed files. Without them, worlds generated from the seed.")
    ] = None,
    quick: Annotated[bool, switch("--quick", "Two sets of edges and two or three worlds.")] = False,
) -> Outcome:
    """Repeat both papers on laser profilers: their tables with ours for comparison, figures, a report."""
    folder = call.folder("reproduce", "profiler")
    study = run_profiler_study(ProfilerStudyOptions(folder, data, call.seed, quick), call.progress)
    rows = {t.what: f"{figure_text(t.value, t.unit)}, target {t.limit:g}: {t.verdict}" for t in study.targets()}
    # the targets were set for the fixed files: other worlds may be harder
    return Outcome(study.summary(), values={}, rows=rows, problem="" if study.met or data is None else MISSED)


def run_profiler_study(options: ProfilerStudyOptions, progress: Progress) -> ProfilerStudy:
    """Run it and write table.json and report.html.

    Raises:
        InputError: the fixed files are not in the folder named.
    """
    start = time.monotonic()
    data = options.data
    if data is not None and not data.is_dir():
        raise InputError(f"There is no folder '{data}': give the one with edge_features.npz and sphere.npz.")
    whole = None if options.quick else data
    if whole is not None:
        require_files(whole)
    names = QUICK_SETS if options.quick else SETS
    worlds = (2 if data is None else 3) if options.quick else WORLDS

    def trials_of(name: str) -> Iterator[EdgeTrial]:
        return made_edge_trials(name, TRIALS, options.seed) if data is None else fixed_edge_trials(data, name)

    rows: list[EdgeRow] = []
    for k, name in enumerate(names):

        def tell(share: float, k: int = k) -> None:
            progress(f"edge {names[k]}", 0.4 * (k + share) / len(names))

        rows += edge_rows(name, trials_of(name), tell)
    made = made_worlds(worlds, options.seed, GROOVES, BOSSES) if data is None else fixed_worlds(data, worlds)
    results: list[WorldResult] = []
    for k, world in enumerate(made):
        progress(f"sphere, world {k}", 0.4 + 0.4 * k / worlds)
        results += measure(k, world)
    fixed: list[Target] = []
    if whole is not None:
        fixed = [*published_lines(results), *fixed_lines(whole, lambda name, share: progress(name, 0.8 + 0.2 * share))]
    first = next(iter(trials_of(names[0])))
    e = first.joint()
    cloud = ball_points(first, e.rotation, e.translation)
    study = ProfilerStudy(
        options=options, names=names, edge=tuple(rows), sphere=tuple(results), ball=cloud, fixed=tuple(fixed),
        wall_seconds=time.monotonic() - start,
    )  # fmt: skip
    write_json(options.folder / "table.json", study.summary())
    write_atomic(options.folder / "report.html", profiler_report(study))
    return study
