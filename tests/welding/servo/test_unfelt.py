"""A seam that the tip does not feel: the torch follows the plan, the tip hangs above it, and no frame of the finger
counts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import DeflectionControl, ServoConfig, ToolGeometry, TouchOnConfig
from weldcal.welding.servo.state import DeflectionSample, Phase, ServoSample, WeldingState
from weldcal.welding.servo.step import welding_step
from weldcal.welding.servo.touch import touch_start_pose

ABOVE_M, TORCH_M, LENGTH_M = 0.0055, 0.002, 0.12  # of the tip's centre and of the torch over the root
RAISED = np.array([0.0, 0.0, ABOVE_M])
CONFIG = ServoConfig(
    felt=False,
    tool=ToolGeometry(torch_clearance_m=TORCH_M - ABOVE_M, torch_height_m=-0.0015, tip_drop_m=0.002),
    touch=TouchOnConfig(offset_m=0.0, zero_frames=10),
    deflection=DeflectionControl(delta_d_m=1e-9, axial_d_m=1e-9),
)


def root(radius_m: float) -> np.ndarray:
    """Points (N,3) m of a root line on the plane z = 0."""
    a = np.arange(-0.02, LENGTH_M + 0.02, 1e-3) / radius_m
    return np.column_stack([radius_m * np.sin(a), radius_m * (1.0 - np.cos(a)), np.zeros(len(a))])


def followed(radius_m: float, frames: bool) -> tuple[list[Phase], np.ndarray, np.ndarray, np.ndarray]:
    """Phases, torch (N,3), tip (N,3) and whether the arc burned (N,) with a robot that follows every velocity."""
    plan = SeamCurve.from_points(root(radius_m)[20:-20] + RAISED)
    X, state, rows = touch_start_pose(plan, CONFIG), WeldingState(), []
    for k in range(6000):
        time = k * CONFIG.period_s
        bent = DeflectionSample(time, X, np.array([0.0, 0.02, -0.02]), True) if frames else None  # nonsense
        state, command = welding_step(state, ServoSample(time, X, bent), plan, CONFIG)
        w, v = command.V_BT[:3], command.V_BT[3:]
        turn = float(np.linalg.norm(w)) * CONFIG.period_s
        R = X.rotation() if turn < 1e-12 else RotationMatrix(AngleAxis(turn, w / np.linalg.norm(w))) @ X.rotation()
        X = RigidTransform(R, X.translation() + CONFIG.period_s * v)
        rows.append((command.phase, X @ CONFIG.p_TW, X.translation(), command.torch_on))
        if command.phase in (Phase.DONE, Phase.FAULT):
            assert command.phase == Phase.DONE, command.reason
            break
    phases, torch, tip, on = zip(*rows, strict=True)
    return list(dict.fromkeys(phases)), np.array(torch), np.array(tip), np.array(on)


@pytest.mark.parametrize("radius_m", [1e3, 0.25])
@pytest.mark.parametrize("frames", [False, True])
def test_the_torch_follows_the_plan_and_the_tip_hangs(radius_m: float, frames: bool) -> None:
    phases, torch, tip, on = followed(radius_m, frames)
    assert phases == [Phase.TOUCH, Phase.FINISH, Phase.DONE]
    off = torch[on] - [0.0, radius_m, 0.0]
    assert np.abs(np.hypot(off[:, 0], off[:, 1]) - radius_m).max() < 1e-4
    assert np.abs(off[:, 2] - TORCH_M).max() < 1e-4
    along = radius_m * np.arctan2(off[:, 0], -off[:, 1])
    assert along[0] == pytest.approx(0.0, abs=3e-4)
    assert along[-1] == pytest.approx(LENGTH_M - 1e-3, abs=1.2e-3)
    assert tip[:, 2].min() > ABOVE_M - 1e-4
    speed = np.linalg.norm(np.diff(torch[on], axis=0), axis=1) / CONFIG.period_s
    assert speed.mean() == pytest.approx(CONFIG.weld_speed_m_s, rel=0.01)


def test_a_clock_that_stands_is_still_a_fault() -> None:
    plan = SeamCurve.from_points(root(1e3)[20:-20] + RAISED)
    state, X = WeldingState(), touch_start_pose(plan, CONFIG)
    for _ in range(math.ceil(CONFIG.faults.hidden_s / CONFIG.period_s) + 3):
        state, command = welding_step(state, ServoSample(1.0, X), plan, CONFIG)
    assert command.phase == Phase.FAULT
