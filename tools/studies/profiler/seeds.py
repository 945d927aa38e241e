"""Every target of the profiler study over many seeds: figures, their Cramer-Rao bounds, and the fixed files."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.models.errors import InputError
from weldcal.tools.console import Progress
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.output import write_json
from weldcal.tools.studies.profiler.bounds import world_bounds
from weldcal.tools.studies.profiler.edge import TARGETS, edge_figures, edge_targets
from weldcal.tools.studies.profiler.plots import over_seeds
from weldcal.tools.studies.profiler.results import Reached, TargetLine
from weldcal.tools.studies.profiler.sets import EdgeTrial, fixed_edge_trials, made_edge_trials, rms
from weldcal.tools.studies.profiler.sphere import (
    METHODS,
    WorldData,
    WorldResult,
    fixed_worlds,
    joint_records,
    made_worlds,
    measured,
    named_figures,
    seam_features,
    sphere_figures,
    sphere_targets,
)

TRIALS = {"free": 20}
WORLDS, GROOVES, BOSSES = 8, 3, 2


@dataclass(frozen=True)
class SeedStudy:
    """All lines, the mean squared error in units of the bound (6 expected) of the edge's trials, and how long it took."""

    folder: Path
    first: int
    count: int
    lines: tuple[TargetLine, ...]
    nees: float
    trials: int
    wall_seconds: float

    def summary(self) -> dict[str, object]:
        """For JSON."""
        return {
            "state": "done",
            "seeds": [self.first, self.first + self.count - 1],
            "edge_nees": self.nees,
            "edge_trials": self.trials,
            "lines": [
                {
                    "what": line.what, "unit": line.unit, "target": line.target, "median": float(np.median(line.values)),
                    "least": float(line.values.min()), "largest": float(line.values.max()), "met": line.met,
                    "bound": float(np.median(line.bounds)), "over_bound": line.over_bound,
                    "fixed_files": None if line.fixed is None else line.fixed.value,
                    "fixed_files_bound": None if line.fixed is None else line.fixed.bound,
                    "values": line.values, "bounds": line.bounds,
                }
                for line in self.lines
            ],
            "wall_seconds": self.wall_seconds,
            "written_to": self.folder,
        }  # fmt: skip


def run_profiler_seeds(folder: Path, first: int, count: int, data: Path | None, progress: Progress) -> SeedStudy:
    """Every target for `count` seeds, and for the fixed files where their folder is given; writes seeds.json and seeds.svg.

    Raises:
        InputError: the fixed files are not in the folder named.
    """
    if data is not None and not data.is_dir():
        raise InputError(f"There is no folder '{data}': give the one with edge_features.npz and sphere.npz.")
    start = time.monotonic()
    nees: list[float] = []
    fixed: dict[str, Reached] = {}
    if data is not None:
        progress("fixed files", 0.0)
        fixed = _all({n: fixed_edge_trials(data, n) for n in TARGETS}, fixed_worlds(data, WORLDS), 0, [])
    found: list[dict[str, Reached]] = []
    for k in range(count):
        progress(f"seed {first + k}", (k + 0.5) / (count + 0.5))
        seed = first + k
        trials = {n: made_edge_trials(n, TRIALS.get(n.split("_")[0], 10), seed) for n in TARGETS}
        found.append(_all(trials, made_worlds(WORLDS, seed, GROOVES, BOSSES), seed, nees))
    lines = tuple(
        TargetLine(what, unit, target, tuple(f[what] for f in found), fixed.get(what))
        for what, unit, target in [*edge_targets(TARGETS), *sphere_targets()]
    )
    study = SeedStudy(folder, first, count, lines, float(np.mean(nees)), len(nees), time.monotonic() - start)
    write_json(folder / "seeds.json", study.summary())
    write_atomic(folder / "seeds.svg", over_seeds(study.lines).decode())
    return study


def _all(
    trials: dict[str, Iterator[EdgeTrial]], worlds: Iterable[WorldData], seed: int, nees: list[float]
) -> dict[str, Reached]:
    """Every figure and its bound; the squared errors in units of the bound are appended to `nees`."""
    values: dict[str, float] = {}
    bounds: dict[str, float] = {}
    for name, every in trials.items():
        errors, least = [], []
        for trial in every:
            e = trial.joint()
            errors.append(trial.error(e.rotation, e.translation, trial.crb()))
            least.append(trial.bound())
        nees += [e.nees for e in errors]
        values |= edge_figures(name, rms(errors))
        bounds |= edge_figures(name, rms(least))
    results, predicted = _sphere(worlds, seed)
    values |= sphere_figures(results)
    bounds |= predicted
    return {what: Reached(values[what], bounds[what]) for what in values}


def _sphere(worlds: Iterable[WorldData], seed: int) -> tuple[list[WorldResult], dict[str, float]]:
    """Results of the joint methods, and the figures that their bounds predict."""
    results: list[WorldResult] = []
    bound: dict[str, list[np.ndarray]] = {"points": [], "seam": [], "boss": []}
    for k, world in enumerate(worlds):
        features = seam_features(world)
        for method, record in joint_records(world).items():
            results.append(measured(k, method, record, world, features, boss=method == METHODS[3]))
        for name, value in world_bounds(world, features, 1000 * seed + k).items():
            bound[name].append(value)
    points = float(np.mean(bound["points"]))
    return results, named_figures(dict.fromkeys(METHODS[2:], points), bound["seam"], bound["boss"])
