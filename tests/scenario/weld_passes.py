"""Weld an S, a pipe and a T with the arm's and the part's errors: three passes, or over tacks; print the torch's error.

python -m tests.scenario.weld_passes [S pipe T] [--seed N] [--tacks]
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import PassOrder, Scenario, TackOrder
from weldcal.tools.commands.weld import known_camera, run_scenario
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.run import RunOptions
from weldcal.tools.worlds.parts.cells import PartTrial, write_cell
from weldcal.tools.worlds.parts.step_parts import PARTS

PASSES = [
    PassOrder(lateral_mm=-2.0, vertical_mm=3.0),
    PassOrder(lateral_mm=2.0, vertical_mm=3.0, angle_deg=4.0, reverse=True),
]
CELLS = {"S": "", "pipe": "pipe_on_plate", "T": "straight_web"}


TACKS = {"S": (45, 57, 110, 125, 170, 182, 235, 250), "pipe": (40, 52, 95, 110), "T": (40, 52, 90, 105, 140, 152)}
HEIGHTS_MM = {"S": (6.0, 8.0, 7.0, 6.5), "pipe": (3.0, 6.0), "T": (3.0, 6.0, 4.5)}
"""Over the root: they lift the ball by 2 to 5 mm."""
NEAR_M = 0.03  # of a tack: the tip is lifted there, or comes down


def scenario_of(name: str, folder: Path, tacks: bool) -> Scenario:
    """The shipped S with its live calibration, or a made part with the scanner's pose known; with tacks all are so."""
    trial = PartTrial()
    if CELLS[name]:
        scenario = trial.scenario(write_cell(PARTS[CELLS[name]](), folder, trial))
    elif tacks:
        scenario = known_camera("s_groove")
    else:
        scenario = load_scenario("s_groove")
    scenario.welding.speed_mm_s = 8.0 if tacks else 16.0
    scenario.job.maximum_time_s = 600.0
    if tacks:
        ends = zip(TACKS[name][::2], TACKS[name][1::2], HEIGHTS_MM[name], strict=True)
        scenario.welding.tacks = [TackOrder(from_mm=a, to_mm=b, height_mm=h) for a, b, h in ends]
    else:
        scenario.welding.passes = PASSES
    return scenario


def weld(name: str, seed: int, out: Path, tacks: bool) -> DemoResult:
    """The result of a run."""
    options = RunOptions(scenario=name, out=out / name, seed=seed, recording=False)
    return run_scenario(scenario_of(name, out / "cell", tacks), options)


def over_tacks(name: str, result: DemoResult) -> list[float]:
    """Largest distance of the torch from the true seam about each tack, mm; infinite where the arc did not burn."""
    found = []
    for a, b in zip(TACKS[name][::2], TACKS[name][1::2], strict=True):
        off = None if result.weld is None else result.weld.error
        near = np.empty(0) if off is None else off.distance_m[(off.s > 1e-3 * a - NEAR_M) & (off.s < 1e-3 * b + NEAR_M)]
        found.append(1e3 * float(np.max(near)) if len(near) else math.inf)
    return found


def main() -> None:
    """Print a line per pass or tack."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(CELLS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tacks", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.names:
            result = weld(name, arguments.seed, Path(folder), arguments.tacks)
            found: Any = result.summary()
            print(f"{name}, seed {arguments.seed}: {found['state']} {found.get('reason') or ''}", flush=True)
            if arguments.tacks:
                print(
                    "  torch off the seam about each tack, mm at most:",
                    np.round(over_tacks(name, result), 3),
                    flush=True,
                )
            for row in found.get("passes", ()):
                print(
                    f"  pass {row['pass']}: {row['lateral_mm']:+.1f}, {row['vertical_mm']:+.1f} mm"
                    f" {'backwards' if row['reverse'] else 'forwards'}: torch off its ordered path by"
                    f" {row['torch_mean_mm']:.3f} mm in the mean, {row['torch_max_mm']:.3f} mm at most",
                    flush=True,
                )


if __name__ == "__main__":
    main()
