"""Runs the scaled demo on each arm and tabulates the errors of calibration and torch."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from weldcal.models.errors import WeldcalError
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.commands.demo import run_demo
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.arms.scaled import arm_scenario

ARMS = ("ur3e", "ur5e", "ur10e", "ur16e", "ur20", "ur30")
COLUMNS = (
    "arm", "state", "n_scans", "X_BC_error_mm", "X_BC_error_deg", "X_BC_error_at_work_mm", "plan_mean_mm", "plan_max_mm",
    "torch_mean_mm", "torch_max_mm", "reason",
)  # fmt: skip


def run_arms(
    out: Path, arms: Sequence[str], seed: int, seam_mm: float, robot: str | None, progress: Progress = no_progress
) -> tuple[dict[str, object], list[dict[str, object]]]:
    """Write each arm's scenario into its own folder and run the demo there; arms.csv grows row by row.

    Args:
        out: folder of the results.
        arms: names of arms.
        seed: of everything random.
        seam_mm: how much of the seam is welded.
        robot: as the demo's --robot; None: simulated.
        progress: told the arm and the share done.

    Returns:
        Summary with the worst torch error, and a row for each arm in the units of the demo's JSON object.
    """
    rows: list[dict[str, object]] = []
    for k, arm in enumerate(arms):
        folder = out / arm
        scenario = folder / f"{arm}.yaml"
        write_atomic(scenario, arm_scenario(arm, seam_mm))
        options = RunOptions(str(scenario), folder, seed, recording=False, robot=robot)

        def tell(stage: str, share: float, arm: str = arm, k: int = k) -> None:
            progress(f"{arm}: {stage}", (k + share) / len(arms))

        try:
            found = run_demo(options, tell).summary()
        except WeldcalError as error:
            found = {"state": "refused", "reason": str(error)}
        rows.append({name: found[name] for name in COLUMNS if name in found} | {"arm": arm})
        write_atomic(out / "arms.csv", csv_text(COLUMNS, ([row.get(name, "") for name in COLUMNS] for row in rows)))
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
