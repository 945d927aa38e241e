"""Thousands of poses: time that grows with their number, and figures that are those of each pose held out."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from tests.calibration.eye_on_base.test_change_point import moved
from tests.calibration.eye_on_base.test_solve import X_BC, displaced, make_observations, tangent_error
from weldcal.calibration.eye_on_base.change_point import find_change
from weldcal.calibration.eye_on_base.solve import estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import bootstrap_interval, k_fold


def seconds(task: Callable[[], object]) -> float:
    """Processor time of a task that has run once before."""
    begin = time.process_time()
    task()
    return time.process_time() - begin


def test_time_grows_with_the_number_of_poses() -> None:
    few, many = make_observations(500, 1), make_observations(3000, 1)
    for task in (estimate_eye_on_base, find_change, lambda o: k_fold(o, repeats=1)):
        task(few[:200])
        # the square of the number would be 36 times as much
        assert seconds(lambda task=task: task(many)) < 15.0 * seconds(lambda task=task: task(few)) + 0.2


def test_groups_are_held_out_like_single_poses() -> None:
    observations = make_observations(150, 4)
    observations[7] = displaced(observations[7], np.array([0.02, 0.0, 0.01]))
    found = estimate_eye_on_base(observations)
    assert np.flatnonzero(~found.inliers).tolist() == [7]
    rest = [o for o in observations if o.id not in ("p7", "p20")]
    X = estimate_eye_on_base(rest).X_BC
    o = observations[20]
    alone = float(np.linalg.norm(X @ o.p_CR - o.X_BR.translation()))
    assert found.held_out.position_m[20] == pytest.approx(alone, abs=1e-5)
    # a pose has an error of its own, and 149 poses share six unknowns
    assert found.held_out.position_m[found.inliers].mean() > found.position_residuals_m[found.inliers].mean()
    assert found.held_out.position_m[7] == pytest.approx(np.hypot(0.02, 0.01), rel=0.05)


def test_outliers_of_many_poses_are_found_by_a_start_from_some() -> None:
    observations = make_observations(3000, 5)
    rng = np.random.default_rng(0)
    wrong = np.sort(rng.permutation(3000)[:1050])
    for k in wrong:
        observations[k] = displaced(observations[k], 0.05 * rng.normal(size=3) + 0.02)
    found = estimate_eye_on_base(observations)
    assert np.flatnonzero(~found.inliers).tolist() == wrong.tolist()
    assert np.abs(tangent_error(found.X_BC)).max() < 1e-4


def test_a_change_among_many_poses_is_found_where_it_was() -> None:
    change = find_change(moved(make_observations(3000, 6), 1234, 0.005))
    assert change is not None
    assert change.index == pytest.approx(1234, abs=2)
    assert change.X_BC_before.IsNearlyEqualTo(X_BC, 1e-3)


def test_an_interval_of_many_errors_takes_little_memory() -> None:
    errors = np.random.default_rng(0).rayleigh(size=8000)
    tracemalloc.start()
    low, high = bootstrap_interval(errors) or (np.nan, np.nan)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
    # the standard error of a median is 1 / (2 f sqrt(n)), and two medians are compared
    width = 1.96 * np.sqrt(2.0) / (2.0 * 0.5 * np.sqrt(2.0 * np.log(2.0)) * np.sqrt(8000))
    assert high - low == pytest.approx(2.0 * width, rel=0.1)
