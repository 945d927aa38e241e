"""Runs the demo over many seeds: how many runs end done, and the worst errors of calibration and torch."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from weldcal.tools.commands.demo import run_demo
from weldcal.tools.farm.journal import Result
from weldcal.tools.farm.run import Farm
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.render import write_atomic

COLUMNS = (
    "seed", "state", "n_scans", "X_BC_error_mm", "X_BC_error_deg", "X_BC_error_at_work_mm", "expected_error_mm",
    "plan_mean_mm", "plan_max_mm", "torch_mean_mm", "torch_max_mm", "torch_lateral_max_mm", "torch_speed_cv", "peak_omega",
    "wall_seconds", "reason",
)  # fmt: skip


def run_seed(scenario: str, folder: str, seed: int) -> Mapping[str, object]:
    """One demo in its own folder, without a recording; its JSON object."""
    return run_demo(RunOptions(scenario=scenario, out=Path(folder), seed=seed, recording=False)).summary()


def run_seeds(scenario: str, farm: Farm, seeds: range) -> dict[str, object]:
    """Run the demo once per seed, each into its own folder without a recording; seeds.csv grows row by row.

    Worst and mean figures over the seeds, in the units of the demo's own JSON object.
    """
    folder = farm.folder.absolute()

    def table(found: dict[str, Result]) -> None:
        rows = ({"seed": int(name.split()[-1]), **row} for name, row in found.items())
        text = csv_text(COLUMNS, ([row.get(name, "") for name in COLUMNS] for row in rows))
        write_atomic(folder / "seeds.csv", text)

    tasks = {
        f"seed {seed}": {"scenario": scenario, "folder": str(folder / f"seed{seed:02d}"), "seed": seed}
        for seed in seeds
    }
    rows = list(farm.run(run_seed, tasks, table).values())
    worst = {
        f"worst_{name}": float(
            np.max([row[name] for row in rows if isinstance(row.get(name), int | float)], initial=0.0)
        )
        for name in COLUMNS[2:-1]
    }
    done = sum(row["state"] == "done" for row in rows)
    return {"state": "done" if done == len(rows) else "held", "runs": len(rows), "runs_done": done, **worst}
