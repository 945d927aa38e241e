"""Weld an S, a pipe and a T with the arm's and the part's errors: passes, tacks or angles; print the torch's error.

python -m tests.scenario.weld_passes [S pipe T] [--seed N] [--tacks | --angles | --proposed]

--proposed: the passes that plan-passes prints for a wire feed, instead of those below.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from typer.testing import CliRunner

from tests.worlds.parts.cells import PartTrial, write_cell
from tests.worlds.parts.step_parts import PARTS
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import AnglesOrder, PassOrder, Scenario, TackOrder
from weldcal.tools.cli.app import app
from weldcal.tools.commands.weld import known_camera, run_scenario
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.run import RunOptions

PASSES = [
    PassOrder(lateral_mm=-2.0, vertical_mm=3.0),
    PassOrder(lateral_mm=2.0, vertical_mm=3.0, angle_deg=4.0, reverse=True),
]
CELLS = {"S": "", "pipe": "pipe_on_plate", "T": "straight_web"}


TACKS = {"S": (45, 57, 110, 125, 170, 182, 235, 250), "pipe": (40, 52, 95, 110), "T": (40, 52, 90, 105, 140, 152)}
HEIGHTS_MM = {"S": (6.0, 8.0, 7.0, 6.5), "pipe": (3.0, 6.0), "T": (3.0, 6.0, 4.5)}
"""Over the root: they lift the ball by 2 to 5 mm."""
NEAR_M = 0.03  # of a tack: the tip is lifted there, or comes down


ANGLES = {
    "S": AnglesOrder(work_angle_deg=[-4.0, 4.0], travel_angle_deg=[-2.0, 1.0]),
    "T": AnglesOrder(work_angle_deg=[4.0, -4.0], wire_rotation_deg=1.0, stick_out_mm=11.0),
}
PROPOSED = {"S": ["6", "--widest-mm", "4"], "T": ["9", "--depth-mm", "9", "--widest-mm", "9"]}
"""Wire feed m/min, and what fills the joint in layers of several beads."""


def scenario_of(name: str, folder: Path, tacks: bool, proposed: bool = False) -> Scenario:
    """The shipped S with its live calibration, or a made part with the scanner's pose known; with tacks all are so."""
    trial, file = PartTrial(), "s_groove"
    if CELLS[name]:
        file = str(write_cell(PARTS[CELLS[name]](), folder, trial))
        scenario = trial.scenario(Path(file))
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
    if proposed:
        lines = CliRunner().invoke(app, ["plan-passes", file, "--wire-feed-m-min", *PROPOSED[name]]).output
        scenario.welding.passes = load_scenario(file, lines).welding.passes
        scenario.welding.speed_mm_s = 8.0
    return scenario


def weld(name: str, seed: int, out: Path, ordered: argparse.Namespace) -> DemoResult:
    """The result of a run."""
    options = RunOptions(scenario=name, out=out / name, seed=seed, recording=False)
    scenario = scenario_of(name, out / "cell", ordered.tacks, ordered.proposed)
    if ordered.angles:
        scenario.welding.angles, scenario.welding.passes = ANGLES[name], []
    return run_scenario(scenario, options)


def off_angles(name: str, result: DemoResult) -> list[float]:
    """Largest errors of work angle, travel angle and rotation, deg, of the true arm in the true seam's frame."""
    station, weld = result.run.cell.station, result.weld
    assert weld is not None
    assert weld.true_seam is not None
    assert station.truth.arm is not None
    assert station.tool is not None
    seam, order, found = weld.true_seam, ANGLES[name], []
    q = np.deg2rad(result.run.cell.scenario.home_deg)
    for k in np.flatnonzero(weld.log.torch_on)[::20]:
        X_BF = RigidTransform(RotationMatrix(weld.log.R_BT[k]), weld.log.p_BRobot[k]) @ station.tool.X_FT.inverse()
        near = nearest_solution(station.robot.arm, X_BF, q)
        assert near is not None
        q = near
        X_BT = forward_kinematics(station.truth.arm, q) @ station.tool.X_FT
        towards, wire = -X_BT.rotation().matrix()[:, 2], weld.log.p_BTorch[k]
        s = float(seam.project(wire))
        t, n, up = seam.tangent(s), seam.normal(s), seam.up(s)
        foot = seam.position(float(seam.project(X_BT.translation()))) - wire
        tip = X_BT.translation() - wire
        foot, tip = (v - (v @ towards) * towards for v in (foot, tip))
        turn = np.cross(tip, foot) @ towards / np.linalg.norm(foot) / np.linalg.norm(tip)
        angles = [math.atan2(towards @ n, -towards @ up), math.asin(towards @ t), math.asin(turn)]
        ordered = [order.ends_rad(f"{key}_deg") for key in ("work_angle", "travel_angle", "wire_rotation")]
        share = s / (weld.planned or seam).length
        found.append(
            [
                math.nan if e is None else a - np.interp(share, [0.0, 1.0], e)
                for a, e in zip(angles, ordered, strict=True)
            ]
        )
    return [float(v) for v in np.degrees(np.abs(found)).max(axis=0)]


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
    for mode in ("--tacks", "--angles", "--proposed"):
        parser.add_argument(mode, action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.names:
            result = weld(name, arguments.seed, Path(folder), arguments)
            found: Any = result.summary()
            print(f"{name}, seed {arguments.seed}: {found['state']} {found.get('reason') or ''}", flush=True)
            if arguments.tacks:
                print(
                    "  torch off the seam about each tack, mm at most:",
                    np.round(over_tacks(name, result), 3),
                    flush=True,
                )
            if arguments.angles and result.weld is not None:
                off = None if result.weld.error is None else 1e3 * result.weld.error.distance_m.max()
                print(
                    "  torch off, mm at most:",
                    off,
                    "work, travel, rotation off, deg:",
                    np.round(off_angles(name, result), 2),
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
