"""Quantiles and tails agree with scipy.stats, which takes too long to import where they are needed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, f, t

from weldcal.calibration.geometry.robust import (
    chi2_quantile,
    chi2_share,
    chi2_threshold,
    f_quantile,
    f_tail,
    t_quantile,
)


@pytest.mark.parametrize("freedom", [1, 3, 6, 40])
def test_chi_square(freedom: int) -> None:
    assert chi2_quantile(0.95, freedom) == pytest.approx(chi2.ppf(0.95, freedom), rel=1e-12)
    assert chi2_threshold(5e-11, freedom) == pytest.approx(chi2.isf(5e-11, freedom), rel=1e-12)
    assert chi2_share(7.3, freedom) == pytest.approx(chi2.cdf(7.3, freedom), rel=1e-12)
    assert chi2_share(-1e-18, freedom) == 0.0, "a quadratic form that rounding made negative"


@pytest.mark.parametrize("other", [1, 7, 300])
def test_f_and_t(other: int) -> None:
    assert f_quantile(0.95, 6, other) == pytest.approx(f.ppf(0.95, 6, other), rel=1e-10)
    values = np.array([0.0, 0.4, 12.0, 300.0])
    assert f_tail(values, 6, other) == pytest.approx(f.sf(values, 6, other), rel=1e-10)
    assert t_quantile(0.975, other) == pytest.approx(t.ppf(0.975, other), rel=1e-12)
