"""A corner that the tip sprang across is put back from the two sides it felt."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.worlds.weld.seams import arcs
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.refinement import (
    CornerConfig,
    RefinedSeam,
    RefinementConfig,
    fill_corner,
    is_jump,
    local_fit,
    refine,
)

MM = 1e-3
CONFIG = CornerConfig()


def sides(turn_deg: float, hole: float, step: float = 0.27 * MM, n: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Points on two straight sides that would meet in the origin, each ending `hole` short of it."""
    a = math.radians(turn_deg)
    t, w = np.array([1.0, 0.0, 0.0]), np.array([math.cos(a), math.sin(a), 0.0])
    along = hole + step * np.arange(n)
    return -along[::-1, None] * t, along[:, None] * w


@pytest.mark.parametrize("turn_deg", [45.0, 90.0, -90.0, 120.0])
def test_the_sides_are_prolonged_to_a_rounded_corner(turn_deg: float) -> None:
    before, after = sides(turn_deg, 2.0 * MM)
    corner = fill_corner(before, after, CONFIG)
    assert corner is not None
    # The tangent length r tan(turn/2) is cut short where the hole is shorter than it.
    tangent = min(CONFIG.radius_m * math.tan(math.radians(abs(turn_deg)) / 2.0), 2.0 * MM)
    radius = tangent / math.tan(math.radians(abs(turn_deg)) / 2.0)
    assert corner.length == pytest.approx(2.0 * (2.0 * MM - tangent) + radius * math.radians(abs(turn_deg)), abs=1e-9)
    # The rounding passes the apex at r (1/cos(turn/2) - 1).
    nearest = np.linalg.norm(corner.points, axis=1).min()
    assert nearest == pytest.approx(radius * (1.0 / math.cos(math.radians(turn_deg) / 2.0) - 1.0), abs=0.02 * MM)
    steps = np.linalg.norm(np.diff(np.vstack([before[-1], corner.points, after[0]]), axis=0), axis=1)
    assert steps.max() <= CONFIG.spacing_m + 1e-9


def test_noise_on_the_sides_moves_the_corner_by_little_more_than_itself() -> None:
    rng = np.random.default_rng(0)
    off = []
    for _ in range(200):
        before, after = sides(90.0, 2.0 * MM)
        noise = rng.normal(0.0, 0.05 * MM, (2, 20, 3))
        exact = fill_corner(before, after, CONFIG)
        felt = fill_corner(before + noise[0], after + noise[1], CONFIG)
        assert exact is not None
        assert felt is not None
        middle = [c.points[np.argmin(np.abs(c.along - c.middle))] for c in (exact, felt)]
        off.append(np.linalg.norm(middle[1][:2] - middle[0][:2]))
    # A line through 20 points over 5.4 mm, carried on by its 2 mm hole and half its length: sigma about 0.05 sqrt(1/20
    # + 4.7^2/(20 1.6^2)) = 0.04 mm a side; and the samples of the corner are 0.2 mm apart.
    assert np.percentile(off, 95) < 0.25 * MM


def test_what_makes_no_corner_is_left_alone() -> None:
    before, after = sides(90.0, 2.0 * MM)
    assert fill_corner(*sides(15.0, 2.0 * MM), CONFIG) is None  # a bend, not a corner
    assert fill_corner(before[-3:], after, CONFIG) is None  # too few points to know a side
    assert fill_corner(*sides(90.0, 9.0 * MM), CONFIG) is None  # too far to be a tip's spring
    assert fill_corner(after[::-1], before[::-1], CONFIG) is not None  # the way back is a corner as well
    assert fill_corner(before, after - np.array([0.0, 5.0 * MM, 0.0]), CONFIG) is None  # the sides have crossed already


def test_a_hole_is_a_step_much_longer_than_the_ones_before_it() -> None:
    steady = np.column_stack([0.27 * MM * np.arange(6), np.zeros(6), np.zeros(6)])
    assert not is_jump(steady, steady[-1] + np.array([0.27 * MM, 0.0, 0.0]), CONFIG)
    assert is_jump(steady, steady[-1] + np.array([1.5 * MM, 2.0 * MM, 0.0]), CONFIG)
    fast = 5.0 * steady  # 40 mm/s: every step is as long as that
    assert not is_jump(fast, fast[-1] + np.array([1.5 * MM, 0.0, 0.0]), CONFIG)
    assert not is_jump(steady, steady[-1] + np.array([20.0 * MM, 0.0, 0.0]), CONFIG)  # a gap in the work


def test_a_seam_felt_on_both_sides_of_a_corner_is_whole_again() -> None:
    before, after = sides(90.0, 2.0 * MM, n=40)
    seam, config = RefinedSeam.empty(), RefinementConfig(frames_to_commit=0)
    for k, point in enumerate(np.vstack([before, after])):
        seam = refine(seam, point, 0.27 * MM * k, config)
    assert seam.jump is None
    assert len(seam.corners) == 1
    # Arc length along the points is arc length along the path: nothing is squeezed where the tip sprang.
    steps = np.linalg.norm(np.diff(seam.points, axis=0), axis=1)
    np.testing.assert_allclose(np.diff(seam.arc), steps, atol=0.05 * MM)
    assert np.all(np.diff(seam.arc) > 0.0)
    fit = local_fit(seam, float(seam.corners[0]), np.array([0.7, 0.7, 0.0]), 4.0 * MM, config)
    assert fit is not None
    # In the corner's middle the fit is within a tenth of a millimetre of the rounding and heads diagonally.
    apex = CONFIG.radius_m * (math.sqrt(2.0) - 1.0) * np.array([-1.0, 1.0, 0.0]) / math.sqrt(2.0)
    np.testing.assert_allclose(fit.point, apex, atol=0.1 * MM)
    assert math.degrees(math.atan2(fit.tangent[1], fit.tangent[0])) == pytest.approx(45.0, abs=8.0)


def test_where_the_plan_has_no_corner_a_hole_is_left_to_it() -> None:
    before, after = sides(40.0, 1.5 * MM, n=40)
    seam, config = RefinedSeam.empty(), RefinementConfig(frames_to_commit=0)
    for k, point in enumerate(np.vstack([before, after])):
        seam = refine(seam, point, 0.27 * MM * k, config, is_corner=False)
    assert len(seam) == 80
    assert len(seam.corners) == 0
    # The parameter still grows by what the tip sprang, so that bridging it on the plan is right.
    hole = float(np.linalg.norm(after[0] - before[-1]))
    assert seam.arc[40] - seam.arc[39] == pytest.approx(hole, abs=1e-9)
    curve = SeamCurve.from_points(arcs((0.03, 0.0), (0.03, 50.0), (0.03, 0.0)))
    assert curve.least_radius(0.045, 8.0 * MM) == pytest.approx(0.020, rel=0.05)
    assert curve.least_radius(0.026, 8.0 * MM) == pytest.approx(0.020, rel=0.05)
    assert curve.least_radius(0.010, 8.0 * MM) > 1.0
