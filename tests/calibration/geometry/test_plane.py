"""A plane's normal is as far off as stated, and noise that neighbours share is counted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from weldcal.calibration.geometry.primitives import fit_plane, shared_noise


@pytest.mark.parametrize("radius", [0.02, 0.2])
def test_the_normal_is_as_far_off_as_stated(radius: float) -> None:
    """Discs of 300 points with 0.1 mm of noise: the wider one is ten times as sure."""
    found = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        rho, turn = radius * np.sqrt(rng.random(300)), rng.uniform(0.0, 2.0 * np.pi, 300)
        points = np.column_stack([rho * np.cos(turn), rho * np.sin(turn), 1e-4 * rng.normal(size=300)])
        plane = fit_plane(points, (np.zeros(3), np.array([0.01, 0.0, 1.0])), tolerance=0.003)
        found.append(float(plane.normal[:2] @ plane.normal[:2]) / 2.0 / plane.normal_sigma**2)
    # 120 degrees of freedom: 13 %; Tukey's weights cost 5 %
    assert 0.65 < np.mean(found) < 1.5


@pytest.mark.parametrize(("width", "readings"), [(0.0, 1.0), (0.7, 4.0 * np.pi * 0.7**2), (1.2, 4.0 * np.pi * 1.2**2)])
def test_noise_that_neighbours_share_counts_once(width: float, readings: float) -> None:
    """White noise smoothed by a Gaussian of s pixels: a sum over many has 4 pi s^2 times the variance of independent
    ones."""
    noise = np.random.default_rng(1).normal(size=(200, 200))
    noise = gaussian_filter(noise, width) if width else noise
    good = np.ones(noise.size, dtype=bool)
    found = shared_noise(noise.ravel(), good, np.arange(noise.size), noise.shape)
    # of blocks of ten pixels, whose rims share with others: up to a third less
    assert 0.6 * readings < found < 1.2 * readings
