"""A calibration shifted by what new scans show: better where it was off, left alone where it was not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.worlds.wrong_models import simulated_observations
from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.stated_error import estimate_result
from weldcal.calibration.eye_on_base.validation import offset_from
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.verified_scans import shifted_result

SCANS, NEW, SETS = 14, 10, 100
CONFIG = SolveConfig(leave_one_out=False, hypotheses=60)


def world(seed: int) -> tuple[CalibrationResult, list[Observation], RigidTransform]:
    """A calibration, new observations of the same cell, and the true pose."""
    rng = np.random.default_rng([seed, 59])
    observations, X_BC = simulated_observations(SCANS + NEW, rng)
    found = estimate_eye_on_base(observations[:SCANS], CONFIG)
    return (
        estimate_result(found, observations[:SCANS], (), None, (), held_out_mm={}, tilt_deg={}),
        observations[SCANS:],
        X_BC,
    )


def off(result: CalibrationResult, new: list[Observation], X_BC: RigidTransform) -> float:
    """Error (mm) in the middle of the new scans."""
    p_C = np.mean([o.p_CR for o in new], axis=0)
    return 1e3 * float(np.linalg.norm(result.X_BC @ p_C - X_BC @ p_C))


@pytest.fixture(scope="module")
def sets() -> list[tuple[bool, bool, float, float, float]]:
    """Of 200 sets, half with an offset: whether it had one, whether it was corrected, error before and after, sigma."""
    out = []
    for seed in range(2 * SETS):
        result, new, X_BC = world(seed)
        rng = np.random.default_rng([seed, 60])
        knocked = seed % 2 == 1
        if knocked:
            shift = rng.normal(size=3)
            shift *= rng.uniform(5e-5, 1e-3) / np.linalg.norm(shift)
            result = replace(result, X_BC=RigidTransform(result.X_BC.rotation(), result.X_BC.translation() + shift))
        offset = offset_from(result.X_BC, new)
        assert offset is not None
        corrected, sentence = shifted_result(result, None, new, offset)
        assert sentence
        before = off(result, new, X_BC)
        after = before if corrected is None else off(corrected, new, X_BC)
        out.append((knocked, corrected is not None, before, after, 1e3 * offset.sigma_m))
    return out


def test_a_correction_is_better_than_before_and_rare_where_nothing_is_off(
    sets: list[tuple[bool, bool, float, float, float]],
) -> None:
    corrected = [(before, after) for _, done, before, after, _ in sets if done]
    assert np.mean([after < before for before, after in corrected]) >= 0.95
    assert np.mean([done for knocked, done, *_ in sets if not knocked]) <= 0.05
    assert np.mean([done for knocked, done, *_ in sets if knocked]) >= 0.75, "knocks of 0.05 to 1 mm"


def test_the_error_after_a_correction_is_as_stated(sets: list[tuple[bool, bool, float, float, float]]) -> None:
    squared = [(after / sigma) ** 2 for _, done, _, after, sigma in sets if done]
    # sigma is the largest of the three directions: at most 3 on average, and a third of it if two were known exactly
    assert 0.8 < np.mean(squared) < 3.5


def test_the_covariance_of_the_shifted_pose_is_that_of_the_new_scans_in_their_middle() -> None:
    result, new, _ = world(1)
    X = RigidTransform(result.X_BC.rotation(), result.X_BC.translation() + np.array([2e-3, 0.0, 0.0]))
    offset = offset_from(X, new)
    assert offset is not None
    corrected, sentence = shifted_result(replace(result, X_BC=X), None, new, offset)
    assert corrected is not None
    assert "10 new scans show" in sentence
    p = offset.p_BQ - corrected.X_BC.translation()
    J = np.hstack([-np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]]), np.eye(3)])
    assert J @ corrected.covariance @ J.T == pytest.approx(offset.covariance, rel=1e-9, abs=1e-18)
    assert corrected.covariance[:3, :3] == pytest.approx(result.covariance[:3, :3])
    held = np.array(list(corrected.held_out_mm.values()))
    assert (held > 0.02).all()
    assert (held < 0.6).all()


def test_too_few_new_scans_correct_nothing() -> None:
    result, new, _ = world(2)
    corrected, sentence = shifted_result(result, None, new[:2], offset_from(result.X_BC, new[:2]))
    assert corrected is None
    assert "Take four or more" in sentence
