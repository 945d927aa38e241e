"""A seam's chord map tells before the arc is lit what a trailing torch can follow."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.welding.weld_kinematics import l_curve, straight
from tests.worlds.weld.seams import arcs, s_curve
from tests.worlds.weld.speed import speed_statistics
from weldcal.welding.record.process import ProcessLogError, path_error
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import InfeasibleSeam, check_feasible

D, V = 0.060, 0.008


def corner(radius: float, turn_deg: float) -> SeamCurve:
    """Two straights of 120 mm and a left turn between them."""
    turn = math.radians(turn_deg)
    return SeamCurve.from_points(arcs((0.12, 0.0), (radius * turn, 1.0 / radius), (0.12, 0.0), spacing=0.5e-3))


def test_on_a_straight_nothing_is_asked() -> None:
    chart = chord_map(SeamCurve.from_points(straight()), D, V)
    assert chart.max_turn == pytest.approx(0.0, abs=1e-9)
    assert chart.min_conditioning == pytest.approx(math.sqrt(2.0), abs=1e-9)
    assert chart.speed_loss == pytest.approx(0.0, abs=1e-9)
    assert chart.back_up_m == 0.0
    np.testing.assert_allclose(chart.s_tip - chart.s_torch, D, atol=1e-9)


def test_both_ends_of_the_chord_lie_on_the_seam() -> None:
    seam = SeamCurve.from_points(l_curve())
    chart = chord_map(seam, D, V)
    gap = np.linalg.norm(seam.position(chart.s_tip) - seam.position(chart.s_torch), axis=1)
    np.testing.assert_allclose(gap, D, atol=1e-7)


@pytest.mark.parametrize("radius", [0.020, 0.010, 0.005])
def test_a_right_angled_corner_is_as_the_note_computed(radius: float) -> None:
    chart = chord_map(corner(radius, 90.0), D, V)
    # Section B.2: the least n_d . n_t of a 90 deg corner of radius R is R/d; a pair every 0.5 mm of path misses
    # it by at most half a step over d.
    assert np.min(chart.cos_torch) == pytest.approx(radius / D, abs=0.25e-3 / D + 0.005)
    assert chart.min_conditioning >= 1.0 - 0.005
    assert chart.back_up_m < 0.2e-3


def test_a_gentle_s_is_welded_at_full_speed() -> None:
    chart = check_feasible(SeamCurve.from_points(s_curve()), D, V)
    assert math.degrees(chart.max_turn) < 60.1
    assert chart.speed_loss < 1e-9
    # Section B.2, S R60 at d 60: the tip runs at 7.2 to 8.9 mm/s while the torch keeps 8.
    assert np.min(chart.tip_speed) > 7.0e-3
    assert np.max(chart.tip_speed) < 9.1e-3


@pytest.mark.parametrize(("radius", "turn"), [(0.005, 120.0), (0.010, 150.0), (0.020, 180.0)])
def test_a_turn_that_would_back_the_torch_up_is_refused(radius: float, turn: float) -> None:
    with pytest.raises(InfeasibleSeam, match="backwards; split the weld at"):
        check_feasible(corner(radius, turn), D, V)


def test_a_turn_beyond_a_right_angle_is_welded_where_the_torch_need_not_back_up() -> None:
    # Section B.2: L R20 of 120 deg backs up by 0 mm at d 40, not at all to speak of at 60, and by 2.7 mm or so at 80.
    seam = corner(0.020, 120.0)
    for d in (0.040, 0.060):
        assert check_feasible(seam, d, V).max_turn > math.radians(110.0)
    with pytest.raises(InfeasibleSeam, match="backwards"):
        check_feasible(seam, 0.080, V)


@pytest.mark.parametrize("d", [0.040, 0.060, 0.080])
def test_a_sharp_hairpin_makes_the_torch_run_backwards(d: float) -> None:
    # The torch, a from the vertex, turns back where the chord passes through the arc's centre, and goes on again
    # where it is square to the second leg: a = d/sin(interior). Both in closed form for a turn of 120 deg.
    radius, interior = 0.005, math.radians(60.0)
    leg = radius / math.tan(0.5 * interior)
    first = leg + math.sqrt((d - radius) ** 2 - radius**2)
    expected = d / math.sin(interior) - first
    assert chord_map(corner(radius, 120.0), d, V).back_up_m == pytest.approx(expected, abs=0.05e-3)


def test_a_wide_turn_is_feasible_whatever_its_angle() -> None:
    # 180 deg of R100 turns by only 2 asin(30/100) = 35 deg within the chord.
    chart = check_feasible(corner(0.100, 180.0), D, V)
    assert math.degrees(chart.max_turn) == pytest.approx(34.9, abs=0.5)


def test_path_error_is_signed_to_the_left_and_up() -> None:
    seam = SeamCurve.from_points(s_curve())
    s = np.linspace(0.0, seam.length, 500)
    path = seam.position(s) + 0.3e-3 * seam.normal(s) - 0.2e-3 * seam.up(s)
    error = path_error(path, seam)
    np.testing.assert_allclose(error.lateral, 0.3e-3, atol=1e-7)
    np.testing.assert_allclose(error.height, -0.2e-3, atol=1e-7)
    assert error.mean_m == pytest.approx(error.max_m, abs=1e-7)
    with pytest.raises(ProcessLogError):
        path_error(np.zeros((0, 3)), seam)


def test_speed_counts_by_length_where_the_arc_burned() -> None:
    t = np.arange(0.0, 30.0, 0.008)
    x = np.where(t < 10.0, 0.0, np.where(t < 20.0, 0.008 * (t - 10.0), 0.08 + 0.016 * (t - 20.0)))
    p = np.column_stack([x, 0 * x, 0 * x])
    on = t >= 10.0
    result = speed_statistics(t, p, on, 0.008)
    # 80 mm at 8 and 160 mm at 16 mm/s: mean by length 13.33, deviation 3.77.
    assert result.mean == pytest.approx(13.33e-3, rel=0.01)
    assert result.cv == pytest.approx(3.77 / 13.33, rel=0.02)
    assert result.outside_m == pytest.approx(0.16, abs=0.002)
    stands = speed_statistics(t, 0.0 * p, on, 0.008)  # a job that is held before the torch moves on
    assert (stands.mean, stands.cv) == (0.0, 0.0)
    with pytest.raises(ProcessLogError, match="never"):
        speed_statistics(t, p, np.zeros(len(t), dtype=bool), 0.008)
