"""Runs the profiler study: both papers' tables and the joint method; writes table.json and report.html."""

import time
from collections.abc import Iterator

from weldcal.models.errors import InputError
from weldcal.tools.console import Progress
from weldcal.tools.report.files import write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.profiler.edge import all_sets, ball_points
from weldcal.tools.studies.profiler.fixed import fixed_lines, published_lines, require_files
from weldcal.tools.studies.profiler.report import profiler_report
from weldcal.tools.studies.profiler.results import ProfilerStudy, ProfilerStudyOptions
from weldcal.tools.studies.profiler.sets import SETS, EdgeTrial, fixed_edge_trials, made_edge_trials
from weldcal.tools.studies.profiler.sphere import all_worlds, fixed_worlds, made_worlds
from weldcal.tools.studies.targets import Target

TRIALS, WORLDS, GROOVES, BOSSES = 10, 8, 3, 2
QUICK_SETS = ("xy_paper", "tilt_nominal")


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

    rows = all_sets(trials_of, names, lambda name, share: progress(f"edge {name}", 0.4 * share))
    made = made_worlds(worlds, options.seed, GROOVES, BOSSES) if data is None else fixed_worlds(data, worlds)
    results = all_worlds(made, worlds, lambda name, share: progress(f"sphere, {name}", 0.4 + 0.4 * share))
    fixed: list[Target] = []
    if whole is not None:
        fixed = [*published_lines(results), *fixed_lines(whole, lambda name, share: progress(name, 0.8 + 0.2 * share))]
    first = next(iter(trials_of(names[0])))
    e = first.joint()
    cloud = ball_points(first, e.rotation, e.translation)
    study = ProfilerStudy(
        options=options,
        names=names,
        edge=tuple(rows),
        sphere=tuple(results),
        ball=cloud,
        fixed=tuple(fixed),
        wall_seconds=time.monotonic() - start,
    )
    write_json(options.folder / "table.json", study.summary())
    write_atomic(options.folder / "report.html", profiler_report(study))
    return study
