"""Quantiles of chi-square, F and Student's t: scipy's special functions alone, because importing scipy.stats takes most of a second."""

from scipy.special import fdtri, gammaincinv, stdtrit


def chi2_quantile(share: float, freedom: float) -> float:
    """Value that a chi-square variable stays below with probability ``share``."""
    return float(2.0 * gammaincinv(0.5 * freedom, share))


def f_quantile(share: float, freedom: float, other: float) -> float:
    """Value that an F variable with these degrees of freedom stays below with probability ``share``."""
    return float(fdtri(freedom, other, share))


def t_quantile(share: float, freedom: float) -> float:
    """Value that Student's t stays below with probability ``share``."""
    return float(stdtrit(freedom, share))
