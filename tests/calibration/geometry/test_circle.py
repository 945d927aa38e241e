"""Circle fits against circles that are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from weldcal.calibration.errors import CircleFitError
from weldcal.calibration.geometry.primitives import fit_circle, fuse, refine_circles


def arc(rng: np.random.Generator, n: int, noise: float, turn: float = 2.0 * np.pi) -> np.ndarray:
    a = rng.uniform(0.0, turn, n)
    r = 0.03 + noise * rng.standard_normal(n)
    return np.array([0.4, -0.2]) + np.column_stack([r * np.cos(a), r * np.sin(a)])


@settings(max_examples=25, deadline=None)
@given(x=st.floats(-1, 1), y=st.floats(-1, 1), r=st.floats(0.005, 0.2), seed=st.integers(0, 1000))
def test_exact_points_give_the_exact_circle(x: float, y: float, r: float, seed: int) -> None:
    a = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 40)
    fit = fit_circle(np.column_stack([x + r * np.cos(a), y + r * np.sin(a)]), noise_floor=1e-9)
    assert np.allclose(fit.center, [x, y], atol=1e-7)
    assert fit.radius == pytest.approx(r, abs=1e-7)


@pytest.mark.parametrize("compiled", [False, True])
def test_covariance_predicts_the_scatter(compiled: bool) -> None:
    rng = np.random.default_rng(0)
    normalised = []
    for _ in range(150):
        points = arc(rng, 80, 1e-4, turn=4.0)
        about = np.array([0.4003, -0.1998]) if compiled else np.zeros(2)
        fit = refine_circles([points - about], [0.0302], noise_floor=1e-6)[0] if compiled else fit_circle(points)
        e = np.array([*(fit.center + about), fit.radius]) - [0.4, -0.2, 0.03]
        normalised.append(float(e @ np.linalg.solve(fit.covariance, e)) / 3.0)
    # mean of 450 chi-square(1) values has sigma 0.067; 4 sigma, and 10 % for the estimated scale
    assert np.mean(normalised) == pytest.approx(1.05, abs=0.33)


def test_a_third_of_gross_outliers_does_not_move_it() -> None:
    rng = np.random.default_rng(1)
    points = np.vstack([arc(rng, 70, 1e-4), np.array([0.4, -0.2]) + rng.uniform(-0.05, 0.05, (35, 2))])
    fit = fit_circle(points)
    # 0.1 mm / sqrt(70 / 2) is 0.017 mm; four sigma
    assert np.linalg.norm(fit.center - [0.4, -0.2]) < 7e-5
    assert fit.inliers[:70].sum() > 60


def test_known_radius_helps_a_short_arc() -> None:
    free, fixed = [], []
    for seed in range(30):
        points = arc(np.random.default_rng(seed), 60, 1e-4, turn=1.0)
        free.append(np.linalg.norm(fit_circle(points).center - [0.4, -0.2]))
        fixed.append(np.linalg.norm(fit_circle(points, radius=0.03).center - [0.4, -0.2]))
    assert np.median(fixed) < 0.5 * np.median(free)


@pytest.mark.parametrize(
    "points",
    [np.zeros((3, 2)), np.full((10, 2), np.nan), np.column_stack([np.arange(9.0), 2.0 * np.arange(9.0)])],
    ids=["three points", "not numbers", "a line"],
)
def test_points_that_make_no_circle_are_refused(points: np.ndarray) -> None:
    with pytest.raises(CircleFitError):
        fit_circle(points)


def test_fusion_trusts_the_sharper_centre_and_doubts_disagreement() -> None:
    a, b = np.zeros(2), np.array([1e-4, 0.0])
    sharp, blunt = np.eye(2) * 1e-10, np.eye(2) * 9e-10
    mean, cov = fuse([a, b], [sharp, blunt])
    assert mean[0] == pytest.approx(1e-5)
    # (1e-4)^2 / (1e-10 + 9e-10) = 10 on two degrees of freedom: the variance grows fivefold
    assert cov[0, 0] == pytest.approx(5.0 * 0.9e-10, rel=1e-9)
