"""Runs the whole simulated cell: the demo over seeds and on every arm, and the weld against the truth."""

from collections.abc import Iterable, Mapping

import numpy as np

from tests.figures.harness import Run, figure
from tests.worlds.scaled_arms import ARMS, arm_scenario
from tests.worlds.weld.case import figures
from weldcal.models.errors import WeldcalError
from weldcal.systems.cell import build_cell
from weldcal.systems.runner import run_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.weld import known_camera, measure, run_scenario
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.render import fixed, write_atomic
from weldcal.tools.report.run import RunOptions

WELD_FIGURES = {
    "seam points, sd mm": ("point_sd_mm", 4),
    "seam points, offset mm": ("point_offset_mm", 4),
    "their height, sd mm": ("height_sd_mm", 3),
    "their height, offset mm": ("height_offset_mm", 3),
    "torch, mean mm": ("torch_mean_mm", 3),
    "torch, largest mm": ("torch_max_mm", 3),
    "in space, largest mm": ("space_max_mm", 3),
    "torch speed CV %": ("cv_percent", 2),
    "real-time factor of the weld": ("real_time_factor", 2),
}


@figure("cell", "the weld in the whole simulated cell, with contact and rendered tag, against the truth")
def cell(run: Run) -> None:
    """Weld with a camera whose pose is known exactly: seam points, torch and real-time factor."""
    welds = []
    for name in run.size(("s_groove",), ("s_groove", "l_groove")):
        for seed in run.seeds(1, 3):
            run.progress(name, 0.0)
            scenario = known_camera(name)
            scenario.welding.seam_length_mm = run.size(30.0, None)
            options = RunOptions(scenario=name, out=run.out, seed=seed, recording=False)
            welds.append(figures(measure(run_cell(build_cell(scenario, seed)), options), name, seed))
    header = ("", *(f"{weld.scenario} {weld.seed}" for weld in welds))
    run.table(
        "", header, ((what, *(fixed(getattr(w, key), k) for w in welds)) for what, (key, k) in WELD_FIGURES.items())
    )
    run.table("Not completed", ("scenario", "reason"), ((w.scenario, w.reason) for w in welds if not w.completed))


WORST = (
    *("n_scans", "X_BC_error_mm", "X_BC_error_deg", "X_BC_error_at_work_mm", "expected_error_mm"),
    *("plan_mean_mm", "plan_max_mm", "torch_mean_mm", "torch_max_mm", "torch_lateral_max_mm", "torch_speed_cv"),
    *("peak_omega", "wall_seconds"),
)


ARM_FIGURES = ("X_BC_error_mm", "plan_max_mm", "torch_mean_mm", "torch_max_mm")


def _of(rows: Iterable[Mapping[str, object]], name: str) -> list[float]:
    return [float(v) for row in rows if isinstance(v := row.get(name), int | float)]


def run_demo(options: RunOptions) -> DemoResult:
    """Run all parts of a scenario's job."""
    return run_scenario(load_scenario(options.scenario), options)


@figure("demo-seeds", "the demo over many seeds: mean and largest errors of calibration, plan and torch")
def seeds(run: Run) -> None:
    """Run the demo once a seed."""
    rows = []
    for seed in run.seeds(2, 12):
        run.progress(f"seed {seed}", 0.0)
        options = RunOptions(scenario="s_groove", out=run.out / f"seed{seed:02d}", seed=seed, recording=False)
        rows.append(run_demo(options).summary())
    run.say(f"{sum(row['state'] == 'done' for row in rows)} of {len(rows)} runs done\n")
    found = {name: values for name in WORST if (values := _of(rows, name))}
    run.table(
        "",
        ("figure", "mean", "largest"),
        ((n, fixed(float(np.mean(v)), 4), fixed(max(v), 4)) for n, v in found.items()),
    )


@figure("demo-arms", "the demo, scaled to the reach, on each arm of Universal Robots; the scenarios are written too")
def arms(run: Run) -> None:
    """Write each arm's scenario into its own folder and run the demo there."""
    rows = []
    for arm in run.size(("ur5e",), tuple(ARMS)):
        run.progress(arm, 0.0)
        path = run.out / arm / f"{arm}.yaml"
        write_atomic(path, arm_scenario(arm, run.size(30.0, 60.0)))
        try:
            found = run_demo(RunOptions(scenario=str(path), out=path.parent, seed=run.seed, recording=False)).summary()
        except WeldcalError as error:
            found = {"state": "refused", "reason": str(error)}
        numbers = (float(str(found.get(key, "nan"))) for key in ARM_FIGURES)
        reason = "" if found["state"] == "done" else str(found.get("reason", ""))
        rows.append((arm, str(found["state"]), reason, str(found.get("n_scans", "-")), *(fixed(v, 3) for v in numbers)))
    run.table("", ("arm", "state", "reason", "scans", "X_BC mm", "plan max", "torch mean", "torch max"), rows)
