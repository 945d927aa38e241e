"""The line of a pass after the root: felt by the tip, not planned, and beside it where it was ordered."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from tests.worlds.weld.budgets import NOMINAL
from tests.worlds.weld.groove import DROP_M, SEAT_M
from tests.worlds.weld.plant import StudyRun, simulate
from tests.worlds.weld.seams import TrueSeam, s_curve
from weldcal.welding.passes.felt import PassError, WeldPass, backwards, felt_line, lift_m, pass_config, pass_line
from weldcal.welding.record.process import path_error
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import TORCH_ABOVE_ROOT_M, ServoConfig, ToolGeometry
from weldcal.welding.servo.state import Phase

UP, BALL_M, AHEAD_M, MM = np.array([0.0, 0.0, 1.0]), 2.5e-3, 0.09, 1e-3
WARPED = replace(NOMINAL, plan_warp_m=1.5e-3, plan_shift_m=3e-3)
ROOT = ServoConfig(
    weld_speed_m_s=0.016,
    tool=ToolGeometry(torch_clearance_m=TORCH_ABOVE_ROOT_M - SEAT_M, tip_drop_m=DROP_M, torch_height_m=-1.5e-3),
)


@lru_cache(maxsize=2)
def root_pass(gap: bool) -> StudyRun:
    run = simulate(TrueSeam("s", s_curve(), UP), WARPED, ROOT, 5, gaps=((0.14, 0.165),) if gap else ())
    assert run.phase == Phase.DONE, run.reason
    return run


@pytest.mark.parametrize(("gap", "most_mm"), [(False, 0.15), (True, 0.3)])
def test_the_felt_line_is_the_true_line_where_the_plan_is_not(gap: bool, most_mm: float) -> None:
    run = root_pass(gap)
    true = SeamCurve.from_points(s_curve()).raised(SEAT_M)
    felt = felt_line(run.state, AHEAD_M)
    s = np.linspace(0.0, felt.length, 400)
    assert felt.length == pytest.approx(0.3, abs=2.5 * MM)
    off = path_error(felt.position(s), true).distance_m
    assert off[s > 8 * MM].max() < most_mm * MM
    assert off.max() < 0.3 * MM, "from the start to where the tip came down"
    assert path_error(run.planned.position(s), true).distance_m.max() > 1.5 * MM


@pytest.mark.parametrize("reverse", [False, True])
def test_a_pass_lies_beside_the_root_in_the_joints_frame(reverse: bool) -> None:
    order = WeldPass(lateral_m=-2 * MM, vertical_m=4 * MM, reverse=reverse, angle_rad=0.1)
    felt = SeamCurve.from_points(s_curve()).raised(SEAT_M)
    line, config = pass_line(felt, order, ROOT, BALL_M, AHEAD_M, 5e-3), pass_config(ROOT, order, BALL_M)
    assert line.length == pytest.approx(felt.length, rel=0.02)
    # the torch's path is that of the root, 2 mm to the right and 4 mm higher, in the root's travel
    s = np.linspace(0.0, line.length, 200)
    torch = line.position(s) + config.clearance_m * line.up(s)
    off = path_error(torch, SeamCurve.from_points(s_curve()), backwards=reverse)
    assert off.lateral == pytest.approx(-2 * MM, abs=2e-5)
    assert off.height == pytest.approx(4 * MM + TORCH_ABOVE_ROOT_M, abs=2e-5)
    assert (off.s[-1] > off.s[0]) is not reverse
    assert (config.felt, config.torch.work_angle_rad) == (False, -0.1 if reverse else 0.1)


def test_the_lifted_ball_is_clear_of_the_weld_below() -> None:
    for above in (2.6 * MM, SEAT_M):  # in a wide and in a narrow joint
        tool = replace(ROOT.tool, torch_clearance_m=TORCH_ABOVE_ROOT_M - above)
        root = replace(ROOT, tool=tool)
        assert above + lift_m(root, BALL_M) - BALL_M >= 1.5 * MM - 1e-12
        assert lift_m(root, BALL_M) == pytest.approx(max(0.0, 4 * MM - above))


def test_a_ring_backwards_goes_on_around() -> None:
    a = np.linspace(0.0, 2.2 * math.tau, 1500)
    turn, overlap = 0.1 * math.tau, 5e-3
    ring = SeamCurve.from_points(0.1 * np.column_stack([np.cos(a), np.sin(a), 0 * a]), length=turn + overlap)
    back = backwards(ring, AHEAD_M, overlap)
    assert back.length == pytest.approx(turn + overlap, abs=1e-5)
    assert back.drawn_m > back.length + 0.08
    p = back.position(np.linspace(0.0, back.length + 0.08, 300))
    assert np.hypot(p[:, 0], p[:, 1]) == pytest.approx(0.1, abs=1e-5)


def test_a_pass_far_from_its_root_is_refused() -> None:
    with pytest.raises(PassError, match="25 mm from the root at most"):
        WeldPass(lateral_m=0.03)
