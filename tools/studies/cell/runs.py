"""Runs the demo's cell for its speed, over many seeds, and on every arm scaled to the arm's reach."""

from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np

from weldcal.models.errors import WeldcalError
from weldcal.models.robots import get_robot
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.cli.subject import one_of
from weldcal.tools.commands.weld import run_demo, run_scenario
from weldcal.tools.farm.run import Farm
from weldcal.tools.report.render import fixed, write_atomic
from weldcal.tools.report.run import RunOptions
from weldcal.tools.studies.cell.replays import recording, replays
from weldcal.tools.studies.harness import Cases, Figures, Measured, Results, Row, Study
from weldcal.tools.worlds.scaled_arms import ARMS, arm_scenario

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
