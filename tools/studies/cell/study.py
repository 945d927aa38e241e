"""Runs the weld in the whole simulated cell over seeds: seam points and torch against the truth, and speed."""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.runner import Progress, no_progress, run_cell
from weldcal.systems.scenario.loading import scenario_names
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.demo import known_camera, measure
from weldcal.tools.outcomes.demo import DemoResult
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.outcomes.weld import FeltSeam, felt_seam
from weldcal.tools.report.files import records_csv, write_json
from weldcal.tools.report.render import fixed, write_atomic
from weldcal.tools.studies.output import print_note, print_table
from weldcal.tools.studies.targets import Target, print_targets
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


@dataclass(frozen=True, kw_only=True)
class CellRun:
    """One weld. Lengths in mm: seam points sideways and in height against where the tool's numbers say a seated tip is
    felt (sd about a smooth line through themselves, and mean); torch against the true line, sideways and in space; its speed's
    coefficient of variation in %. `cpu_per_second`: processor seconds (all threads) per simulated second of the weld."""

    scenario: str
    law: str
    seed: int
    completed: bool
    reason: str
    point_sd_mm: float = np.nan
    point_spread_mm: float = np.nan
    point_offset_mm: float = np.nan
    height_sd_mm: float = np.nan
    height_offset_mm: float = np.nan
    torch_mean_mm: float = np.nan
    torch_max_mm: float = np.nan
    space_max_mm: float = np.nan
    cv_percent: float = np.nan
    welded_mm: float = np.nan
    real_time_factor: float = np.nan
    cpu_per_second: float = np.nan


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


def figures(result: DemoResult, name: str, law: str, seed: int, cpu_per_second: float) -> CellRun:
    """The figures of a finished run, in mm."""
    run, weld = result.run, result.weld
    felt: FeltSeam | None = felt_seam(run.cell, run.root)
    if weld is None or weld.error is None or weld.speed is None or felt is None:
        return CellRun(scenario=name, law=law, seed=seed, completed=False, reason=run.reason or "nothing was welded")
    return CellRun(
        scenario=name,
        law=law,
        seed=seed,
        completed=not run.held,
        reason=run.reason or "",
        point_sd_mm=1e3 * scatter(felt.lateral),
        point_spread_mm=1e3 * float(felt.lateral.std()),
        point_offset_mm=1e3 * float(felt.lateral.mean()),
        height_sd_mm=1e3 * scatter(felt.height),
        height_offset_mm=1e3 * float(felt.height.mean()),
        torch_mean_mm=1e3 * weld.error.mean_m,
        torch_max_mm=1e3 * weld.error.max_m,
        space_max_mm=1e3 * float(np.hypot(weld.error.lateral, weld.error.height).max()),
        cv_percent=1e2 * weld.speed.cv,
        welded_mm=1e3 * weld.speed.welded_m,
        real_time_factor=run.real_time_factor("weld"),
        cpu_per_second=cpu_per_second,
    )


def scatter(values: Array, window: int = 31) -> float:
    """Standard deviation of a series about a smooth line through itself: quadratics over `window` neighbours."""
    from scipy.signal import savgol_coeffs, savgol_filter

    if len(values) <= window:
        return float(np.std(values))
    gap = values - savgol_filter(values, window, 2)
    # A point pulls its own line towards itself by its weight in it.
    own = savgol_coeffs(window, 2)[window // 2]
    return float(np.sqrt(np.mean(gap**2) / (1.0 - own)))


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
