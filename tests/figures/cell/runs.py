"""Runs the whole simulated cell: its speed, the weld over seeds against the truth, and every arm at its own scale."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from tests.figures.cell.replays import recording, replays
from tests.figures.harness import Cases, Figures, Measured, Results, Row, Study, Table, Target, whole
from tests.figures.subject import one_of
from tests.worlds.scaled_arms import ARMS, arm_scenario
from tests.worlds.weld.case import figures
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.robots import get_robot
from weldcal.systems.cell import build_cell
from weldcal.systems.runner import Progress, no_progress, run_cell
from weldcal.systems.scenario.loading import load_scenario, scenario_names
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.commands.weld import known_camera, measure, run_demo, run_scenario
from weldcal.tools.farm.run import Farm
from weldcal.tools.report.render import fixed, write_atomic
from weldcal.tools.report.run import RunOptions

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
)


def cases(scenarios: Iterable[str], seeds: range, seam_mm: float | None = None) -> Cases:
    """Return every scenario with every seed.

    Raises:
        InputError: no such scenario.
    """
    unknown = [name for name in scenarios if name not in scenario_names() and not Path(name).is_file()]
    if unknown:
        raise InputError(f"There is no scenario '{unknown[0]}': choose some of {', '.join(scenario_names())}.")
    return {f"{name} {seed}": {"name": name, "seed": seed, "seam_mm": seam_mm} for name in scenarios for seed in seeds}


def weld_once(name: str, seed: int, seam_mm: float | None) -> Mapping[str, object]:
    """One weld of a scenario whose camera pose is known exactly, ``seam_mm`` of the seam (None: all of it)."""
    scenario: Scenario = known_camera(name)
    scenario.welding.seam_length_mm = seam_mm
    run = run_cell(build_cell(scenario, seed))
    result = measure(run, RunOptions(scenario=name, out=Path(), seed=seed, recording=False))
    return vars(figures(result, name, seed))


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
    return ("Welds", header, lines), ("Not completed", ("scenario", "seed", "reason"), broken)


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
def reproduce_cell(
    call: Call,
    seeds: Annotated[int, option("--seeds", "N", "Number of seeds of each scenario.", min=1)] = 3,
    scenarios: Annotated[str, option("--scenarios", "NAMES", "Scenarios, separated by commas.")] = "s_groove,l_groove",
    seam_mm: Annotated[
        float | None, option("--seam-mm", "MM", "Weld only this length; default: all.", min=10.0)
    ] = None,
) -> Outcome:
    """Weld in the whole simulated cell, with contact and rendered tag: seam points, torch and real-time factor."""
    names = [name.strip() for name in scenarios.split(",") if name.strip()]
    start = time.monotonic()
    found = STUDY.outcome(call, cases(names, range(call.seed, call.seed + seeds), seam_mm))
    more = {"wall_seconds": time.monotonic() - start, "written_to": call.written}
    return replace(found, summary={**found.summary, **more})


SEAM_MM = 100.0


def run_cell_benchmark(out: Path, seed: int = 0, progress: Progress = no_progress) -> dict[str, object]:
    """Run the demo's cell on a short seam without recording; real-time factors per phase (simulated per wall seconds).

    `welding` includes contact, rendering and detection at the finger camera's rate; `share_*` are wall seconds.
    """
    scenario = load_scenario("s_groove")
    scenario.welding.seam_length_mm = SEAM_MM
    result = run_scenario(scenario, RunOptions(scenario="s_groove", out=out, seed=seed, recording=False), progress)
    run, camera = result.run, scenario.finger_camera
    pixels = f"{getattr(camera, 'width', 0)} x {getattr(camera, 'height', 0)}"
    return {
        "state": result.state,
        "real_time_factor": run.real_time_factor(),
        "real_time_factor_welding": run.real_time_factor("weld"),
        "real_time_factor_moving": run.real_time_factor("move_to_pose"),
        "seconds_per_scan": _mean_wall(run.phases, "scan_pose"),
        "finger_camera": f"{pixels} at {getattr(camera, 'rate_hz', 0):.0f} Hz",
        "simulated_seconds": float(run.root.get_time()),
        "wall_seconds": run.wall_seconds,
    }


def _mean_wall(phases: list[tuple[str, float, float]], name: str) -> float:
    spans = [b[2] - a[2] for a, b in pairwise(phases) if a[0] == name]
    return sum(spans) / max(len(spans), 1)


WORST = (
    "n_scans",
    "X_BC_error_mm",
    "X_BC_error_deg",
    "X_BC_error_at_work_mm",
    "expected_error_mm",
    "plan_mean_mm",
    "plan_max_mm",
    "torch_mean_mm",
    "torch_max_mm",
    "torch_lateral_max_mm",
    "torch_speed_cv",
    "peak_omega",
    "wall_seconds",
)


def run_seed(scenario: str, folder: str, seed: int) -> Mapping[str, object]:
    """Run one demo in its own folder, without a recording; its JSON object."""
    return run_demo(RunOptions(scenario=scenario, out=Path(folder), seed=seed, recording=False)).summary()


def _worst(rows: Iterable[Mapping[str, object]], names: Iterable[str]) -> dict[str, float]:
    """The largest of each figure over the runs that have it, 0 for none."""
    rows = list(rows)
    return {
        f"worst_{name}": float(np.max([v for row in rows if isinstance(v := row.get(name), int | float)], initial=0.0))
        for name in names
    }


def _seeds(found: Results) -> Figures:
    done = sum(row["state"] == "done" for row in found.values())
    state = "done" if done == len(found) else "held"
    return {"state": state, "runs": len(found), "runs_done": done, **_worst(found.values(), WORST)}


SEEDS = Study(
    name="seeds",
    what="The demo over many seeds: completed runs, and the largest errors of calibration and torch.",
    case=run_seed,
    figures=_seeds,
    header=("figure", "value"),
    rows=lambda figures: [(name, str(v) if isinstance(v, int | str) else fixed(v, 4)) for name, v in figures.items()],
    numbers=1,
)


def seed_cases(scenario: str, folder: Path, seeds: Iterable[int]) -> Cases:
    """One demo a seed, each in a folder of its own."""
    return {
        f"seed {seed}": {"scenario": scenario, "folder": str(folder.absolute() / f"seed{seed:02d}"), "seed": seed}
        for seed in seeds
    }


COLUMNS = (
    "arm",
    "state",
    "n_scans",
    "X_BC_error_mm",
    "X_BC_error_deg",
    "X_BC_error_at_work_mm",
    "plan_mean_mm",
    "plan_max_mm",
    "torch_mean_mm",
    "torch_max_mm",
    "reason",
)


def run_arm(arm: str, folder: str, seed: int, seam_mm: float, robot: str | None) -> Mapping[str, object]:
    """Write an arm's scenario into its folder and run the demo there; its row of COLUMNS."""
    scenario = Path(folder) / f"{arm}.yaml"
    write_atomic(scenario, arm_scenario(arm, seam_mm))
    options = RunOptions(scenario=str(scenario), out=Path(folder), seed=seed, recording=False, robot=robot)
    try:
        found = run_demo(options).summary()
    except WeldcalError as error:
        found = {"state": "refused", "reason": str(error)}
    return {name: found[name] for name in COLUMNS if name in found} | {"arm": arm}


def _arms(found: Results) -> Figures:
    rows = list(found.values())
    done = [row for row in rows if row["state"] == "done"]
    return {
        "state": "done" if len(done) == len(rows) else "held",
        "arms": len(rows),
        "arms_done": len(done),
        **_worst(done, ("X_BC_error_mm", "torch_mean_mm", "torch_max_mm")),
        "per_arm": rows,
    }


def _arm_rows(figures: Figures) -> Iterable[Row]:
    for row in figures["per_arm"]:
        numbers = (row.get(name) for name in ("X_BC_error_mm", "plan_max_mm", "torch_mean_mm", "torch_max_mm"))
        reason = "" if row["state"] == "done" else row.get("reason", "")
        yield row.get("arm", ""), row["state"], reason, str(row.get("n_scans", "-")), *(fixed(v, 3) for v in numbers)


ARM_DEMOS = Study(
    name="arms",
    what="The demo, scaled to the reach, on each arm of Universal Robots.",
    case=run_arm,
    figures=_arms,
    header=("arm", "state", "reason", "scans", "X_BC mm", "plan max", "torch mean", "torch max"),
    rows=_arm_rows,
    numbers=5,
)


def run_arms(farm: Farm, arms: Iterable[str], seed: int, seam_mm: float, robot: str | None) -> Measured:
    """Write each arm's scenario into its own folder and run the demo there, ``seam_mm`` of the seam."""
    given = {"seed": seed, "seam_mm": seam_mm, "robot": robot}
    folder = farm.folder.absolute()
    return ARM_DEMOS.run(farm, {arm: {"arm": arm, "folder": str(folder / arm), **given} for arm in arms})


@command("benchmark cell-speed", short_help="Measure the real-time factor of the cell while welding.", hidden=True)
def speed(call: Call) -> Mapping[str, object]:
    """Measure the real-time factor of the whole cell while welding, finger camera included."""
    return run_cell_benchmark(call.folder("benchmark", "cell"), call.seed, call.progress)


@command("benchmark seeds", short_help="Run the demo over many seeds.", hidden=True, options=FARM)
def seeds(
    call: Call,
    scenario: Annotated[
        str, option("--scenario", "NAME", "Name of a scenario, or path of a scenario YAML file.")
    ] = "s_groove",
    runs: Annotated[int, option("--runs", "N", "Number of seeds.", min=1)] = 11,
) -> Outcome:
    """Run the demo over many seeds: completed runs, and the largest errors of calibration and torch."""
    folder = call.folder("benchmark", f"seeds-{scenario}")
    found = SEEDS.run(
        Farm.of(folder, call.given, call.progress), seed_cases(scenario, folder, range(call.seed, call.seed + runs))
    )
    return Outcome(found.figures, text=found.show)


@command("benchmark arms", short_help="Run the demo on six UR arms, scaled to their reach.", hidden=True, options=FARM)
def arms(
    call: Call,
    names: Annotated[list[str] | None, option("--arm", "NAME", "Only this arm; repeat for more.")] = None,
    seam: Annotated[float, option("--seam", "MM", "How much of the seam is welded.", min=20.0)] = 80.0,
    robot: Annotated[
        str | None, option("--robot", "WHERE", "simulated, or emulated: a controller on this computer.")
    ] = None,
) -> Outcome:
    """Run the demo, scaled to the reach, on UR3e, UR5e, UR10e, UR16e, UR20 and UR30; the scenarios are written too."""
    chosen = [get_robot(name).name for name in names] if names else list(ARMS)
    found = run_arms(
        Farm.of(call.folder("benchmark", "arms"), call.given, call.progress), chosen, call.seed, seam, robot
    )
    return Outcome(found.figures, text=found.show)


@command("benchmark cell", short_help="Measure the whole simulated cell.", options=FARM)
@one_of("speed", speed=speed, seeds=seeds, arms=arms, replay=replays, recording=recording)
def cell(call: Call) -> None:
    """Measure the whole simulated cell: speed, errors over seeds and arms, replays, and the cost of a recording."""
