"""Tacks: the tip is lifted over bumps of the true groove and finds it again, and the torch stays on the seam."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.worlds.weld.budgets import NOMINAL
from tests.worlds.weld.groove import SEAT_M
from tests.worlds.weld.plant import StudyRun, simulate
from tests.worlds.weld.seams import TrueSeam, s_curve
from weldcal.welding.passes.tacks import Tack, TackError, hops
from weldcal.welding.record.process import PathError, path_error
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.plan_fit import PlanFit
from weldcal.welding.seam.refinement import RefinedSeam
from weldcal.welding.servo.contact import with_point
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Measurement, Phase, WeldingState
from weldcal.welding.servo.track import TorchTarget, guarded_motion, torch_target

TACKS = ((0.050, 0.062, 2e-3), (0.125, 0.145, 5e-3), (0.215, 0.230, 3.5e-3))
# the shape of a plan whose drawing was registered to a scan
DRAWN = replace(NOMINAL, plan_warp_m=0.2e-3, plan_noise_m=0.05e-3)
MM = 1e-3
PRESSED, DOWN = np.array((2e-3, -3e-3)), np.array((0.0, -0.5e-3))


def welded(seed: int, known: bool = True) -> tuple[StudyRun, PathError, np.ndarray]:
    """A run over three tacks, where the true torch was, and when it was on."""
    config = ServoConfig(tacks=tuple(Tack(*t) for t in TACKS) if known else (), weld_speed_m_s=0.008)
    run = simulate(TrueSeam("s", s_curve(), np.array([0.0, 0.0, 1.0])), DRAWN, config, seed, tacks=TACKS)
    return run, path_error(run.points("torch"), run.torch_line), run.column("torch_on") > 0.5


@pytest.mark.parametrize("seed", [0, 1])
def test_the_torch_stays_on_the_seam_and_the_tip_finds_it_again(seed: int) -> None:
    run, off, on = welded(seed)
    assert run.phase == Phase.DONE, run.reason
    assert np.ptp(off.s[on]) > 0.29
    assert off.distance_m[on].max() < 0.3 * MM
    phases = [a for a, b in pairwise([*(c.phase for c in run.commands), None]) if a != b]
    assert phases[1:] == [*(Phase.TRACK, Phase.COAST) * 3, Phase.TRACK, Phase.FINISH, Phase.DONE]
    # the ball hangs free above each tack, whose ends slope
    tip = path_error(run.points("tip"), SeamCurve.from_points(s_curve()).raised(SEAT_M))
    for a, b, lift in TACKS:
        over = (tip.s > a) & (tip.s < b)
        s = tip.s[over]
        assert (tip.height[over] - np.minimum(lift, np.minimum(s - a, b - s))).min() > 0.3 * MM


def test_an_unknown_tack_lifts_the_torch() -> None:
    run, off, on = welded(0, known=False)
    assert run.phase == Phase.FAULT or off.distance_m[on].max() > 1.5 * MM


def test_near_tacks_are_passed_in_one_lift() -> None:
    near = hops((Tack(0.1, 0.11, 4e-3), Tack(0.115, 0.125, 2e-3), Tack(0.25, 0.26, 2e-3)), 8e-3, 3e-3)
    assert len(near) == 2
    first = near[0]
    assert (first.up, first.down) == pytest.approx((0.097, 0.128))
    assert first.height == pytest.approx(5e-3)
    for s in np.linspace(first.begin - 1e-3, first.end + 1e-3, 300):
        place, slope = first.place(s, PRESSED, DOWN)
        h = 1e-7
        if min(abs(s - edge) for edge in first[:4]) > h:
            numeric = (first.place(s + h, PRESSED, DOWN)[0] - first.place(s - h, PRESSED, DOWN)[0]) / (2.0 * h)
            assert slope == pytest.approx(numeric, abs=1e-5)
        assert np.abs(slope * 8e-3).max() <= 15e-3 + 1e-9
        if first.up <= s <= first.down:
            assert place == pytest.approx((0.0, 5e-3))
    # pressed to the side until it leaves the seam: a step would turn the tool faster than an arm follows
    assert first.place(first.begin, PRESSED, DOWN)[0] == pytest.approx(PRESSED)
    assert first.place(first.end, PRESSED, DOWN)[0] == pytest.approx(DOWN)


def plan_of(height_m: float = 0.0) -> SeamCurve:
    return SeamCurve.from_points(np.column_stack([np.linspace(0.0, 0.3, 61), np.zeros(61), np.full(61, height_m)]))


@pytest.mark.parametrize("upward", [-0.02, 0.02])
def test_the_torch_keeps_its_height_where_the_pitch_is_at_its_limit(upward: float) -> None:
    config, curve = ServoConfig(), plan_of()
    X_BT = RigidTransform(np.array((0.1, 0.0, 0.0)))
    p_BW = X_BT.multiply(config.p_TW)
    x, y, z = np.eye(3)
    target = TorchTarget(point=p_BW, tangent=x, normal=y, up=z, arc=0.04, s=0.04, residual=np.zeros(2))
    V = np.zeros(6)
    V[1] = -upward / config.tool.torch_offset_m  # its rate of change has a limit of its own
    state = WeldingState(v_tip=0.008, V=V)
    tip = curve.frame(0.1)
    V = guarded_motion(state, X_BT, tip, target, (0.0, upward), config, config.period_s).V_BT
    pitch, torch_up = -V[1], (V[3:] + np.cross(V[:3], p_BW - X_BT.translation()))[2]
    assert abs(torch_up) < 1e-4
    assert math.copysign(1.0, upward) * V[5] > 0.9 * config.limits.pitch_rate_max_rad_s * config.tool.torch_offset_m
    assert abs(pitch) <= config.limits.pitch_rate_max_rad_s


def test_in_a_gap_the_torchs_target_does_not_move_with_the_plan() -> None:
    config, n = ServoConfig(), 40
    curve = plan_of()
    felt = np.column_stack([np.linspace(0.03, 0.05, n), np.zeros(n), np.full(n, 0.4e-3)])
    state = WeldingState(
        phase=Phase.TRACK, plan_fit=PlanFit.start(curve), refined=RefinedSeam(felt, felt[:, 0]), s_tip=0.1,
        s_torch=0.07, torch_arc=0.07, residual=np.array((0.0, 0.4e-3)), proven=True, delta_n=2e-3, progress=0.1,
    )  # fmt: skip
    p_BW = np.array((0.07, 0.0, config.clearance_m))
    moved = 0.0
    for k in range(6):  # the sixth frame commits the second new point
        at = np.array((0.1 + 3e-3 * k, 0.0, 0.4e-3))
        measurement = Measurement(0.1 * k, at, np.zeros(3), at)
        state = replace(state, measurement=measurement, progress=float(at[0]), progress_log=((0.1 * k, float(at[0])),))
        before = state
        state = with_point(state, config)
        old, new = (torch_target(s, s.plan_fit.curve, p_BW, config).point for s in (before, state) if s.plan_fit)
        assert np.linalg.norm(new - old) < 0.02e-3
        assert state.plan_fit is not None
        moved = max(moved, float(np.linalg.norm(state.plan_fit.curve.position(0.07) - curve.position(0.07))))
    assert moved > 0.1e-3, "the plan has moved"


@pytest.mark.parametrize(
    ("tack", "said"),
    [
        (Tack(0.010, 0.020, 3e-3), "tip comes down at 6 mm"),
        (Tack(0.100, 0.110, 9e-3), "grind it"),
        (Tack(0.110, 0.100, 3e-3), "end beyond the start"),
        (Tack(0.100, 0.130, 5e-3), "100 mm the tip feels nothing for 65 mm, and the torch is 60 mm behind it"),
    ],
)
def test_a_tack_that_cannot_be_passed_is_refused(tack: Tack, said: str) -> None:
    with pytest.raises(TackError, match=said):
        ServoConfig(tacks=(tack,))
