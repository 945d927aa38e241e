"""A scanner that the arm carries, captured by hand: found, judged, advised, and wrong acts named.

The scans are cast at the drawn arm; the scanner's true pose on it is not known to the session.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydrake.math import RigidTransform

from weldcal.calibration.capture.carried import CarriedTask
from weldcal.calibration.capture.session import ArmPose, CaptureSession
from weldcal.calibration.recorded_carried import CarriedCalibration, calibrate_carried
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError
from weldcal.systems.jobs.mounting.job import mounting_plan, mounting_scene
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.dashboard.capture_demo import DemoCell


def carried(scenario: str) -> CarriedTask:
    loaded = load_scenario(scenario)
    header, scene, circle = mounting_scene(loaded, load_arm(loaded.arm))
    return CarriedTask(header, scene, circle, mounting_plan(loaded, 0))


def off_m(cell: DemoCell, X: RigidTransform, task: CarriedTask) -> float:
    """Error at the scanner's best distance."""
    work = np.array([0.0, 0.0, task.scene.scanner.optimum_m])
    return float(np.linalg.norm(X @ work - cell.X_LC @ work))


@pytest.mark.parametrize("scenario", ["eye_in_hand", "eye_on_arm", "eye_on_arm_base"])
def test_a_session_that_follows_the_advice(tmp_path: Path, scenario: str) -> None:
    """Six captures: the scanner lies inside the stated error, what is used is that of `calibrate` to the bit, and checks agree."""
    task = carried(scenario)
    cell = DemoCell(3, task.scene)
    one = CaptureSession(tmp_path / "captures", task)
    refused = 0
    while len(one.captures) < 6:
        cell.jog("next", one.verdict().advice)
        refused += bool(one.take(cell.take(tmp_path), cell.pose()).refused)
        assert refused < 3, "a pose that was of no use is not proposed again"
    verdict = one.verdict()
    assert verdict.X is not None
    assert verdict.error_95_m is not None
    assert off_m(cell, verdict.X, task) < verdict.error_95_m < 1e-3
    result = calibrate_carried(one.folder).found.result
    assert result is not None
    assert verdict.X.IsNearlyEqualTo(result.X, 1e-5)  # the session keeps what it found about fewer scans
    one.task.save(one.folder)
    used = yaml.safe_load((tmp_path / "calibration" / "hand_eye.yaml").read_text())
    assert used["poses"][verdict.symbol]["xyz"] == result.X.translation().tolist()
    assert len(verdict.placed) == 6
    again = CaptureSession(one.folder, carried(scenario))
    assert again.verdict().X is not None, "a session that was closed goes on"
    cell.jog("next", verdict.advice or task.first_pose(cell.pose()))
    checked, error = one.check(cell.take(tmp_path), cell.pose())
    assert not checked.refused
    assert error < 2e-4
    cell.X_LC = cell.X_LC @ RigidTransform([0.003, 0.0, 0.0])
    cell.jog("next", task.first_pose(cell.pose()))
    assert one.check(cell.take(tmp_path), cell.pose())[1] == pytest.approx(3e-3, abs=4e-4), "a knock of the scanner"


def test_wrong_acts_are_named(tmp_path: Path) -> None:
    task = carried("eye_in_hand")
    cell = DemoCell(1, task.scene)
    one = CaptureSession(tmp_path / "captures", task)
    for _ in range(3):
        cell.jog("next", one.verdict().advice)
        assert not one.take(cell.take(tmp_path), cell.pose()).refused
    old = cell.pose()
    cell.jog("next", one.verdict().advice)
    scan = cell.take(tmp_path)
    assert "an older one" in one.take(scan, ArmPose(X_BF=task.scene.frames(old.q + 0.1)[6], q=old.q + 0.1)).refused
    X = cell.pose().X_BF
    assert X is not None
    refused = one.take(scan, ArmPose(X_BF=X @ RigidTransform([0.0, 0.08, 0.0]), q=cell.pose().q)).refused
    assert re.search("a TCP is set|not the flange", refused)
    with pytest.raises(InputError, match="read poses with --poses"):
        CaptureSession(tmp_path / "other", task).take(scan, ArmPose(numbers=(400.0, 0.0, 300.0, 180.0, 0.0, 90.0)))
    assert len(one.captures) == 3


def test_an_arm_link_needs_joint_angles(tmp_path: Path) -> None:
    task = carried("eye_on_arm")
    cell = DemoCell(1, task.scene)
    one = CaptureSession(tmp_path / "captures", task)
    X, q = cell.pose().X_BF, cell.pose().q
    assert X is not None
    with pytest.raises(InputError, match="needs the arm's joint angles"):
        one.take(cell.take(tmp_path), ArmPose(X_BF=X))
    with pytest.raises(InputError, match="a TCP is set at the robot"):
        one.take(cell.take(tmp_path), ArmPose(X_BF=X @ RigidTransform([0.0, 0.0, 0.1]), q=q))


def test_two_arms_are_refused_with_the_command_that_does_it() -> None:
    with pytest.raises(InputError, match="weldcal calibrate --scenario NAME"):
        carried("co_manipulation")


def test_what_more_captures_cannot_lower_is_named() -> None:
    """Errors of a session on the forearm, which settled, and of one that still falls."""
    task = carried("eye_on_arm")
    settled = CarriedCalibration(history=((4, 2.6e-4), (5, 2.58e-4), (6, 2.58e-4), (7, 2.55e-4)))
    assert "taken to be off by 0.4 mm" in " ".join(task._floor(settled))
    assert not task._floor(replace(settled, history=((4, 3.2e-4), (5, 2.5e-4), (6, 2.2e-4), (7, 2.1e-4))))
    assert not task._floor(replace(settled, history=settled.history[:3])), "three are too few to tell"
