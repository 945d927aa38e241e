"""Robust statistics, and what compiled loops need besides: a median, a small Cholesky solution, rotations."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtri, fdtrc, fdtri, gammaincinv, stdtrit

from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled


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


TUKEY = 4.685  # 95 % efficient on Gaussian noise
MAD = 1.4826  # median absolute deviation -> standard deviation of a Gaussian
_FLAT = 1e-9  # of a diagonal element, what earlier rows leave of it: less, and the matrix counts as singular


@compiled()
def middle(a: Array) -> float:
    """Median of numbers (N,), the upper of two middle ones, by Hoare's selection; reorders its argument."""
    low, high, k = 0, len(a) - 1, len(a) // 2
    while low < high:
        pivot, i, j = a[(low + high) // 2], low, high
        while i <= j:
            while a[i] < pivot:
                i += 1
            while a[j] > pivot:
                j -= 1
            if i <= j:
                a[i], a[j] = a[j], a[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return float(a[k])


@compiled()
def solved(N: Array, g: Array, free: int) -> tuple[bool, Array]:
    """Solve N x = g for the leading ``free`` rows of a symmetric matrix (3, 3) by Cholesky.

    False where not positive definite.
    """
    L, x = np.zeros((3, 3)), np.zeros(3)
    for i in range(free):
        for j in range(i + 1):
            s = N[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > _FLAT * N[i, i]:
                    return False, x
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(free):
        s = g[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(free - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, free):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
    return True, x


def radius_95(S: Array) -> float:
    """Distance that an error of covariance ``S`` (3, 3) does not exceed with 95 %, in the square root of its unit.

    It is that of a scaled chi-square with the mean and variance of the squared error (Satterthwaite 1946).
    """
    mean, square = float(np.trace(S)), float(np.trace(S @ S))
    freedom = mean**2 / square if square > 0.0 else 3.0
    return float(np.sqrt(chi2_quantile(0.95, freedom) * mean / freedom))


@compiled()
def cross_rows(J: Array, v: NDArray[np.floating[Any]], weight: float) -> None:
    """Set the first three columns of J (3, columns) to -skew(v), v (3,), times the weight: how v turns.

    The diagonal stays.
    """
    J[0, 1], J[0, 2], J[1, 2] = weight * v[2], -weight * v[1], weight * v[0]
    J[1, 0], J[2, 0], J[2, 1] = -weight * v[2], weight * v[1], -weight * v[0]


@compiled()
def rotation_of(w: NDArray[np.floating[Any]]) -> Array:
    """Rotation (3, 3) of a rotation vector (3,) rad (Rodrigues)."""
    angle = np.sqrt(w @ w)
    S = np.zeros((3, 3))
    cross_rows(S, w, -1.0)
    if angle < 1e-4:
        first, second = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0
    else:
        first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    R: Array = np.eye(3) + first * S + second * (S @ S)
    return R
