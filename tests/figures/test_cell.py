"""The scatter of felt seam points is that of their noise."""

import numpy as np
import pytest

from tests.worlds.weld.case import scatter


def test_scatter_is_the_noise_and_not_the_wave_under_it() -> None:
    noise = np.random.default_rng(0).normal(0.0, 1.0, 1200)
    wave = 30.0 * np.sin(np.linspace(0.0, 12.0, 1200))
    # 1200 values give a deviation to 2 %.
    assert scatter(noise + wave) == pytest.approx(1.0, rel=0.06)
