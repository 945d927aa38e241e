"""Runs the weld in the whole simulated cell over seeds: seam points and torch against the truth, and speed."""

import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np

from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.runner import Progress, no_progress, run_cell
from weldcal.systems.scenario.loading import scenario_names
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.commands.weld import known_camera, measure
from weldcal.tools.report.files import records_csv, write_json
from weldcal.tools.report.render import fixed, write_atomic
from weldcal.tools.report.run import RunOptions
from weldcal.tools.studies.harness import MISSED
from weldcal.tools.studies.output import print_note, print_table
from weldcal.tools.studies.targets import Target, print_targets
from weldcal.tools.worlds.weld.cell_run import CellRun, figures
from weldcal.welding.servo.laws import get_law

# (figure, worst or mean over the runs, limit, unit); a real-time factor is a lower bound
TARGETS = (
    ("point_sd_mm", "worst", 0.02, "mm"),
    ("torch_mean_mm", "worst", 0.1, "mm"),
    ("torch_max_mm", "worst", 0.3, "mm"),
    ("real_time_factor", "mean", 1.0, ""),
)
AT_LEAST = WALL_CLOCK = ("real_time_factor",)


@dataclass(frozen=True)
class CellStudyOptions:
    """Where to write, which scenarios, how many seeds from which on, how much of each seam (None: all), by which law."""

    folder: Path
    scenarios: tuple[str, ...] = ("s_groove", "l_groove")
    seeds: int = 3
    first_seed: int = 0
    seam_mm: float | None = None
    law: str = "guarded"


@dataclass(frozen=True)
class CellStudy:
    """Every run, and how the targets were met."""

    options: CellStudyOptions
    runs: tuple[CellRun, ...]
    wall_seconds: float
    reached: tuple[tuple[str, float, float, bool], ...] = field(default=())

    @property
    def met(self) -> bool:
        """Whether all were completed and every target met; the real-time factor depends on the machine and does not count."""
        return all(r.completed for r in self.runs) and all(
            ok for name, *_, ok in self.reached if name not in WALL_CLOCK
        )

    def summary(self) -> dict[str, object]:
        """The result for JSON."""
        return {
            "state": "done",
            "met": self.met,
            "law": self.options.law,
            "targets": {name: {"value": value, "limit": limit, "met": ok} for name, value, limit, ok in self.reached},
            "runs": self.runs,
            "wall_seconds": self.wall_seconds,
            "written_to": self.options.folder,
        }


class PhaseCpu:
    """Processor seconds of this process (all threads) by phase of a run; hand `progress` to whatever runs it."""

    def __init__(self, onward: Progress = no_progress) -> None:
        self._onward = onward
        self._phase, self._since = "", time.process_time()
        self.seconds: dict[str, float] = {}

    def progress(self, stage: str, share: float) -> None:
        """Count the time up to now for the phase that was running."""
        now = time.process_time()
        if stage != self._phase:
            self.seconds[self._phase] = self.seconds.get(self._phase, 0.0) + now - self._since
            self._phase, self._since = stage, now
        self._onward(stage, share)


def run_cell_study(options: CellStudyOptions, progress: Progress = no_progress) -> CellStudy:
    """Weld every scenario with every seed; table.json and runs.csv grow run by run.

    Raises:
        InputError: no such scenario or law, or no seeds; nothing has been written.
    """
    get_law(options.law)
    unknown = [name for name in options.scenarios if name not in scenario_names() and not Path(name).is_file()]
    if unknown:
        raise InputError(f"There is no scenario '{unknown[0]}': choose some of {', '.join(scenario_names())}.")
    start = time.monotonic()
    jobs = [(name, options.first_seed + k) for name in options.scenarios for k in range(options.seeds)]
    runs: list[CellRun] = []
    for k, (name, seed) in enumerate(jobs):
        done = k / len(jobs)
        runs.append(
            weld_once(name, seed, options, lambda stage, share, at=done: progress(stage, at + share / len(jobs)))  # type: ignore[misc]
        )
        study = CellStudy(options, tuple(runs), time.monotonic() - start, hold_against(runs))
        write_json(options.folder / "table.json", study.summary())
        write_atomic(options.folder / "runs.csv", records_csv(runs))
    return study


def weld_once(name: str, seed: int, options: CellStudyOptions, progress: Progress = no_progress) -> CellRun:
    """One weld of a scenario whose camera pose is known exactly."""
    scenario: Scenario = known_camera(name)
    scenario.welding.seam_length_mm = options.seam_mm
    scenario.welding.law = options.law
    watch = PhaseCpu(progress)
    run = run_cell(build_cell(scenario, seed), watch.progress)
    watch.progress("", 1.0)
    result = measure(run, RunOptions(scenario=name, out=options.folder, seed=seed, recording=False))
    lasted = sum(b[1] - a[1] for a, b in zip(run.phases, run.phases[1:], strict=False) if a[0] == "weld")
    cpu = watch.seconds.get("weld", np.nan) / lasted if lasted else np.nan
    return figures(result, name, options.law, seed, cpu)


def hold_against(runs: list[CellRun]) -> tuple[tuple[str, float, float, bool], ...]:
    """(figure, value, limit, whether met) of every target, over the runs that have it."""
    reached = []
    for name, over, limit, _ in TARGETS:
        values = np.array([getattr(r, name) for r in runs], dtype=float)
        values = values[np.isfinite(values)]
        sign = -1.0 if name in AT_LEAST else 1.0
        if not len(values):
            reached.append((name, np.nan, limit, False))
            continue
        value = float(values.mean() if over == "mean" else sign * (sign * values).max())
        reached.append((name, value, limit, bool(sign * value <= sign * limit)))
    return tuple(reached)


FIGURES = (
    ("seam points, sd mm", "point_sd_mm", 4), ("seam points, offset mm", "point_offset_mm", 4),
    ("their height, sd mm", "height_sd_mm", 3), ("their height, offset mm", "height_offset_mm", 3),
    ("torch, mean mm", "torch_mean_mm", 3), ("torch, largest mm", "torch_max_mm", 3),
    ("in space, largest mm", "space_max_mm", 3), ("torch speed CV %", "cv_percent", 2),
    ("real-time factor of the weld", "real_time_factor", 2), ("CPU s per simulated s", "cpu_per_second", 2),
)  # fmt: skip
NAMES = {
    "point_sd_mm": "seam points, sd", "torch_mean_mm": "torch, mean", "torch_max_mm": "torch, largest",
    "real_time_factor": "real-time factor of the weld",
}  # fmt: skip


def print_cell_study(study: CellStudy) -> None:
    """Write the tables on stdout."""
    header = ("", *(f"{run.scenario.removesuffix('_groove')}\nseed {run.seed}" for run in study.runs))
    print_table(
        "", header, [(title, *(fixed(getattr(run, name), k) for run in study.runs)) for title, name, k in FIGURES]
    )
    for run in study.runs:
        if not run.completed:
            print_note(f"{run.scenario}, seed {run.seed}, was not completed: {run.reason}")
    reached = {name: value for name, value, _, _ in study.reached}
    targets = [
        Target(
            NAMES[name],
            unit,
            reached[name],
            limit,
            "≥" if name in AT_LEAST else "≤",
            over=over,
            decides=name not in WALL_CLOCK,
        )
        for name, over, limit, unit in TARGETS
        if name in reached
    ]
    print_targets(f"Law: {study.options.law}", targets)
    print_note(f"written to {study.options.folder}")


@command("reproduce cell", short_help="Weld in the whole simulated cell.")
def cell(
    call: Call,
    seeds: Annotated[int, option("--seeds", "N", "Number of seeds of each scenario.", min=1)] = 3,
    scenarios: Annotated[str, option("--scenarios", "NAMES", "Scenarios, separated by commas.")] = "s_groove,l_groove",
    seam_mm: Annotated[
        float | None, option("--seam-mm", "MM", "Weld only this length; default: all.", min=10.0)
    ] = None,
    law: Annotated[str, option("--law", "NAME", "Steering law, for comparison.")] = "guarded",
) -> Outcome:
    """Weld in the whole simulated cell, with contact and rendered tag: seam points, torch and real-time factor."""
    folder = call.folder("reproduce", "cell")
    names = tuple(name.strip() for name in scenarios.split(",") if name.strip())
    study = run_cell_study(CellStudyOptions(folder, names, seeds, call.seed, seam_mm, law), call.progress)
    return Outcome(study.summary(), {}, text=partial(print_cell_study, study), problem="" if study.met else MISSED)
