"""A scanner that moved during the recording is found, with the place and the size of the change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from tests.calibration.eye_on_base.test_joint_fit import NOISE_M, RIGHT, WRONG, _cell
from tests.calibration.eye_on_base.test_solve import make_observations
from tests.worlds.wrong_models import warped_observations
from weldcal.calibration.eye_on_base.change_point import find_change
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation


def moved(observations: list[Observation], at: int, shift_m: float, turn_deg: float = 0.0) -> list[Observation]:
    """The same recording with a scanner that was knocked before its observation ``at``."""
    D = RigidTransform(
        RotationMatrix(exp_rotation(np.radians(turn_deg) * np.array([0.6, -0.8, 0.0]))),
        shift_m * np.array([0.6, 0.0, 0.8]),
    )
    return [o if k < at else replace(o, p_CR=D @ o.p_CR, n_C=D.rotation() @ o.n_C) for k, o in enumerate(observations)]


@pytest.mark.parametrize(("shift_m", "turn_deg"), [(1e-3, 0.0), (2e-3, 0.1), (0.0, 0.3), (0.02, 2.0), (0.1, 10.0)])
def test_a_knock_is_found_where_it_was(shift_m: float, turn_deg: float) -> None:
    for seed in range(4):
        observations, _ = _cell(WRONG, n=18, seed=seed)
        at = 5 + 3 * seed if seed < 3 else 9
        change = find_change(moved(observations, at, shift_m, turn_deg))
        assert change is not None
        assert (change.before, change.after) == (f"p{at - 1:02d}", f"p{at:02d}")
        assert np.degrees(change.rotation_rad) == pytest.approx(turn_deg, abs=0.12)
        if turn_deg == 0.0:
            assert change.shift_m == pytest.approx(shift_m, abs=2.5 * NOISE_M)


def test_recordings_without_a_change_show_none() -> None:
    """Also from near to far or from left to right, with a scanner that is off by what no polynomial describes."""
    for seed in range(12):
        n = (9, 12, 18, 30)[seed % 4]
        observations, _ = _cell(WRONG if seed % 2 else RIGHT, n=n, seed=seed)
        assert find_change(sorted(observations, key=lambda o: float(o.p_CR[seed % 3]))) is None
    for device in range(3):
        observations, _ = warped_observations(device, 18, 0)
        assert find_change(sorted(observations, key=lambda o: float(o.p_CR[device % 3]))) is None


def test_single_wrong_poses_are_no_change() -> None:
    observations, _ = _cell(RIGHT, n=14, seed=2)
    for k in (3, 11, 12):
        observations[k] = replace(observations[k], p_CR=observations[k].p_CR + np.array([0.0, 0.01 * k, 0.02]))
    assert find_change(observations) is None


def test_eight_poses_are_too_few() -> None:
    observations, _ = _cell(RIGHT, n=8)
    assert find_change(moved(observations, 4, 0.05)) is None


@pytest.mark.parametrize(("shift_m", "found"), [(6e-5, False), (3e-4, True)])
def test_a_shift_within_what_arms_repeat_to_is_no_reason_to_refuse(shift_m: float, found: bool) -> None:
    observations = make_observations(18, 3, sigma=1e-5)
    assert (find_change(moved(observations, 8, shift_m)) is not None) == found
