"""Runs the weld in the whole simulated cell over seeds: seam points and torch against the truth, and speed."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.runner import run_cell
from weldcal.systems.scenario.loading import scenario_names
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.commands.weld import known_camera, measure
from weldcal.tools.report.render import fixed
from weldcal.tools.report.run import RunOptions
from weldcal.tools.studies.harness import Cases, Figures, Results, Study, Table, whole
from weldcal.tools.studies.targets import Target
from weldcal.tools.worlds.weld.case import figures
from weldcal.welding.servo.laws import get_law

# (figure, name, worst or mean over the runs, limit, unit); a real-time factor is a lower bound and depends on the
# machine
TARGETS = (
    ("point_sd_mm", "seam points, sd", "worst", 0.02, "mm"),
    ("torch_mean_mm", "torch, mean", "worst", 0.1, "mm"),
    ("torch_max_mm", "torch, largest", "worst", 0.3, "mm"),
    ("real_time_factor", "real-time factor of the weld", "mean", 1.0, ""),
)
WALL_CLOCK = ("real_time_factor",)
FIGURES = (
    ("seam points, sd mm", "point_sd_mm", 4),
    ("seam points, offset mm", "point_offset_mm", 4),
    ("their height, sd mm", "height_sd_mm", 3),
    ("their height, offset mm", "height_offset_mm", 3),
    ("torch, mean mm", "torch_mean_mm", 3),
    ("torch, largest mm", "torch_max_mm", 3),
    ("in space, largest mm", "space_max_mm", 3),
    ("torch speed CV %", "cv_percent", 2),
    ("real-time factor of the weld", "real_time_factor", 2),
    ("CPU s per simulated s", "cpu_per_second", 2),
)


class PhaseCpu:
    """Processor seconds of this process (all threads) by phase of a run; hand `progress` to whatever runs it."""

    def __init__(self) -> None:
        self._phase, self._since = "", time.process_time()
        self.seconds: dict[str, float] = {}

    def progress(self, stage: str, share: float) -> None:
        """Count the time up to now for the phase that was running."""
        now = time.process_time()
        if stage != self._phase:
            self.seconds[self._phase] = self.seconds.get(self._phase, 0.0) + now - self._since
            self._phase, self._since = stage, now


def cases(scenarios: Iterable[str], seeds: range, seam_mm: float | None = None, law: str = "guarded") -> Cases:
    """Every scenario with every seed.

    Raises:
        InputError: no such scenario or law.
    """
    get_law(law)
    unknown = [name for name in scenarios if name not in scenario_names() and not Path(name).is_file()]
    if unknown:
        raise InputError(f"There is no scenario '{unknown[0]}': choose some of {', '.join(scenario_names())}.")
    return {
        f"{name} {seed}": {"name": name, "seed": seed, "seam_mm": seam_mm, "law": law}
        for name in scenarios
        for seed in seeds
    }


def weld_once(name: str, seed: int, seam_mm: float | None, law: str) -> Mapping[str, object]:
    """One weld of a scenario whose camera pose is known exactly, ``seam_mm`` of the seam (None: all of it)."""
    scenario: Scenario = known_camera(name)
    scenario.welding.seam_length_mm = seam_mm
    scenario.welding.law = law
    watch = PhaseCpu()
    run = run_cell(build_cell(scenario, seed), watch.progress)
    watch.progress("", 1.0)
    result = measure(run, RunOptions(scenario=name, out=Path(), seed=seed, recording=False))
    lasted = sum(b[1] - a[1] for a, b in zip(run.phases, run.phases[1:], strict=False) if a[0] == "weld")
    cpu = watch.seconds.get("weld", np.nan) / lasted if lasted else np.nan
    return vars(figures(result, name, law, seed, cpu))


def targets(runs: Iterable[Mapping[str, Any]]) -> dict[str, Target]:
    """Each target, held against the runs that have its figure."""
    every = list(runs)
    out = {}
    for name, what, over, limit, unit in TARGETS:
        values = np.array([run[name] for run in every], dtype=float)
        values = values[np.isfinite(values)]
        least = name in WALL_CLOCK
        worst = np.min if least else np.max
        value = float((np.mean if over == "mean" else worst)(values)) if len(values) else np.nan
        out[name] = Target(what, unit, value, limit, "≥" if least else "≤", over=over, decides=not least)
    return out


def _figures(results: Results) -> Figures:
    runs = list(whole(results).values())
    judged = targets(runs)
    return {
        "met": all(run["completed"] for run in runs) and all(t.met for t in judged.values() if t.decides),
        "law": runs[0]["law"],
        "targets": {name: {"value": t.value, "limit": t.limit, "met": t.met} for name, t in judged.items()},
        "runs": runs,
    }


def _targets(found: Figures) -> list[Target]:
    done = [run["completed"] for run in found["runs"]]
    return [Target("welds completed", "", sum(done), len(done), "≥"), *targets(found["runs"]).values()]


def _others(found: Figures) -> Iterable[Table]:
    broken = [(r["scenario"], str(r["seed"]), r["reason"]) for r in found["runs"] if not r["completed"]]
    header = ("", *(f"{run['scenario'].removesuffix('_groove')}\nseed {run['seed']}" for run in found["runs"]))
    lines = [(title, *(fixed(run[name], k) for run in found["runs"])) for title, name, k in FIGURES]
    return (f"Law: {found['law']}", header, lines), ("Not completed", ("scenario", "seed", "reason"), broken)


STUDY = Study(
    name="cell",
    what="The weld in the whole simulated cell, with contact and rendered tag, against the truth.",
    case=weld_once,
    figures=_figures,
    header=(),
    rows=lambda found: (),
    others=_others,
    targets=_targets,
    group="reproduce",
)


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
    names = [name.strip() for name in scenarios.split(",") if name.strip()]
    start = time.monotonic()
    found = STUDY.outcome(call, cases(names, range(call.seed, call.seed + seeds), seam_mm, law))
    more = {"wall_seconds": time.monotonic() - start, "written_to": call.written}
    return replace(found, summary={**found.summary, **more})
