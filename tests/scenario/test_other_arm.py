"""Another arm that hangs from the ceiling, with a tool of its own: it welds as the demo's does.

Every arm's scaled demo loads.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.worlds.scaled_arms import ARMS, arm_scenario
from weldcal.calibration.planning.clearance import arm_bodies, lowest_point, self_distance
from weldcal.models.arms.kinematics import link_frames, load_arm
from weldcal.models.robots import get_robot
from weldcal.models.tools.loading import WELDING
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.weld import run_weld
from weldcal.tools.report.run import RunOptions

HANGING = """
arm: ur5e
tool: {file: my_tool.yaml}
base: {xyz_m: [0.0, 0.0, 0.85], rpy_deg: [180.0, 0.0, 0.0]}
robot: !SimulatedUr {repeatability_mm: 0.05, kinematic_error_mm: 0.3}
scanner: !RenderedScanner
  xyz_m: [0.8, 0.0, 0.05]
  rpy_deg: [26.259, 0.0, -90.0]
finger_camera: !RenderedFingerCamera {}
calibration:
  mounting_guess: {xyz_m: [0.8, 0.0, 0.05], rpy_deg: [26.259, 0.0, -90.0]}
workpiece:
  shape: s
  length_mm: 200.0
  pose_guess: {xyz_m: [0.425, 0.0, 0.83], rpy_deg: [180.0, 0.0, -90.0]}
  placement_error: {translation_mm: 6.0, rotation_deg: 1.5}
  groove_error: {translation_mm: 2.0, rotation_deg: 0.5}
welding: {seam_length_mm: 20.0, speed_mm_s: 16.0}
home_deg: [-5.0, -102.6, -112.8, 125.3, 90.0, 85.0]
"""


def test_a_ur5e_on_the_ceiling_welds_with_its_own_tool(tmp_path: Path) -> None:
    tool = WELDING.read_text()
    for old, new in (
        ("xyz_mm: [-60.0, 0.0, 171.5]", "xyz_mm: [-70.0, 15.0, 172.0]"),
        ("radius_mm: 2.5\n", "radius_mm: 2.2\n"),
    ):
        assert old in tool
        tool = tool.replace(old, new)
    (tmp_path / "my_tool.yaml").write_text(tool)
    (tmp_path / "cell.yaml").write_text(HANGING)
    found = run_weld(RunOptions(scenario=str(tmp_path / "cell.yaml"), out=tmp_path / "out", recording=False)).summary()
    assert found["state"] == "done", found
    torch_mean, torch_max = (float(str(found[key])) for key in ("torch_mean_mm", "torch_max_mm"))
    assert torch_mean <= 0.10
    assert torch_max <= 0.15, "the S goes on past the end: there the tip must not press on a wall"
    assert float(str(found["welded_mm"])) == pytest.approx(20.0, abs=0.5)


@pytest.mark.parametrize("name", ARMS)
def test_the_scaled_demo_of_every_arm_starts_clear(name: str, tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text(arm_scenario(name, 60.0))
    scenario = load_scenario(str(tmp_path / "cell.yaml"))
    loaded = scenario.loaded_tool()
    assert loaded is not None
    arm, home = load_arm(scenario.arm), np.deg2rad(scenario.home_deg)
    bodies, frames = arm_bodies(arm, loaded.tool.capsules()), link_frames(arm, home)
    assert lowest_point(bodies, frames) > scenario.table_height_m() + 0.02
    assert self_distance(bodies, frames) > 0.0
    part = np.array(scenario.workpiece.pose_guess.xyz_m if scenario.workpiece is not None else [0.0] * 3)
    assert np.linalg.norm(part[:2]) < 0.7 * get_robot(name).reach_m
