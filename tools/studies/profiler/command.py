"""The profiler's study as one call: both papers' tables, ours beside theirs, JSON and report written."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from weldcal.calibration.profiler.edge.joint import edge_joint
from weldcal.models.errors import InputError
from weldcal.tools.console import Progress, plain
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.profiler.edge import TARGETS, TITLES, EdgeRow, all_sets, ball_points
from weldcal.tools.studies.profiler.fixed import Line, fixed_lines, published_lines, require_files
from weldcal.tools.studies.profiler.sets import SETS, EdgeTrial, fixed_edge_trials, made_edge_trials
from weldcal.tools.studies.profiler.sphere import (
    METHODS,
    TARGET_BOSS,
    TARGET_POINTS,
    TARGET_SEAM,
    WorldResult,
    all_worlds,
    fixed_worlds,
    made_worlds,
)

TRIALS, WORLDS, GROOVES, BOSSES = 10, 8, 3, 2
QUICK_SETS = ("xy_paper", "tilt_nominal")


@dataclass(frozen=True)
class ProfilerStudyOptions:
    """Where to write; the folder of the fixed files, or None to make trials from `seed`; whether in short."""

    folder: Path
    data: Path | None = None
    seed: int = 0
    quick: bool = False


@dataclass(frozen=True, eq=False)
class ProfilerStudy:
    """Everything that the study found; `ball` are a ball's profiles brought together by the joint method, `fixed` the targets of
    what only the fixed files hold."""

    options: ProfilerStudyOptions
    names: tuple[str, ...]
    edge: tuple[EdgeRow, ...]
    sphere: tuple[WorldResult, ...]
    ball: np.ndarray
    fixed: tuple[Line, ...]
    wall_seconds: float

    @property
    def folder(self) -> Path:
        """Where it was written."""
        return self.options.folder

    def of(self, method: str) -> list[WorldResult]:
        """A method's results over the worlds."""
        return [r for r in self.sphere if r.method == method]

    def targets(self) -> list[tuple[str, str, float, float, str]]:
        """(what, unit, reached, target, "met" or "MISSED"); the targets were set on the fixed files."""
        lines: list[tuple[str, str, float, float]] = []
        for r in self.edge:
            if r.met is not None:
                lines.append((f"edge, {TITLES[r.name]}, rotation", "deg", r.rotation_deg, TARGETS[r.name][0]))
                lines.append((f"edge, {TITLES[r.name]}, translation", "mm", r.translation_mm, TARGETS[r.name][1]))
        for method, limit in TARGET_POINTS.items():
            lines.append(
                (f"sphere, {method}", "mm", float(np.mean([r.points_mm.mean() for r in self.of(method)])), limit)
            )
        seams = [r.seam_mm for r in self.of(METHODS[3]) if r.seam_mm is not None]
        for name, value, limit in zip(
            ("first edge", "root", "second edge"), np.mean(seams, axis=0), TARGET_SEAM, strict=True
        ):
            lines.append((f"seam, {name}", "mm", float(value), limit))
        errors = [r.boss_error for r in self.of(METHODS[3]) if r.boss_error is not None]
        for name, unit, value, limit in zip(
            ("length", "angle"), ("mm", "deg"), np.max(errors, axis=0), TARGET_BOSS, strict=True
        ):
            lines.append((f"boss, {name} (worst)", unit, float(value), limit))
        lines += self.fixed
        return [(*line, "met" if line[2] <= line[3] else "MISSED") for line in lines]

    @property
    def met(self) -> bool:
        """Whether all targets are met."""
        return all(line[4] == "met" for line in self.targets())

    def summary(self) -> dict[str, object]:
        """The result for JSON."""
        return {
            "state": "done",
            "met": self.met,
            "data": "fixed files" if self.options.data else f"seed {self.options.seed}",
            "targets": [
                dict(zip(("what", "unit", "reached", "target", "verdict"), line, strict=True))
                for line in self.targets()
            ],
            "edge": [asdict(r) for r in self.edge],
            "sphere": [
                {
                    "world": r.world,
                    "method": r.method,
                    "points_mm": r.points_mm,
                    "seam_mm": r.seam_mm,
                    "boss": r.boss_error,
                }
                for r in self.sphere
            ],
            "wall_seconds": self.wall_seconds,
            "written_to": self.folder,
        }


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
    fixed: list[Line] = []
    if whole is not None:
        fixed = [
            *published_lines(results),
            *fixed_lines(whole, lambda name, share: progress(name, 0.8 + 0.2 * share)),
        ]
    first = next(iter(trials_of(names[0])))
    e = edge_joint(
        first.poses.rotation, first.poses.translation, first.points, sigma_robot_m=first.noise.robot_m, sigma_xz_m=first.noise.xz_m
    )  # fmt: skip
    cloud = ball_points(first, e.rotation, e.translation)
    study = ProfilerStudy(options, names, tuple(rows), tuple(results), cloud, tuple(fixed), time.monotonic() - start)
    from weldcal.tools.studies.profiler.report import profiler_report

    write_atomic(study.folder / "table.json", json.dumps(plain(study.summary()), allow_nan=False, indent=1) + "\n")
    write_atomic(study.folder / "report.html", profiler_report(study))
    return study
