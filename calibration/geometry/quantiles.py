"""Quantiles and probabilities of chi-square, F and Student's t by scipy's special functions: importing scipy.stats takes most of a second."""

from scipy.special import chdtr, chdtri, fdtrc, fdtri, gammaincinv, stdtrit


def chi2_quantile(share: float, freedom: float) -> float:
    """Value that a chi-square variable stays below with probability ``share``."""
    return float(2.0 * gammaincinv(0.5 * freedom, share))


def chi2_below(value: float, freedom: float) -> float:
    """Probability that a chi-square variable stays below ``value``."""
    return float(chdtr(freedom, max(value, 0.0)))


def chi2_exceeded(chance: float, freedom: float) -> float:
    """Value that a chi-square variable exceeds with probability ``chance``."""
    return float(chdtri(freedom, chance))


def f_above(value: float, freedom: float, other: float) -> float:
    """Probability that an F variable exceeds ``value``."""
    return float(fdtrc(freedom, other, max(value, 0.0)))


def f_quantile(share: float, freedom: float, other: float) -> float:
    """Value that an F variable with these degrees of freedom stays below with probability ``share``."""
    return float(fdtri(freedom, other, share))


def t_quantile(share: float, freedom: float) -> float:
    """Value that Student's t stays below with probability ``share``."""
    return float(stdtrit(freedom, share))
