"""Runs the demo over many seeds: how many runs end done, and the worst errors of calibration and torch."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.commands.demo import run_demo
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.render import write_atomic

COLUMNS = (
    "seed", "state", "n_scans", "X_BC_error_mm", "X_BC_error_deg", "X_BC_error_at_work_mm", "expected_error_mm",
    "plan_mean_mm", "plan_max_mm", "torch_mean_mm", "torch_max_mm", "torch_lateral_max_mm", "torch_speed_cv", "peak_omega",
    "wall_seconds", "reason",
)  # fmt: skip


def run_seeds(scenario: str, out: Path, seeds: range, progress: Progress = no_progress) -> dict[str, object]:
    """Run the demo once per seed, each into its own folder without a recording; seeds.csv grows row by row.

    Worst and mean figures over the seeds, in the units of the demo's own JSON object.
    """
    rows: list[dict[str, object]] = []
    for k, seed in enumerate(seeds):
        folder = out / f"seed{seed:02d}"
        options = replace(RunOptions(scenario, folder, seed), recording=False)
        rows.append(run_demo(options, lambda stage, share, k=k: progress(stage, (k + share) / len(seeds))).summary())  # type: ignore[misc]
        write_atomic(out / "seeds.csv", csv_text(COLUMNS, ([row.get(name, "") for name in COLUMNS] for row in rows)))
    worst = {
        f"worst_{name}": float(np.max([float(row[name]) for row in rows if name in row], initial=0.0))  # type: ignore[arg-type]
        for name in COLUMNS[2:-1]
    }
    done = sum(row["state"] == "done" for row in rows)
    return {"state": "done" if done == len(rows) else "held", "runs": len(rows), "runs_done": done, **worst}
