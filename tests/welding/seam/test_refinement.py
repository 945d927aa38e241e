"""A tactile point becomes part of the seam once later frames have shown that the tip was touching."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.plan_fit import PlanFit, PlanFitConfig, add_point
from weldcal.welding.seam.refinement import RefinedSeam, RefinementConfig, drop_pending, local_fit, refine, tip_point

CONFIG = RefinementConfig()
X_AXIS = np.array([1.0, 0.0, 0.0])


def felt(points: np.ndarray, arc: np.ndarray) -> RefinedSeam:
    """A seam grown point by point."""
    seam = RefinedSeam.empty()
    for p, s in zip(points, arc, strict=True):
        seam = refine(seam, p, float(s), CONFIG)
    return seam


def test_the_tip_is_the_tool_plus_its_deflection_turned_into_the_base() -> None:
    # P_s = P_r - delta with delta = -R deflection: a tip pushed back along the tool's x lies behind the tool.
    X_BT = RigidTransform(RollPitchYaw(0.0, 0.0, np.pi / 2), [0.4, 0.1, 0.2])
    np.testing.assert_allclose(tip_point(X_BT, np.array([-0.001, 0.002, 0.003])), [0.398, 0.099, 0.203], atol=1e-12)


def test_a_point_waits_for_four_further_frames() -> None:
    seam = RefinedSeam.empty()
    for k in range(4):
        seam = refine(seam, np.array([k * 1e-3, 0.0, 0.0]), k * 1e-3, CONFIG)
    assert len(seam) == 0
    seam = refine(seam, np.array([4e-3, 0.0, 0.0]), 4e-3, CONFIG)
    np.testing.assert_allclose(seam.points, [[0.0, 0.0, 0.0]])


def test_what_was_pending_when_contact_went_is_never_committed() -> None:
    seam = felt(np.zeros((5, 3)) + np.arange(5)[:, None] * [1e-3, 0.0, 0.0], np.arange(5) * 1e-3)
    falling = refine(seam, np.array([5e-3, -2e-3, 0.0]), 5e-3, CONFIG)
    after = drop_pending(falling)
    for k in range(6, 11):
        after = refine(after, np.array([k * 1e-3, 0.0, 0.0]), k * 1e-3, CONFIG)
    assert np.all(after.points[:, 1] == 0.0)


def test_refining_leaves_the_earlier_seam_as_it_was() -> None:
    first = felt(np.zeros((6, 3)) + np.arange(6)[:, None] * [1e-3, 0.0, 0.0], np.arange(6) * 1e-3)
    points, pending = first.points.copy(), first.pending
    refine(first, np.ones(3), 1.0, CONFIG)
    np.testing.assert_array_equal(first.points, points)
    assert first.pending == pending


def test_points_that_make_no_progress_are_left_out() -> None:
    seam = felt(np.random.default_rng(0).normal(0, 1e-4, (20, 3)), np.zeros(20))
    assert len(seam) == 1


def test_the_local_fit_is_the_curve_and_far_smoother_than_its_points() -> None:
    rng = np.random.default_rng(1)
    arc = np.arange(0.0, 0.06, 8e-3 / 30.0)
    a = arc / 0.060
    curve = 0.060 * np.column_stack([np.sin(a), 1.0 - np.cos(a), 0.0 * a])
    seam = felt(curve + rng.normal(0.0, 0.05e-3, curve.shape), arc)
    gaps, turns = [], []
    for s in np.arange(0.01, 0.05, 0.002):
        fit = local_fit(seam, float(s), X_AXIS, 0.060, CONFIG)
        assert fit is not None
        t = np.array([np.cos(s / 0.060), np.sin(s / 0.060), 0.0])
        n = np.array([-t[1], t[0], 0.0])
        gaps.append((fit.point - 0.060 * np.array([np.sin(s / 0.06), 1.0 - np.cos(s / 0.06), 0.0])) @ n)
        turns.append(np.arcsin(fit.tangent @ n))
    # About 20 effective points at sigma 1.5 mm: 0.05/sqrt(20)*1.5 (a quadratic costs half again) = 0.017 mm.
    assert np.std(gaps) < 0.03e-3
    # Neighbour differences would give 0.05*sqrt 2/0.27 = 15 deg; the fit about 0.05/1.5/sqrt(20) = 0.5 deg, plus ridge.
    assert np.degrees(np.std(turns)) < 1.5


def test_a_straight_seam_with_no_noise_is_fitted_exactly() -> None:
    arc = np.arange(0.0, 0.03, 3e-4)
    seam = felt(np.column_stack([arc, 0.1 * arc, 0.2 * arc]), arc)
    direction = np.array([1.0, 0.1, 0.2])
    fit = local_fit(seam, 0.015, direction, 1e6, CONFIG)
    assert fit is not None
    np.testing.assert_allclose(fit.point, 0.015 * direction, atol=1e-9)
    np.testing.assert_allclose(fit.tangent, direction / np.linalg.norm(direction), atol=1e-6)


@pytest.mark.parametrize("radius", [0.020, 0.060])
def test_the_bend_of_the_fit_is_that_of_the_curve(radius: float) -> None:
    """A circle's second derivative by its arc is 1/R towards the centre."""
    arc = np.arange(0.0, 0.03, 8e-3 / 30.0)
    a = arc / radius
    seam = felt(radius * np.column_stack([np.sin(a), 1.0 - np.cos(a), 0.0 * a]), arc)
    at = 0.015 / radius
    fit = local_fit(seam, 0.015, np.array([np.cos(at), np.sin(at), 0.0]), radius, CONFIG)
    assert fit is not None
    np.testing.assert_allclose(fit.bend, np.array([-np.sin(at), np.cos(at), 0.0]) / radius, atol=0.05 / radius)


def test_there_is_no_fit_where_nothing_was_felt() -> None:
    arc = np.concatenate([np.arange(0.0, 0.02, 3e-4), np.arange(0.05, 0.07, 3e-4)])
    seam = felt(np.column_stack([arc, 0 * arc, 0 * arc]), arc)
    assert local_fit(seam, 0.035, X_AXIS, 1e6, CONFIG) is None
    assert local_fit(RefinedSeam.empty(), 0.0, X_AXIS, 1e6, CONFIG) is None


def test_a_tip_that_is_held_up_does_not_advance_the_path() -> None:
    # 10 mm at full progress, 3 mm of progress at a fifth of the way, 10 mm at full progress: 10 + 0.6 + 10 mm of path.
    x = (
        np.concatenate(
            [np.arange(0.0, 10.0, 0.25), 10.0 + np.arange(0.0, 0.6, 0.05), 10.6 + np.arange(0.0, 10.0, 0.25)]
        )
        * 1e-3
    )
    arc = 0.25e-3 * np.arange(len(x))
    # The way is the mean over six frames, and it counts where it is under half of the progress of 0.25 mm: from the
    # fourth of the twelve slow frames on (0.117 and 0.083 mm, then seven of 0.05 mm) to the second quick one (0.083 and
    # 0.117 mm).
    expected = -(2.0 * (0.25 - 0.7 / 6.0) + 2.0 * (0.25 - 0.5 / 6.0) + 7.0 * 0.20) * 1e-3
    assert felt(np.column_stack([x, 0 * x, 0 * x]), arc).jumped == pytest.approx(expected, abs=1e-9)
    noise = np.random.default_rng(3).normal(0.0, 0.05e-3, (len(x), 2))
    seam = felt(np.column_stack([x, noise]), arc)
    # Sideways noise lengthens a way of 0.3 mm by 0.1^2/(2 0.3) in the mean, a sixth of that a frame: 0.03 mm in eleven.
    assert seam.jumped == pytest.approx(expected, abs=0.1e-3)
    assert np.all(np.diff(seam.arc) > 0.0)
    # What comes after a gap of 30 mm is no tip that was held up.
    on = np.concatenate([np.arange(0.0, 10e-3, 0.25e-3), np.arange(40e-3, 50e-3, 0.25e-3)])
    assert felt(np.column_stack([on, 0 * on, 0 * on]), on).jumped == 0.0


def test_the_torch_heads_where_the_fitted_point_goes() -> None:
    # A straight runs into a bend of 20 mm: there the fit's slope is 0.2 sigma/R = 0.9 deg off the way of its own point.
    arc = np.arange(0.0, 0.04, 2e-4)
    a = np.maximum(arc - 0.02, 0.0) / 0.020
    line = np.column_stack([np.minimum(arc, 0.02) + 0.020 * np.sin(a), 0.020 * (1.0 - np.cos(a)), 0 * arc])
    seam = felt(line, arc)
    h = 0.1e-3
    for s in (0.018, 0.0195, 0.020, 0.0205, 0.022):
        ahead, here, behind = (local_fit(seam, s + k * h, X_AXIS, 0.1, CONFIG) for k in (1.0, 0.0, -1.0))
        assert ahead is not None
        assert here is not None
        assert behind is not None
        way = (ahead.point - behind.point) / np.linalg.norm(ahead.point - behind.point)
        # What is left is the ridge, 0.2 of about 20 points, on the slope's difference from the plan's, at most 6 deg.
        assert np.degrees(np.arcsin(np.linalg.norm(np.cross(way, here.tangent)))) < 0.15


def moved_plan(shift: np.ndarray, angle: float) -> tuple[SeamCurve, np.ndarray]:
    """An S-shaped plan, and the true points of the same seam moved by a small rigid motion."""
    x = np.linspace(0.0, 0.15, 151)
    points = np.column_stack([x, 0.015 * np.sin(x / 0.03), 0.0 * x])
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    middle = points[75]
    return SeamCurve.from_points(points), (points - middle) @ turn.T + middle + shift


def test_the_plan_is_moved_onto_what_the_tip_felt() -> None:
    plan, true = moved_plan(np.array([0.5e-3, 2.0e-3, -0.7e-3]), np.radians(0.5))
    fit = PlanFit.start(plan)
    for k in range(0, 151, 2):
        fit = add_point(fit, true[k], float(plan.project(true[k])), PlanFitConfig())
    # The curve bends both ways, so all four are seen; the prior (1 deg, 3 mm) still holds back a few per cent.
    truth = SeamCurve.from_points(true)
    s = np.linspace(0.01, 0.14, 40)
    gap = fit.curve.position(truth.project(fit.curve.position(s))) - truth.position(s)
    across = np.sum((truth.position(truth.project(fit.curve.position(s))) - fit.curve.position(s)) ** 2, axis=1) ** 0.5
    assert np.isfinite(gap).all()
    assert across.max() < 0.15e-3


def test_along_a_straight_seam_the_plan_does_not_wander() -> None:
    x = np.linspace(0.0, 0.15, 76)
    plan = SeamCurve.from_points(np.column_stack([x, 0 * x, 0 * x]))
    rng = np.random.default_rng(2)
    fit = PlanFit.start(plan)
    for value in x:
        point = np.array([value, 2e-3, 0.0]) + rng.normal(0.0, 0.1e-3, 3)
        fit = add_point(fit, point, float(value), PlanFitConfig())
    # Along-track cannot be seen: without a real prior it wandered by 15 mm.
    assert abs(fit.parameters[1]) < 0.2e-3
    # 19 independent pieces of 0.3 mm against a prior of 3 mm leave 1/1900 of the 2 mm shift.
    assert abs(fit.parameters[2] - 2e-3) < 0.1e-3
