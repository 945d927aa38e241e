"""How far a stated pose is off, and its sigma, against worlds whose truth is drawn here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.stats import chi2

from tests.calibration.eye_on_base import test_left_uncorrected as worlds
from weldcal.calibration.eye_on_base.validation import offset_from
from weldcal.calibration.flange.observation import Observation

WORLDS, MOVED_M = 60, np.array([8e-4, -5e-4, 3e-4])
ARM_M, TURN_RAD = 2e-4, 5e-4  # errors of the arm's poses, standard deviations


def shown(seed: int, n: int) -> tuple[RigidTransform, list[Observation], NDArray[np.float64]]:
    """A stated X_BC that is displaced and turned, n observations by an arm with errors, and the true offset (3,) m of
    the middle of what the scanner shows."""
    truth, observations = worlds.world(seed)
    rng = np.random.default_rng(1000 + seed)
    turned = RollPitchYaw(rng.normal(0.0, 1e-3, 3)).ToRotationMatrix() @ truth.rotation()
    stated = RigidTransform(turned, truth.translation() + MOVED_M)
    seen = []
    for o in observations[:n]:
        turn = RollPitchYaw(rng.normal(0.0, TURN_RAD, 3)).ToRotationMatrix()
        X = RigidTransform(o.X_BR.rotation() @ turn, o.p_BR + rng.normal(0.0, ARM_M, 3))
        seen.append(replace(o, X_BR=X))
    middle = np.mean([o.p_CR for o in seen], axis=0)
    return stated, seen, stated @ middle - np.mean([o.p_BR for o in observations[:n]], axis=0)


def squares(n: int) -> NDArray[np.float64]:
    """Squared errors of the offset in units of its covariance (WORLDS,)."""
    found = []
    for seed in range(WORLDS):
        stated, seen, true_shift = shown(seed, n)
        offset = offset_from(stated, seen)
        assert offset is not None
        error = offset.shift_m - true_shift
        found.append(float(error @ np.linalg.solve(offset.covariance, error)))
    return np.array(found)


@pytest.mark.parametrize("n", [6, 12])
def test_the_stated_sigma_is_that_of_the_offset(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "SCALE", 0.0)
    monkeypatch.setattr(worlds, "GRADIENT_PER_M", 0.0)
    found = squares(n)
    assert np.mean(found < chi2.ppf(0.95, 3)) >= 0.85
    assert 1.5 < found.mean() < 6.0  # 3 where the covariance is right; a sigma four times off gives 48 or 0.2


def test_a_scanner_with_a_wrong_scale_widens_the_sigma() -> None:
    found = squares(12)
    assert np.mean(found < chi2.ppf(0.95, 3)) >= 0.95
    assert found.mean() > 0.4  # and not by four


def test_the_middle_the_turn_and_too_few_scans() -> None:
    stated, seen, _ = shown(3, 12)
    found = offset_from(stated, seen)
    assert found is not None
    assert found.p_BQ == pytest.approx(np.mean([o.p_BR for o in seen], axis=0), abs=1e-3)
    assert 1e-4 < found.turn_rad < 1e-2
    assert found.sigma_m == pytest.approx(float(np.sqrt(np.linalg.norm(found.covariance, 2))))
    assert offset_from(stated, seen[:3]) is None
