"""Welds the made parts in the simulated cell, each from its STEP file and its seam's CSV, and scores the torch."""

from tests.figures.harness import Run, figure
from tests.worlds.parts.cells import PartTrial, write_cell
from tests.worlds.parts.step_parts import PARTS
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.render import fixed
from weldcal.tools.report.run import RunOptions

COLUMNS = (
    *("torch_mean_mm", "torch_max_mm", "torch_first_max_mm", "torch_last_max_mm"),
    *("plan_mean_mm", "plan_max_mm", "welded_mm", "plan_arm_sigma_mm", "plan_arm_turn_deg"),
)


@figure("part-welds", "how far torch and plan are from the true seams of twelve bowed STEP parts")
def part_welds(run: Run) -> None:
    """Weld each part once (in the quick form one part, 30 mm of its seam)."""
    trial, rows = PartTrial.of("scan", run.size(30.0, None)), []
    for name in run.size(("straight_web",), tuple(PARTS)):
        run.progress(name, 0.0)
        part = PARTS[name]()
        cell = write_cell(part, run.out / name, trial)
        options = RunOptions(scenario=str(cell), out=run.out / name / "weld", seed=run.seed, recording=False)
        result = run_scenario(trial.scenario(cell), options, run.progress)
        result.run.raise_if_interrupted()
        found = result.summary()
        numbers = (fixed(float(str(found.get(key, "nan"))), 3) for key in COLUMNS)
        rows.append((name, part.joint, str(found["state"]), *numbers, str(found.get("reason") or "")))
    run.table("", ("part", "joint", "state", *COLUMNS, "reason"), rows)
