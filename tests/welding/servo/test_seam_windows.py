"""What stands against a seam is named before the arc is lit: cusps, angles, speed; and a split seam is feasible piece
by piece."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from tests.worlds.weld.budgets import HARD, planned_seam
from tests.worlds.weld.seams import arcs, get_seam, on_cylinder
from weldcal.welding.numerics import changed
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import InfeasibleSeam, SeamWindows, assess_seam, check_feasible, split_seam
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase, ServoSample, WeldingState
from weldcal.welding.servo.step import welding_step
from weldcal.welding.servo.touch import touch_start_pose

D, V = 0.060, 0.008


def seam(name: str) -> SeamCurve:
    true = get_seam(name)
    return SeamCurve.from_points(true.points, true.up)


@pytest.mark.parametrize("radius", [0.150, 0.300])
@pytest.mark.parametrize("d", [0.040, 0.060, 0.080])
def test_round_a_cylinder_the_travel_angle_is_the_chords(radius: float, d: float) -> None:
    points, up = on_cylinder(arcs((0.25, 0.0), spacing=1e-3), radius)
    chart = chord_map(SeamCurve.from_points(points, up), d, V)
    inside = (chart.s_torch > 5e-3) & (chart.s_tip < 0.245)
    # asin(d/2R), nose down; the spline's arc is good to a micrometre.
    np.testing.assert_allclose(
        np.degrees(chart.travel[inside]), -math.degrees(math.asin(d / (2.0 * radius))), atol=0.01
    )


def test_a_rest_point_beside_the_seam_is_what_the_chord_reaches_to() -> None:
    left = 2.0e-3
    curve = seam("s_r60")
    chart = chord_map(curve, D, V, tip_left=left)
    tip = curve.position(chart.s_tip) + left * curve.normal(chart.s_tip)
    np.testing.assert_allclose(np.linalg.norm(tip - curve.position(chart.s_torch), axis=1), D, atol=1e-6)


def test_a_travel_angle_beyond_its_window_is_refused_and_no_split_is_offered() -> None:
    points, up = on_cylinder(arcs((0.25, 0.0), spacing=1e-3), 0.100)
    curve = SeamCurve.from_points(points, up)
    # asin(60/200) = 17.5 deg.
    check_feasible(curve, D, V)
    with pytest.raises(InfeasibleSeam, match=r"travel angle would be 17\.5 deg .* window is 15 deg; shorten the tool"):
        check_feasible(curve, D, V, SeamWindows(travel_rad=math.radians(15.0)))


def test_a_loss_of_torch_speed_beyond_its_window_is_refused() -> None:
    with pytest.raises(InfeasibleSeam, match="of its speed"):
        check_feasible(seam("l_r5_convex"), D, V, SeamWindows(speed_loss=0.10))
    check_feasible(seam("s_r60"), D, V, SeamWindows(speed_loss=0.01))


def test_a_cusp_is_named() -> None:
    report = assess_seam(seam("cusp_r20"), D, V)
    assert not report.feasible
    assert "cusp" in {p.kind for p in report.problems}
    with pytest.raises(InfeasibleSeam, match="infeasible"):
        split_seam(seam("cusp_r20"), 0.2, V)


@pytest.mark.parametrize("name", ["turn_120_r5", "turn_150_r10", "u_r20", "u_r30"])
def test_every_piece_of_a_split_seam_is_feasible_and_nothing_is_lost(name: str) -> None:
    curve = seam(name)
    pieces = split_seam(curve, D, V)
    assert len(pieces) >= 2
    assert sum(p.length for p in pieces) == pytest.approx(curve.length, abs=0.1e-3)
    for before, after in itertools.pairwise(pieces):
        np.testing.assert_allclose(before.position(before.length), after.position(0.0), atol=1e-6)
    for p in pieces:
        assert assess_seam(p, D, V).feasible


def test_a_feasible_seam_is_not_split() -> None:
    curve = seam("s_r60")
    assert split_seam(curve, D, V) == (curve,)


def test_a_right_angle_is_not_refused_for_its_plans_noise() -> None:

    for k in range(10):
        for name in ("l_r1_convex", "l_r5_concave"):
            check_feasible(planned_seam(get_seam(name), HARD, np.random.default_rng(k)), D, V)


def test_a_tool_that_leans_beyond_its_window_stops_the_weld() -> None:
    curve, config = seam("straight"), ServoConfig()
    X = touch_start_pose(curve, config)
    state, _ = welding_step(WeldingState(), ServoSample(0.0, X), curve, config)
    burning = replace(state, phase=Phase.TRACK, torch_on=True, s_tip=0.1, s_torch=0.04, lit_at=0.0, frame_time=0.0)

    for turn, word in ((RotationMatrix.MakeXRotation(0.4), "work"), (RotationMatrix.MakeYRotation(0.5), "travel")):
        tilted = RigidTransform(turn, np.array([0.1, 0.0, 0.0]))
        _, command = welding_step(burning, ServoSample(0.008, tilted), curve, config)
        assert command.phase == Phase.FAULT
        assert f"The {word} angle" in (command.reason or "")
        assert not command.torch_on


def test_a_changed_copy_knows_its_fields() -> None:
    state = WeldingState()
    other = changed(state, s_tip=0.1)
    assert (state.s_tip, other.s_tip) == (0.0, 0.1)
    assert type(other) is WeldingState
    with pytest.raises(TypeError, match="nonsense"):
        changed(state, nonsense=1)
