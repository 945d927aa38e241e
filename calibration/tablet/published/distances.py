"""Minimises the sum of mean distances: least squares, then smoothed distances of growing sharpness by SLSQP."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, minimize

from weldcal.models.arrays import Array

Residuals = Callable[[Array], Array]
"""Parameter sets (k, p) to differences (k, 2 n, 2), mm."""

_SMOOTH_MM = (1e-1, 1e-2, 1e-4)  # a distance d counts as sqrt(d^2 + s^2): the last one changes a mean by 1e-8 at most
_STEP = 1e-5  # of the central differences, mm or degrees


@dataclass(frozen=True)
class DistanceMinimum:
    """Where the sum of the two mean distances is smallest: ``parameters`` (p,), ``residuals`` (2 n, 2) mm, how often the
    residuals of one parameter set were computed."""

    parameters: Array
    residuals: Array
    evaluations: int


def minimise_distances(residuals: Residuals, start: Array, search_range: Array) -> DistanceMinimum:
    """Minimise mean |e_1..n| + mean |e_n+1..2n| (Eqs. 17-19) within a range (p, 2) from a start (p,).

    A mean of distances has kinks where a point is met exactly; the smoothing shrinks until it is far below a digit of the
    published figures. Derivatives are central differences of all parameters in one call.
    """
    low, high = search_range[:, 0], search_range[:, 1]
    unit = 0.5 * (high - low)
    count = 0

    def value(x: Array) -> Array:
        nonlocal count
        count += 1
        return np.asarray(residuals(x[None])[0])

    def slope(x: Array) -> Array:
        """(p, 2 n, 2)."""
        nonlocal count
        count += 2 * len(x)
        steps = _STEP * np.eye(len(x))
        both = residuals(np.concatenate([x + steps, x - steps]))
        return np.asarray((both[: len(x)] - both[len(x) :]) / (2.0 * _STEP))

    def flat(x: Array) -> Array:
        return value(x).ravel()

    def flat_slope(x: Array) -> Array:
        return slope(x).reshape(len(x), -1).T

    squares = least_squares(
        flat,
        np.clip(start, low, high),
        flat_slope,
        bounds=(low, high),
        x_scale=unit,
        xtol=1e-10,
    )
    x = np.asarray(squares.x)
    for smooth in _SMOOTH_MM:

        def objective(y: Array, s: float = smooth) -> tuple[float, Array]:
            r = value(y * unit)
            n = len(r) // 2
            d = np.sqrt((r**2).sum(axis=1) + s * s)
            gradient = (slope(y * unit) * (r / d[:, None])).sum(axis=(1, 2)) * unit / n
            return float(d.sum()) / n, gradient

        found = minimize(
            objective,
            x / unit,
            jac=True,
            method="SLSQP",
            bounds=list(zip(low / unit, high / unit, strict=True)),
            options={"maxiter": 300, "ftol": 1e-13},
        )
        x = np.clip(np.asarray(found.x) * unit, low, high)
    return DistanceMinimum(x, value(x), count)
