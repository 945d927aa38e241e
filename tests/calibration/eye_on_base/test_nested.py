"""Held-out errors repeat the choice of the scanner's correction, and their mean has an interval of its own."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.calibration.eye_on_base.test_self_calibration import BENT, _cell
from weldcal.calibration.eye_on_base import nested
from weldcal.calibration.eye_on_base.corrected_estimate import apply_self_calibration
from weldcal.calibration.eye_on_base.nested import calibrate_by_choice, mean_interval, nested_errors
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.eye_on_base.solve import estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors


def test_every_error_is_that_of_a_choice_made_without_the_pose() -> None:
    observations, patterns = _cell(BENT, n=10, seed=3)
    errors, _ = nested_errors(observations, patterns)
    for i in (0, 7):
        rest = [o for k, o in enumerate(observations) if k != i]
        X, correction = calibrate_by_choice(rest, patterns)
        assert errors[i] == pytest.approx(position_errors(X, [corrected_observation(correction, observations[i])])[0])


def test_the_reported_errors_are_the_nested_ones() -> None:
    observations, patterns = _cell(BENT, n=10, seed=4)
    expected, _ = nested_errors(observations, patterns)
    scanner, _, estimate = apply_self_calibration(observations, estimate_eye_on_base(observations), patterns)
    assert scanner is not None
    assert scanner.accepted is not None
    assert estimate.held_out.position_m == pytest.approx(expected)
    # without one of the poses another correction is chosen, which the errors that chose it do not show
    assert np.abs(scanner.held_out_m - expected).max() > 1e-4


def test_many_poses_are_held_out_in_folds(monkeypatch: pytest.MonkeyPatch) -> None:
    observations, patterns = _cell(BENT, n=24, seed=1)
    sizes = []

    def choose(rest: list[object], *_: object, **__: object) -> tuple[RigidTransform, object]:
        sizes.append(len(rest))
        raise nested.InputError("not this time")

    monkeypatch.setattr(nested, "calibrate_by_choice", choose)
    errors, _ = nested_errors(observations, patterns)
    assert sorted(set(sizes)) == [22, 23]
    assert len(sizes) == 20
    assert np.isnan(errors).all()


def test_the_interval_holds_the_mean_of_as_many_new_errors() -> None:
    """Errors in space are distributed as chi with three degrees of freedom; with other scatters they are not normal either."""
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(2000):
        seen, new = 1e-4 * np.linalg.norm(rng.standard_normal((2, 18, 3)), axis=2)
        low, high = mean_interval(seen) or (np.nan, np.nan)
        inside.append(low < new.mean() < high)
    # 95 % of 2000, and the skew of the errors, which the logarithm does not remove wholly
    assert 0.935 < np.mean(inside) < 0.965


def test_three_errors_have_no_interval() -> None:
    assert mean_interval(np.array([1.0, 2.0, 3.0, np.nan])) is None
    assert mean_interval(np.array([1.0, 2.0, 3.0, 4.0])) is not None
