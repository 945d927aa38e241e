"""A seam is a curve by its own arc length, straight beyond its ends."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.welding.seam import curve
from weldcal.welding.seam.curve import NonFiniteSeamPoints, RepeatedSeamPoints, SeamCurve, SeamError, TooFewSeamPoints

R = 0.060


def arc(turn: float = 1.5, n: int = 91) -> SeamCurve:
    """A left-turning arc of radius R from the origin along x."""
    a = np.linspace(0.0, turn, n)
    return SeamCurve.from_points(np.column_stack([R * np.sin(a), R - R * np.cos(a), 0.0 * a]))


def test_an_arc_has_its_length_curvature_and_directions() -> None:
    seam = arc()
    # A cubic through points 1 mm apart misses an R60 arc by h^4/(384 R^3) = 1e-11 m; its ends are worse.
    assert seam.length == pytest.approx(R * 1.5, abs=1e-7)
    s = np.linspace(0.01, 0.08, 15)
    a = s / R
    np.testing.assert_allclose(seam.position(s)[:, 0], R * np.sin(a), atol=1e-7)
    np.testing.assert_allclose(seam.tangent(s), np.column_stack([np.cos(a), np.sin(a), 0 * a]), atol=1e-4)
    np.testing.assert_allclose(seam.normal(s), np.column_stack([-np.sin(a), np.cos(a), 0 * a]), atol=1e-4)
    np.testing.assert_allclose(seam.curvature(s), 1.0 / R, rtol=1e-2)


def test_arc_length_is_the_parameter() -> None:
    seam = arc()
    s = np.linspace(0.0, seam.length, 2001)
    steps = np.linalg.norm(np.diff(seam.position(s), axis=0), axis=1)
    np.testing.assert_allclose(steps, s[1] - s[0], rtol=1e-4)


def test_beyond_its_ends_a_seam_goes_straight_on() -> None:
    seam = arc()
    for s, end in ((-0.03, 0.0), (seam.length + 0.03, seam.length)):
        expected = seam.position(end) + (s - end) * seam.tangent(end)
        np.testing.assert_allclose(seam.position(s), expected, atol=1e-12)
        assert float(seam.curvature(s)) == 0.0


def test_a_seam_cut_short_of_its_groove_ends_there_and_the_curve_goes_on() -> None:
    whole = arc()
    points = whole.position(np.linspace(0.0, whole.length, 91))
    cut = SeamCurve.from_points(points, length=0.04)
    moved = RigidTransform(RollPitchYaw(0.2, -0.1, 0.7), np.array([0.3, 0.1, -0.2]))
    for seam, radius in ((cut, R), (cut.transformed(moved), R), (cut.raised(0.003, 0.010), R - 0.010)):
        assert seam.length == pytest.approx(0.04 * radius / R, abs=1e-5)
        assert seam.drawn_m == pytest.approx(1.5 * radius, abs=1e-5)
        np.testing.assert_allclose(seam.curvature(np.array([0.03, 0.06])), 1.0 / radius, rtol=1e-2)
    np.testing.assert_allclose(cut.position(0.07), whole.position(0.07), atol=1e-7)
    assert SeamCurve.from_points(points, length=0.2).length == pytest.approx(whole.length, abs=1e-7), (
        "longer than drawn"
    )
    smooth = SeamCurve.from_points(points, smoothing=1e-9, length=0.04)
    assert smooth.length == pytest.approx(0.04, abs=1e-4)
    assert smooth.drawn_m > 0.08


def test_one_frame_says_what_the_vectorised_functions_say() -> None:
    seam = arc()
    for s in (-0.01, 0.0, 0.0213, seam.length, seam.length + 0.02):
        frame = seam.frame(s)
        np.testing.assert_allclose(frame.position, seam.position(s), atol=1e-12)
        np.testing.assert_allclose(frame.tangent, seam.tangent(s), atol=1e-12)
        np.testing.assert_allclose(frame.normal, seam.normal(s), atol=1e-12)
        np.testing.assert_allclose(frame.up, seam.up(s), atol=1e-12)
        assert frame.curvature == pytest.approx(float(seam.curvature(s)), abs=1e-9)


def test_projection_finds_the_foot_of_a_point_beside_the_seam() -> None:
    seam = arc()
    s = np.linspace(-0.02, seam.length + 0.02, 23)
    beside = seam.position(s) + 0.004 * seam.normal(s) + 0.010 * seam.up(s)
    np.testing.assert_allclose(seam.project(beside), s, atol=1e-7)
    np.testing.assert_allclose(seam.project(beside, s + 0.003, 0.008), s, atol=1e-7)
    for value, point in zip(s, beside, strict=True):
        assert seam.nearest(point, value + 0.002) == pytest.approx(value, abs=1e-6)


def test_projection_stays_in_its_window_where_the_seam_comes_back() -> None:
    a = np.linspace(0.0, math.pi, 181)
    u_turn = SeamCurve.from_points(np.column_stack([0.01 * np.sin(a), 0.01 - 0.01 * np.cos(a), 0.0 * a]))
    near_the_end = u_turn.position(u_turn.length - 0.002)
    assert float(u_turn.project(near_the_end, 0.003, 0.005)) <= 0.008 + 1e-12


def test_a_moved_seam_is_the_seam_of_the_moved_points() -> None:
    X = RigidTransform(RollPitchYaw(0.3, -0.2, 1.1), [0.4, -0.1, 0.2])
    seam = arc()
    moved, s = seam.transformed(X), np.linspace(-0.01, 0.1, 12)
    np.testing.assert_allclose(moved.position(s), [X @ p for p in seam.position(s)], atol=1e-12)
    np.testing.assert_allclose(moved.normal(s), seam.normal(s) @ X.rotation().matrix().T, atol=1e-12)


def test_up_follows_a_bent_surface() -> None:
    a = np.linspace(-0.5, 0.5, 101)
    points = 0.3 * np.column_stack([np.sin(a), 0.0 * a, np.cos(a)])
    seam = SeamCurve.from_points(points, points)
    s = np.linspace(0.0, seam.length, 9)
    np.testing.assert_allclose(seam.up(s), seam.position(s) / 0.3, atol=1e-4)
    # A line raised over a convex surface is longer by height times the turn.
    assert seam.raised(0.01).length == pytest.approx(seam.length + 0.01 * 1.0, abs=1e-6)


def test_smoothing_takes_the_noise_of_a_scan_off() -> None:
    x = np.linspace(0.0, 0.3, 301)
    noise = np.random.default_rng(3).normal(0.0, 0.2e-3, (301, 3))
    rough = np.column_stack([x, 0.0 * x, 0.0 * x]) + noise * [0.1, 1.0, 1.0]
    smooth = SeamCurve.from_points(rough, smoothing=1e-7)
    raw = SeamCurve.from_points(rough)
    s = np.linspace(0.02, 0.28, 200)
    # 1 mm spacing and 1e-7 m^3: about (1e-7/1e-3)^(1/4) = 0.1 m of memory, so noise falls far below half.
    assert np.std(smooth.position(s)[:, 1]) < 0.5 * np.std(raw.position(s)[:, 1])
    assert np.abs(smooth.curvature(s)).max() < 0.1 * np.abs(raw.curvature(s)).max()


@pytest.mark.parametrize(
    ("points", "error"),
    [
        (np.zeros((3, 3)), TooFewSeamPoints),
        (np.zeros((5, 3)), RepeatedSeamPoints),
        (np.column_stack([[0.0, 1.0, np.nan, 3.0], np.zeros(4), np.zeros(4)]), NonFiniteSeamPoints),
        (np.zeros((5, 2)), SeamError),
        (np.column_stack([np.zeros(4), np.zeros(4), np.arange(4.0)]), SeamError),  # runs along its own up
    ],
)
def test_points_that_make_no_seam_are_named(points: np.ndarray, error: type[Exception]) -> None:
    with pytest.raises(error):
        SeamCurve.from_points(points)


def test_a_seam_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        arc().knots[0] = 1.0


def test_no_tick_compiles_a_loop_of_the_seam() -> None:
    loops = (curve._frame_numbers, curve._least_radius, curve._nearest)
    loaded = [list(loop.signatures) for loop in loops]  # type: ignore[attr-defined]
    seam = arc().raised(1e-3).transformed(RigidTransform([0.1, 0.0, 0.0]))
    seam.frame(0)
    seam.frame(np.float64(0.01))
    seam.nearest(np.zeros(3), 0)
    seam.least_radius(0.02, 5e-3)
    assert [list(loop.signatures) for loop in loops] == loaded  # type: ignore[attr-defined]
    assert all(loaded)


def test_the_frame_of_no_number_is_none_and_no_place_outside_the_seam_is_read() -> None:
    assert math.isnan(arc().frame(math.nan).position[0])
    assert math.isnan(arc().nearest(np.array([math.nan, 0.0, 0.0]), 0.01))
