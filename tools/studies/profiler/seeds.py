"""Every target of the profiler over many seeds: what was reached, what the bound allows, and where the fixed files stand."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.profiler.edge.joint import edge_crb, edge_joint
from weldcal.calibration.profiler.features.groove import groove_features
from weldcal.models.errors import InputError
from weldcal.tools.console import Progress, plain
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.profiler import edge
from weldcal.tools.studies.profiler.bounds import world_bounds
from weldcal.tools.studies.profiler.sets import EdgeTrial, fixed_edge_trials, made_edge_trials
from weldcal.tools.studies.profiler.sphere import (
    METHODS,
    MM,
    TARGET_BOSS,
    TARGET_POINTS,
    TARGET_SEAM,
    WorldData,
    fixed_worlds,
    joint_records,
    made_worlds,
    measured,
)

TRIALS = {"free": 20}
WORLDS, GROOVES, BOSSES = 8, 3, 2
EDGE_TARGETS = edge.TARGETS | {
    "free_paper": (0.36, 0.42),
    "free_nominal": (0.107, 0.123),
    "outlier_nominal": (0.071, 0.095),
}
EDGE_TITLES = edge.TITLES | {
    "free_paper": "40 free poses, noise as in the paper", "free_nominal": "40 free poses, nominal noise",
    "outlier_nominal": "a tenth of outliers",
}  # fmt: skip


@dataclass(frozen=True)
class Reached:
    """One figure of one seed or of the fixed files: what was reached, and the bound where there is one (mm or deg)."""

    value: float
    bound: float | None


@dataclass(frozen=True)
class Line:
    """One target over the seeds."""

    what: str
    unit: str
    target: float
    seeds: tuple[Reached, ...]
    fixed: Reached | None

    @property
    def values(self) -> np.ndarray:
        """Reached (n,), seed by seed."""
        return np.array([r.value for r in self.seeds])

    @property
    def bounds(self) -> np.ndarray:
        """Bounds (n,); not a number where there is none."""
        return np.array([np.nan if r.bound is None else r.bound for r in self.seeds])

    @property
    def over_bound(self) -> float:
        """All seeds together, root of the mean squares over the bound's."""
        return float(np.sqrt(np.mean(self.values**2) / np.mean(self.bounds**2)))

    @property
    def met(self) -> int:
        """In how many seeds the target is met."""
        return int((self.values <= self.target).sum())


@dataclass(frozen=True)
class SeedStudy:
    """All lines, the mean squared error in units of the bound (6 expected) of the edge's trials, and how long it took."""

    folder: Path
    first: int
    count: int
    lines: tuple[Line, ...]
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
        fixed = _all({n: fixed_edge_trials(data, n) for n in EDGE_TARGETS}, fixed_worlds(data, WORLDS), 0, [])
    found: list[dict[str, Reached]] = []
    for k in range(count):
        progress(f"seed {first + k}", (k + 0.5) / (count + 0.5))
        seed = first + k
        trials = {n: made_edge_trials(n, TRIALS.get(n.split("_")[0], 10), seed) for n in EDGE_TARGETS}
        found.append(_all(trials, made_worlds(WORLDS, seed, GROOVES, BOSSES), seed, nees))
    lines = tuple(
        Line(what, unit, target, tuple(f[what] for f in found), fixed.get(what)) for what, unit, target in targets()
    )
    study = SeedStudy(folder, first, count, lines, float(np.mean(nees)), len(nees), time.monotonic() - start)
    from weldcal.tools.studies.profiler.plots import over_seeds

    write_atomic(folder / "seeds.json", json.dumps(plain(study.summary()), indent=1) + "\n")
    write_atomic(folder / "seeds.svg", over_seeds(study.lines).decode())
    return study


def targets() -> list[tuple[str, str, float]]:
    """(what, unit, target) of every line, in the order of the note's table."""
    lines: list[tuple[str, str, float]] = []
    for name, (turn, shift) in EDGE_TARGETS.items():
        lines += [
            (f"edge, {EDGE_TITLES[name]}, rotation", "deg", turn),
            (f"edge, {EDGE_TITLES[name]}, translation", "mm", shift),
        ]
    lines += [(f"sphere, {method}", "mm", limit) for method, limit in TARGET_POINTS.items()]
    names = ("first edge", "root", "second edge")
    lines += [(f"seam, {name}", "mm", limit) for name, limit in zip(names, TARGET_SEAM, strict=True)]
    return [*lines, ("boss, length (worst)", "mm", TARGET_BOSS[0]), ("boss, angle (worst)", "deg", TARGET_BOSS[1])]


def _all(
    trials: dict[str, Iterator[EdgeTrial]], worlds: Iterable[WorldData], seed: int, nees: list[float]
) -> dict[str, Reached]:
    found: dict[str, Reached] = {}
    for name, every in trials.items():
        value, bound = _edge(every, nees)
        for part, v, b in zip(("rotation", "translation"), value, bound, strict=True):
            found[f"edge, {EDGE_TITLES[name]}, {part}"] = Reached(float(v), float(b))
    return found | _sphere(worlds, seed)


def _edge(trials: Iterable[EdgeTrial], nees: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Rms error and bound (2,) deg and mm over the trials; the squared errors in units of the bound are appended."""
    values, bounds = [], []
    for trial in trials:
        X, noise = trial.poses, trial.noise
        e = edge_joint(X.rotation, X.translation, trial.points, sigma_robot_m=noise.robot_m, sigma_xz_m=noise.xz_m)
        good = X if trial.wrong is None else X[~trial.wrong]
        C = edge_crb(trial.truth, good.rotation, good.translation, sigma_robot_m=noise.robot_m, sigma_xz_m=noise.xz_m)
        turn = Rotation.from_matrix(trial.truth.rotation @ e.rotation.T).as_rotvec()
        off = np.concatenate([turn, trial.truth.translation - e.translation])
        nees.append(float(off @ np.linalg.solve(C, off)))
        values.append([off[:3] @ off[:3], off[3:] @ off[3:]])
        bounds.append([np.trace(C[:3, :3]), np.trace(C[3:, 3:])])
    unit = np.array([np.degrees(1.0), 1.0 / MM])
    return unit * np.sqrt(np.mean(values, axis=0)), unit * np.sqrt(np.mean(bounds, axis=0))


def _sphere(worlds: Iterable[WorldData], seed: int) -> dict[str, Reached]:
    points: dict[str, list[float]] = {m: [] for m in METHODS[2:]}
    seams, bosses = [], []
    bound: dict[str, list[np.ndarray]] = {"points": [], "seam": [], "boss": []}
    for k, world in enumerate(worlds):
        features = None
        if world.groove is not None:
            features = np.array([groove_features(p).points for p in world.groove.profiles])
        for method, record in joint_records(world).items():
            result = measured(k, method, record, world, features, boss=method == METHODS[3])
            points[method].append(float(result.points_mm.mean()))
            if method == METHODS[3] and result.seam_mm is not None:
                seams.append(result.seam_mm)
            if result.boss_error is not None:
                bosses.append(result.boss_error)
        for name, value in world_bounds(world, features, 1000 * seed + k).items():
            bound[name].append(value)
    foretold = float(np.mean(bound["points"]))
    found = {f"sphere, {m}": Reached(float(np.mean(v)), foretold) for m, v in points.items()}
    for name, value, b in zip(
        ("first edge", "root", "second edge"), np.mean(seams, axis=0), np.mean(bound["seam"], axis=0), strict=True
    ):
        found[f"seam, {name}"] = Reached(float(value), float(b))
    for name, value, b in zip(("length", "angle"), np.max(bosses, axis=0), np.max(bound["boss"], axis=0), strict=True):
        found[f"boss, {name} (worst)"] = Reached(float(value), float(b))
    return found
