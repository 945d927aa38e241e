"""Weld three passes on an S, a pipe and a T with the arm's and the part's errors, and print each pass's torch error.

python -m tests.scenario.weld_passes [S pipe T] [--seed N]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import PassOrder, Scenario
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.run import RunOptions
from weldcal.tools.worlds.parts.cells import PartTrial, write_cell
from weldcal.tools.worlds.parts.step_parts import PARTS

PASSES = [
    PassOrder(lateral_mm=-2.0, vertical_mm=3.0),
    PassOrder(lateral_mm=2.0, vertical_mm=3.0, angle_deg=4.0, reverse=True),
]
CELLS = {"S": "", "pipe": "pipe_on_plate", "T": "straight_web"}


def scenario_of(name: str, folder: Path) -> Scenario:
    """The shipped S with its live calibration, or a made part with the scanner's pose known."""
    trial = PartTrial()
    scenario = (
        load_scenario("s_groove")
        if not CELLS[name]
        else trial.scenario(write_cell(PARTS[CELLS[name]](), folder, trial))
    )
    scenario.welding.speed_mm_s = 16.0
    scenario.welding.passes = PASSES
    scenario.job.maximum_time_s = 600.0
    return scenario


def weld(name: str, seed: int, out: Path) -> dict[str, Any]:
    """The summary of a run."""
    options = RunOptions(scenario=name, out=out / name, seed=seed, recording=False)
    return dict(run_scenario(scenario_of(name, out / "cell"), options).summary())


def main() -> None:
    """Print a line per pass."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(CELLS))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.names:
            found = weld(name, arguments.seed, Path(folder))
            print(f"{name}: {found['state']} {found.get('reason') or ''}", flush=True)
            for row in found.get("passes", ()):
                print(
                    f"  pass {row['pass']}: {row['lateral_mm']:+.1f}, {row['vertical_mm']:+.1f} mm"
                    f" {'backwards' if row['reverse'] else 'forwards'}: torch off its ordered path by"
                    f" {row['torch_mean_mm']:.3f} mm in the mean, {row['torch_max_mm']:.3f} mm at most",
                    flush=True,
                )


if __name__ == "__main__":
    main()
