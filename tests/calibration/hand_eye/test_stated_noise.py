"""A hand-eye result is never surer than its observations say they are, however well a few of them happen to agree."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.calibration.hand_eye.poses import random_poses
from weldcal.calibration.geometry.se3 import IDENTITY, exp_rotation, inverse
from weldcal.calibration.hand_eye.mountings import TargetObservation, get_mounting, problem_of
from weldcal.calibration.hand_eye.problem import Problem, State
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, as_transform, solve_problem
from weldcal.calibration.hand_eye.stated_noise import with_stated_noise
from weldcal.models.errors import InputError

TURN, SHIFT = 1e-4, 5e-5
QUICK = HandEyeConfig(folds=0, usual_discord_rad=0.0)


def calibrated(n: int, seed: int, stated: float = 1.0) -> tuple[Problem, State, HandEyeResult, RigidTransform]:
    """An eye in hand that sees a known circle n times, with noise TURN and SHIFT, of which it states ``stated`` times as much."""
    rng = np.random.default_rng(seed)
    F, (X, Y) = random_poses(n, rng), random_poses(2, rng, 1.5)
    G = inverse(F @ X) @ Y
    G = G.copy()
    G[:, :3, 3] += SHIFT * rng.normal(size=(n, 3))
    G[:, :3, :3] = G[:, :3, :3] @ exp_rotation(TURN * rng.normal(size=(n, 3)))
    C = stated**2 * np.diag([TURN**2] * 3 + [SHIFT**2] * 3)
    seen = [
        TargetObservation(X_BF=as_transform(f), p_CM=g[:3, 3], n_CM=g[:3, 2], covariance=C)
        for f, g in zip(F, G, strict=True)
    ]
    known: State = (X, Y, IDENTITY)
    problem = problem_of(get_mounting("eye_in_hand"), seen, {"Y": as_transform(Y)})
    return (
        problem,
        known,
        solve_problem(problem, known, config=QUICK, starts=(known,)),
        as_transform(X),
    )


def test_few_poses_hold_the_truth_as_often_as_they_say() -> None:
    """16 calibrations from five poses each: their squared errors per covariance have the mean of chi-square with 6."""
    squares = []
    for seed in range(16):
        problem, known, result, truth = calibrated(5, seed)
        squares.append(with_stated_noise(problem, known, result).normalised_error("X", truth))
    # standard deviation of the mean: sqrt(12 / 16) = 0.87; the Birge ratio, never below one, makes it a little less than 6
    assert 2.4 < float(np.mean(squares)) < 8.6
    assert max(squares) < 27.0  # 1e-4 of chi-square lie beyond: 0.2 % of such tests


def test_residuals_larger_than_stated_inflate_the_covariance() -> None:
    problem, known, result, _ = calibrated(20, 0)
    honest = with_stated_noise(problem, known, result).covariance["X"]
    problem, known, result, _ = calibrated(20, 0, stated=0.1)
    boasted = with_stated_noise(problem, known, result).covariance["X"]
    # the same data, noise understated tenfold: the answer is as sure as before, within what 94 residuals tell of a scale
    ratio = np.sqrt(np.trace(boasted[3:, 3:]) / np.trace(honest[3:, 3:]))
    assert ratio == pytest.approx(1.0, abs=3.0 / np.sqrt(2.0 * 94.0))


def test_an_open_direction_stays_open() -> None:
    rng = np.random.default_rng(5)
    F, (X, Y) = random_poses(8, rng), random_poses(2, rng, 1.5)
    G = inverse(F @ X) @ Y
    C = np.diag([TURN**2] * 3 + [SHIFT**2] * 3)
    seen = [
        TargetObservation(X_BF=as_transform(f), p_CM=g[:3, 3], n_CM=g[:3, 2], covariance=C)
        for f, g in zip(F, G, strict=True)
    ]
    problem = problem_of(get_mounting("eye_in_hand"), seen, {})
    known: State = (X, Y, IDENTITY)
    result = with_stated_noise(problem, known, solve_problem(problem, known, config=QUICK, starts=(known,)))
    (name,) = result.unobservable
    assert name.startswith("rotation about")
    about = Y[:3, 2]
    assert about @ result.covariance["Y"][:3, :3] @ about > 1.0  # rad^2
    assert np.trace(result.covariance["X"][:3, :3]) < 1e-6


def test_observations_that_state_nothing_are_refused() -> None:
    problem, known, result, _ = calibrated(5, 0)
    bare = Problem(
        F=problem.F,
        G=problem.G,
        H=problem.H,
        full=problem.full,
        normal=problem.normal,
        covariance=None,
        free=problem.free,
    )
    with pytest.raises(InputError, match="state its covariance"):
        with_stated_noise(bare, known, result)
