"""Quantiles and tails of chi-square, F and Student's t: scipy's special functions alone, because importing scipy.stats takes most of a second."""

import numpy as np
from scipy.special import chdtr, chdtri, fdtrc, fdtri, gammaincinv, stdtrit

from weldcal.models.arrays import Array


def chi2_quantile(share: float, freedom: float) -> float:
    """Value that a chi-square variable stays below with probability ``share``."""
    return float(2.0 * gammaincinv(0.5 * freedom, share))


def chi2_threshold(rate: float, freedom: float) -> float:
    """Value that a chi-square variable exceeds with probability ``rate``, exact for small rates too."""
    return float(chdtri(freedom, rate))


def chi2_share(value: float, freedom: float) -> float:
    """Probability that a chi-square variable stays below ``value``."""
    return float(chdtr(freedom, max(float(value), 0.0)))


def f_quantile(share: float, freedom: float, other: float) -> float:
    """Value that an F variable with these degrees of freedom stays below with probability ``share``."""
    return float(fdtri(freedom, other, share))


def f_tail(value: float | Array, freedom: float, other: float) -> Array:
    """Probabilities that an F variable with these degrees of freedom exceeds the values: of their shape."""
    return np.asarray(fdtrc(freedom, other, np.maximum(value, 0.0)), dtype=float)


def t_quantile(share: float, freedom: float) -> float:
    """Value that Student's t stays below with probability ``share``."""
    return float(stdtrit(freedom, share))
