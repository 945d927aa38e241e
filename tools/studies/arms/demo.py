"""Runs the scaled demo on each arm and tabulates the errors of calibration and torch."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from weldcal.models.errors import WeldcalError
from weldcal.tools.commands.demo import run_demo
from weldcal.tools.farm.journal import Result
from weldcal.tools.farm.run import Farm
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.arms.scaled import arm_scenario

ARMS = ("ur3e", "ur5e", "ur10e", "ur16e", "ur20", "ur30")
COLUMNS = (
    "arm", "state", "n_scans", "X_BC_error_mm", "X_BC_error_deg", "X_BC_error_at_work_mm", "plan_mean_mm", "plan_max_mm",
    "torch_mean_mm", "torch_max_mm", "reason",
)  # fmt: skip


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


def run_arms(
    farm: Farm, arms: Sequence[str], seed: int, seam_mm: float, robot: str | None
) -> tuple[dict[str, object], list[dict[str, object]]]:
    """Write each arm's scenario into its own folder and run the demo there; arms.csv grows row by row.

    Args:
        farm: where the demos run and their results go.
        arms: names of arms.
        seed: of everything random.
        seam_mm: how much of the seam is welded.
        robot: as the demo's --robot; None: simulated.

    Returns:
        Summary with the worst torch error, and a row for each arm in the units of the demo's JSON object.
    """
    folder = farm.folder.absolute()

    def table(found: dict[str, Result]) -> None:
        text = csv_text(COLUMNS, ([row.get(name, "") for name in COLUMNS] for row in found.values()))
        write_atomic(folder / "arms.csv", text)

    given = {"seed": seed, "seam_mm": seam_mm, "robot": robot}
    tasks = {arm: {"arm": arm, "folder": str(folder / arm), **given} for arm in arms}
    rows = list(farm.run(run_arm, tasks, table).values())
    done = [row for row in rows if row["state"] == "done"]
    worst = {
        f"worst_{name}": float(np.max([float(str(row[name])) for row in done], initial=0.0))
        for name in ("X_BC_error_mm", "torch_mean_mm", "torch_max_mm")
    }
    return {
        "state": "done" if len(done) == len(rows) else "held",
        "arms": len(rows),
        "arms_done": len(done),
        **worst,
    }, rows


def arms_table(rows: Sequence[dict[str, object]]) -> str:
    """The rows as aligned text, mm."""
    lines = [
        f"{'arm':6}  {'state':8}  {'scans':>5}  {'X_BC mm':>8}  {'plan max':>8}  {'torch mean':>10}  {'torch max':>9}"
    ]
    for row in rows:
        numbers = [row.get(name) for name in ("X_BC_error_mm", "plan_max_mm", "torch_mean_mm", "torch_max_mm")]
        shown = [f"{float(str(v)):.3f}" if v is not None else "-" for v in numbers]
        lines.append(
            f"{row['arm']:6}  {row['state']:8}  {row.get('n_scans', '-'):>5}  {shown[0]:>8}  {shown[1]:>8}  {shown[2]:>10}  "
            f"{shown[3]:>9}  {row.get('reason', '') if row['state'] != 'done' else ''}".rstrip()
        )
    return "\n".join(lines)
