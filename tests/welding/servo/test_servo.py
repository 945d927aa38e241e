"""The welding servo in a small kinematic world: it finds the groove, keeps the torch on it, and stops as it should."""

from __future__ import annotations

import math
import re
from dataclasses import fields, replace
from functools import lru_cache

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.welding.weld_kinematics import Run, l_curve, straight, weld
from tests.worlds.weld.budgets import HARD, NOMINAL, PERFECT
from tests.worlds.weld.groove import DROP_M as DROP
from tests.worlds.weld.groove import SEAT_M as SEAT
from tests.worlds.weld.seams import s_curve
from tests.worlds.weld.speed import SpeedStatistics, speed_statistics
from weldcal.welding.record.process import PathError, path_error
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import (
    ContactConfig,
    DeflectionControl,
    FaultLimits,
    FeltPathConfig,
    GapConfig,
    LawWeights,
    MotionLimits,
    ServoConfig,
    ServoConfigError,
    SteeringConfig,
    ToolGeometry,
    TorchControl,
    TouchOnConfig,
)
from weldcal.welding.servo.state import DeflectionSample, Phase, ServoSample, WeldingState
from weldcal.welding.servo.step import welding_step
from weldcal.welding.servo.touch import touch_start_pose

CALIBRATED = ServoConfig(touch=TouchOnConfig(calibrate_gain=True))
SPEED = CALIBRATED.weld_speed_m_s
MM = 1e-3


@lru_cache(maxsize=8)
def nominal(name: str) -> tuple[Run, PathError, SpeedStatistics]:
    """A weld within the nominal error budget, and how well it went."""
    points = {"straight": straight(), "s": s_curve(), "l": l_curve()}[name]
    return judged(weld(points, NOMINAL, CALIBRATED, seed={"straight": 1, "s": 2, "l": 3}[name]), points)


def judged(run: Run, points: np.ndarray) -> tuple[Run, PathError, SpeedStatistics]:
    line = SeamCurve.from_points(points).raised(SEAT + ServoConfig().clearance_m)
    error = path_error(run.torch[run.torch_on], line)
    return run, error, speed_statistics(run.time, run.torch, run.torch_on, SPEED)


def ignition_is_one_stretch(run: Run) -> bool:
    return int(np.sum(np.diff(run.torch_on.astype(int)) == 1)) == 1


@pytest.mark.parametrize("name", ["straight", "s", "l"])
def test_the_torch_keeps_to_the_seam_at_its_speed(name: str) -> None:
    run, error, speed = nominal(name)
    assert run.phases() == (Phase.TOUCH, Phase.TRACK, Phase.FINISH, Phase.DONE)
    # Targets D1 and D3 of the design note for the nominal budget.
    assert error.mean_m <= 0.05 * MM
    assert error.max_m <= 0.2 * MM
    assert np.abs(error.height).max() <= 0.2 * MM
    assert speed.cv <= 0.02
    assert speed.outside_m <= 1.0 * MM
    assert max(abs(c.diagnostics.omega) for c in run.commands) <= 0.8


@pytest.mark.parametrize("name", ["straight", "s", "l"])
def test_the_arc_burns_from_the_seams_start_to_its_end_and_nowhere_else(name: str) -> None:
    run, error, speed = nominal(name)
    assert ignition_is_one_stretch(run)
    # The start is the plan's, off by its 2 mm, its turn (0.5 deg, 150 mm away) and its warp; the end is felt.
    assert abs(error.s[0]) <= 4.0 * MM
    assert error.s[-1] == pytest.approx(0.3, abs=0.6 * MM)
    assert speed.seconds <= 1.02 * speed.welded_m / SPEED


def test_at_the_seams_end_nothing_jerks() -> None:
    run, error, _ = nominal("straight")
    last = error.s > 0.3 - 0.06
    # Target D5: the last chord of the seam, where the tip has nothing left to feel.
    assert np.abs(error.lateral[last]).max() <= 0.15 * MM
    V = np.array([c.V_BT[3:] for c in run.commands])
    end = run.phase.index(Phase.FINISH)
    step = np.linalg.norm(np.diff(V[end - 30 : end + 200], axis=0), axis=1)
    assert step.max() <= 1.0 * MM


def test_the_gain_felt_at_touch_on_takes_the_bias_out() -> None:
    points = straight()
    # A tag that shows 3 % too much puts the seam 3 % of 2 mm to the side; pressing finds the 3 % to about 1 %.
    _, without, _ = judged(weld(points, NOMINAL, seed=1), points)
    run, within, _ = nominal("straight")
    assert abs(np.mean(without.lateral)) > 0.04 * MM
    assert abs(np.mean(within.lateral)) < 0.6 * abs(np.mean(without.lateral))
    assert run.state.gain == pytest.approx(1.03, abs=0.025)


def test_a_gap_of_ten_millimetres_is_crossed_on_the_moved_plan() -> None:
    points = s_curve()
    run, error, speed = judged(weld(points, NOMINAL, CALIBRATED, 5, gaps=((0.145, 0.155),)), points)
    assert run.phases() == (Phase.TOUCH, Phase.TRACK, Phase.COAST, Phase.TRACK, Phase.FINISH, Phase.DONE)
    assert error.max_m <= 0.2 * MM
    assert speed.cv <= 0.02
    assert ignition_is_one_stretch(run)


def test_contact_lost_for_good_stops_the_weld() -> None:
    run = weld(straight(), NOMINAL, CALIBRATED, 6, gaps=((0.060, 0.120),))
    assert run.last.phase == Phase.FAULT
    assert "Contact lost" in (run.last.reason or "")
    stops_safely(run)


def test_a_hidden_tag_stops_the_weld() -> None:
    run = weld(s_curve(), NOMINAL, ServoConfig(), 7, hidden=(17.0, 30.0))
    assert run.last.phase == Phase.FAULT
    assert "Tag hidden" in (run.last.reason or "")
    i = run.phase.index(Phase.FAULT)
    assert run.torch_on[i - 1]
    # Blind from the last frame seen: 0.3 s, give or take a frame and a tick.
    assert 17.0 + 0.3 - 0.034 <= run.time[i] <= 17.0 + 0.3 + 0.01
    stops_safely(run)


def test_a_tag_hidden_for_a_moment_does_not() -> None:
    run = weld(straight(0.09), NOMINAL, ServoConfig(), 7, hidden=(9.0, 9.2))
    assert run.last.phase == Phase.DONE


def stops_safely(run: Run) -> None:
    """Arc off in the first tick of the fault, motion fading from what it was, then rest, for ever."""
    i = run.phase.index(Phase.FAULT)
    assert not run.torch_on[i:].any()
    speeds = np.array([np.linalg.norm(c.V_BT[3:]) for c in run.commands[i - 1 :]])
    assert speeds[1] > 0.5 * speeds[0]
    assert np.all(np.diff(speeds) <= 1e-12)
    assert not np.any(run.last.V_BT)
    assert run.phase[-1] == Phase.FAULT


def test_in_the_hard_budget_the_torch_stays_within_half_a_wire() -> None:
    points = s_curve()
    _, error, speed = judged(weld(points, HARD, CALIBRATED, 8), points)
    # Target D2: 0.15 mean, 0.5 max, half of a 1 mm wire.
    assert error.mean_m <= 0.15 * MM
    assert error.max_m <= 0.5 * MM
    assert speed.cv <= 0.02


def test_a_corner_of_one_millimetre_neither_jams_the_tip_nor_throws_the_torch() -> None:
    points = l_curve(0.001, side=1.0)
    run, error, _ = judged(weld(points, NOMINAL, CALIBRATED, 22), points)
    assert run.last.phase == Phase.DONE
    # Target D4 asks for 1.3; the corner put back from its two sides does better. The repaired paper law turns at 891
    # rad/s here and throws the torch at 10 m/s.
    assert error.max_m <= 0.5 * MM
    assert error.mean_m <= 0.05 * MM
    assert max(abs(c.diagnostics.omega) for c in run.commands) <= 0.8
    assert max(c.diagnostics.tip_speed for c in run.commands) <= 40.0 * MM


def test_on_a_curved_surface_torch_height_and_side_both_hold() -> None:
    flat = s_curve()
    a = (flat[:, 0] - flat[:, 0].mean()) / 0.150
    points = np.column_stack([0.150 * np.sin(a), flat[:, 1], 0.150 * np.cos(a) - 0.150])
    up = np.column_stack([np.sin(a), 0.0 * a, np.cos(a)])
    plan = SeamCurve.from_points(points, up)
    budget = replace(PERFECT, lag_s=0.020, tag_sigma_m=0.02 * MM)
    run = weld(points, budget, ServoConfig(), 1, plan=plan, up=up)
    error = path_error(run.torch[run.torch_on], plan.raised(SEAT))
    assert run.last.phase == Phase.DONE
    # 0.02 mm of noise gives under 0.01 mm; the fit's 1.5 mm window shortens the jump of curvature of an R60 entry by
    # sigma^2/(2 R) = 0.02 mm, and the lag adds as much again.
    assert error.mean_m <= 0.03 * MM
    assert np.abs(error.lateral).max() <= 0.1 * MM
    assert np.abs(error.height - ServoConfig().clearance_m).max() <= 0.05 * MM


@pytest.mark.parametrize("across", [-3.5, -1.5, 0.0, 3.5])
@pytest.mark.parametrize("high", [-1.0, 1.0])
def test_the_groove_is_found_within_the_plans_error(across: float, high: float) -> None:
    points = straight(0.1)
    plan = SeamCurve.from_points(points + np.array((0.0, across * MM, high * MM)))
    run = weld(points, replace(NOMINAL, friction=0.35), ServoConfig(), 1, plan=plan, time_limit=6.0)
    assert run.phases()[:2] == (Phase.TOUCH, Phase.TRACK)
    i = run.phase.index(Phase.TRACK)
    np.testing.assert_allclose(run.tip[i, 1:], [0.0, SEAT], atol=0.01 * MM)
    assert not run.torch_on[: i + 1].any()


@pytest.mark.parametrize(
    ("shift", "text"), [((0.0, 0.020, 0.0), "within 12 mm"), ((0.0, 0.0, 0.020), "found no surface")]
)
def test_a_groove_that_is_not_there_is_said_not_to_be(shift: tuple[float, float, float], text: str) -> None:
    points = straight(0.1)
    run = weld(points, NOMINAL, ServoConfig(), 1, plan=SeamCurve.from_points(points + np.array(shift)), time_limit=20.0)
    assert run.last.phase == Phase.FAULT
    assert "Seam not found" in (run.last.reason or "")
    assert text in (run.last.reason or "")
    if shift[2]:
        # Its rest went down by the 6 mm that are allowed and the deflection that there should have been.
        assert re.search(r"9\.[01] mm below .* it read -?0\.\d mm of deflection 0\.[01]\d s ago", run.last.reason or "")
    assert not run.torch_on.any()


def test_while_no_frame_comes_the_tool_presses_no_deeper() -> None:
    """The worst moment is while it follows a tip that fell into the groove: the last frame asks for more depth."""
    points = straight(0.1)
    plan = SeamCurve.from_points(points)
    seen = weld(points, NOMINAL, ServoConfig(), 1, plan=plan, time_limit=5.0)
    fell = float(seen.time[np.argmax(seen.tip[:, 2] < SEAT + 0.8 * DROP)])
    blind = weld(points, NOMINAL, ServoConfig(), 1, plan=plan, time_limit=6.0, hidden=(fell + 0.6, fell + 0.8))
    assert Phase.TRACK in seen.phases()
    assert Phase.TRACK in blind.phases()
    lowest = [run.tool[: run.phase.index(Phase.TRACK), 2].min() for run in (seen, blind)]
    assert lowest[1] > lowest[0] - 0.1 * MM


def test_a_plan_that_no_trailing_torch_can_follow_is_refused_before_anything_moves() -> None:
    a = np.linspace(0.0, math.pi, 100)
    hairpin = np.vstack(
        [
            np.column_stack([np.linspace(-0.1, -0.001, 100), np.zeros(100), np.zeros(100)]),
            0.02 * np.column_stack([np.sin(a), 1.0 - np.cos(a), 0.0 * a]),
            np.column_stack([np.linspace(-0.001, -0.1, 100), np.full(100, 0.04), np.zeros(100)]),
        ]
    )
    plan = SeamCurve.from_points(hairpin)
    sample = ServoSample(0.0, touch_start_pose(plan, ServoConfig()))
    _, command = welding_step(WeldingState(), sample, plan, ServoConfig())
    assert command.phase == Phase.FAULT
    assert "Plan infeasible" in (command.reason or "")
    assert not command.V_BT.any()


def test_the_tip_pushed_beyond_its_limit_stops_the_weld() -> None:
    plan, config = SeamCurve.from_points(straight()), ServoConfig()
    X_BT = touch_start_pose(plan, config)
    frame = DeflectionSample(0.0, X_BT, np.array([0.0, 6.0 * MM, 0.0]), True)
    _, command = welding_step(WeldingState(), ServoSample(0.0, X_BT, frame), plan, config)
    assert command.phase == Phase.FAULT
    assert "mechanical limit" in (command.reason or "")


def test_touch_on_starts_above_the_face_on_the_right_of_the_seam_with_the_torch_behind() -> None:
    config = ServoConfig(tool=ToolGeometry(tip_seat_height_m=SEAT))
    X_BT = touch_start_pose(SeamCurve.from_points(straight()), config)
    x, y, z = X_BT.translation()
    assert x == pytest.approx(config.touch.arc_m)
    assert y == pytest.approx(-5.0 * MM)
    assert z > SEAT + config.tool.tip_drop_m
    np.testing.assert_allclose(X_BT.rotation().matrix(), np.eye(3), atol=1e-12)


def test_the_same_inputs_give_the_same_answer_and_leave_the_state_alone() -> None:
    run, _, _ = nominal("s")
    plan = SeamCurve.from_points(s_curve())
    state = replace(run.state, phase=Phase.TRACK)
    sample = ServoSample(run.time[-1] + 0.008, RigidTransform(run.tool[-1]))
    first, second = (welding_step(state, sample, plan, CALIBRATED)[1] for _ in range(2))
    np.testing.assert_array_equal(first.V_BT, second.V_BT)
    assert state.phase == Phase.TRACK


def test_every_command_is_finite_wherever_the_tool_stands() -> None:
    run, _, _ = nominal("l")
    plan = SeamCurve.from_points(l_curve())
    rng = np.random.default_rng(5)
    for phase in (Phase.TRACK, Phase.COAST, Phase.FINISH):
        for k in range(60):
            # From a little off to upside down and a metre away; chord along, across and against the seam.
            X = RigidTransform(
                RollPitchYaw(rng.uniform(-math.pi, math.pi, 3) * (k % 3) / 2.0),
                run.tool[3000] + rng.normal(0.0, 10.0 ** rng.uniform(-4, 0), 3),
            )
            deflection = rng.normal(0.0, 1.5 * MM, 3)
            time = float(run.time[-1]) + 0.01
            frame = DeflectionSample(time - 0.005, X, deflection if k % 5 else deflection * math.nan, True)
            state = replace(run.state, phase=phase, s_tip=0.15, s_torch=0.09, torch_arc=0.09, frame_time=time - 0.1)
            state, command = welding_step(state, ServoSample(time, X, frame), plan, CALIBRATED)
            assert np.isfinite(command.V_BT).all()
            assert np.linalg.norm(command.V_BT[:3]) <= 1.5
            assert (
                np.linalg.norm(command.V_BT[3:])
                <= CALIBRATED.limits.tip_speed_max_m_s + 2 * CALIBRATED.deflection.speed_m_s
            )


GROUPS = (
    *(ToolGeometry, TouchOnConfig, ContactConfig, GapConfig, FaultLimits, DeflectionControl, TorchControl),
    *(MotionLimits, LawWeights, SteeringConfig, FeltPathConfig, ServoConfig),
)
SIGNED = {"torch_height_m", "side_offset_m", "offset_m", "work_angle_rad"}  # a side, or a direction
MAY_BE_ZERO = {"tip_seat_height_m", "zero_frames", "settle_s", "start_s", "crater_s"}


@pytest.mark.parametrize("group", GROUPS)
def test_no_setting_takes_a_number_that_makes_no_sense(group: type) -> None:
    tried = 0
    for field in fields(group):
        default = field.default
        if isinstance(default, bool) or not isinstance(default, int | float):
            continue
        bad = [math.nan, math.inf, -math.inf]
        bad += [] if field.name in SIGNED else [-default if default else -1]
        bad += [] if field.name in SIGNED | MAY_BE_ZERO else [0 * default]
        for value in bad:
            # Too small a chord has a sentence of its own in the whole.
            where = group if field.name != "torch_offset_m" else lambda **k: ServoConfig(tool=ToolGeometry(**k))
            with pytest.raises(ServoConfigError, match=field.name):
                where(**{field.name: value})
            tried += 1
    assert tried >= 10


@pytest.mark.parametrize(
    ("group", "name"), [("refinement", "fit_sigma_m"), ("plan_fit", "sigma_m"), ("windows", "travel_rad")]
)
def test_settings_of_the_seam_are_checked_where_the_servo_takes_them(group: str, name: str) -> None:
    for value in (math.nan, -1.0, 0.0):
        part = replace(getattr(ServoConfig(), group), **{name: value})
        with pytest.raises(ServoConfigError, match=f"{group}.{name}"):
            ServoConfig(**{group: part})


def test_a_chord_too_short_to_trail_and_a_press_that_does_not_press_are_refused() -> None:
    with pytest.raises(ServoConfigError, match="trail"):
        ServoConfig(tool=ToolGeometry(torch_offset_m=0.0))
    with pytest.raises(ServoConfigError, match="press_ratio"):
        TouchOnConfig(press_ratio=1.0)
