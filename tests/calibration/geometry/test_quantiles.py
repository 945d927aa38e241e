"""Quantiles and probabilities are those of scipy.stats."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from weldcal.calibration.geometry.quantiles import (
    chi2_below,
    chi2_exceeded,
    chi2_quantile,
    f_above,
    f_quantile,
    t_quantile,
)


@pytest.mark.parametrize(("n", "m"), [(1, 3), (3, 24), (6, 200)])
@pytest.mark.parametrize("p", [1e-4, 0.3, 0.95])
def test_they_are_those_of_scipy(n: int, m: int, p: float) -> None:
    found = chi2_quantile(p, n), chi2_exceeded(p, n), f_quantile(p, n, m), t_quantile(p, m)
    assert found == pytest.approx((stats.chi2.ppf(p, n), stats.chi2.isf(p, n), stats.f.ppf(p, n, m), stats.t.ppf(p, m)))
    for value in (-0.1, 0.0, 10.0 * p, np.inf):
        assert (chi2_below(value, n), f_above(value, n, m)) == pytest.approx(
            (stats.chi2.cdf(value, n), stats.f.sf(value, n, m))
        )
