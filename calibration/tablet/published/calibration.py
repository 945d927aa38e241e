"""The tablet paper's two-stage calibration: chain, affine pair, and the hand position for a pixel."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import Bounds, differential_evolution, least_squares, minimize

from weldcal.calibration.tablet.published.chain import Model, place_landmarks, search_range
from weldcal.calibration.tablet.published.two_stage import (
    AFFINE_NONE,
    AFFINE_RANGE,
    CENTRE,
    Fitness,
    Sign,
    apply_affine,
    fitness,
    stage1_residuals,
    stage2_residuals,
)
from weldcal.calibration.tablet.touches import TabletTouches, check_touches
from weldcal.models.arrays import Array

Residuals = Callable[[Array], Array]
"""Parameter sets (k, p) to differences (k, 2 n, 2), mm."""

_SMOOTH_MM = (1e-1, 1e-2, 1e-4)  # a distance d counts as sqrt(d^2 + s^2): the last one changes a mean by 1e-8 at most
_STEP = 1e-5  # of the central differences, mm or degrees


@dataclass(frozen=True)
class DistanceMinimum:
    """Where the sum of the two mean distances is smallest: ``parameters`` (p,), ``residuals`` (2 n, 2) mm, how often
    the residuals of one parameter set were computed."""

    parameters: Array
    residuals: Array
    evaluations: int


def minimise_distances(residuals: Residuals, start: Array, search_range: Array) -> DistanceMinimum:
    """Minimise mean |e_1..n| + mean |e_n+1..2n| (Eqs. 17-19) within a range (p, 2) from a start (p,).

    A mean of distances has kinks where a point is met exactly; the smoothing shrinks until it is far below a digit of
    the published figures. Derivatives are central differences of all parameters in one call.
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

    squares = least_squares(flat, np.clip(start, low, high), flat_slope, bounds=(low, high), x_scale=unit, xtol=1e-10)
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


Minimiser = Callable[[Residuals, Array], DistanceMinimum]
"""Finds a minimum of residuals within a range (p, 2)."""


@dataclass(frozen=True)
class StageResult:
    """One stage: its parameters (mm and degrees, named in chain.py and two_stage.py), its fitness, its cost."""

    parameters: Array
    fitness: Fitness
    evaluations: int


def from_the_middle(residuals: Residuals, search: Array) -> DistanceMinimum:
    """The fast solver from the middle of the range, where there is no better idea."""
    return minimise_distances(residuals, search.mean(axis=1), search)


def tablet_stage1(
    touches: TabletTouches,
    model: Model = "htm",
    sign: Sign = Sign.PRINTED,
    *,
    dh_offset_in_error: bool = True,
    minimiser: Minimiser = from_the_middle,
) -> StageResult:
    """Stage 1 (Eqs. 17-20): the twelve parameters of a chain.

    Raises what check_touches raises. (alpha_t, beta_t) and their negatives are the same minimum: a plane seen in x and
    y only.
    """
    check_touches(touches)
    found = minimiser(lambda x: stage1_residuals(touches, x, model, sign, dh_offset_in_error), search_range(model))
    return StageResult(found.parameters, fitness(found.residuals), found.evaluations)


def tablet_stage2(
    touches: TabletTouches,
    stage1: Array,
    model: Model = "htm",
    sign: Sign = Sign.PRINTED,
    *,
    dh_offset_in_error: bool = True,
    minimiser: Minimiser | None = None,
) -> StageResult:
    """Stage 2 (Eqs. 21-24): the ten parameters of the affine pair on top of ``stage1`` (12,)."""
    placed = place_landmarks(touches, stage1, model, dh_offset_in_error)

    def residuals(x: Array) -> Array:
        return stage2_residuals(touches, x, placed, sign)

    found = (
        minimise_distances(residuals, AFFINE_NONE, AFFINE_RANGE)
        if minimiser is None
        else minimiser(residuals, AFFINE_RANGE)
    )
    return StageResult(found.parameters, fitness(found.residuals), found.evaluations)


def hand_to_touch(
    fitted: TabletTouches,
    stage1: Array,
    affine: Array | None,
    uv_px: Array,
    depth_m: Array,
    theta_rad: Array,
    model: Model = "htm",
) -> Array:
    """Hand positions (m, 2) m from which the pen touches what is seen at ``uv_px`` (m, 2), by Eq. 8, or Eq. 25 with an
    affine pair (10,).

    ``fitted``: the touches that the parameters come from; A_n turns about their landmark 4.
    """
    m = len(uv_px)
    zeros = np.zeros((m, 2))
    query = replace(
        fitted, uv_px=uv_px, depth_m=depth_m, theta_rad=theta_rad, hand_m=zeros, delta_px=zeros, landmark_px=zeros
    )
    asked = place_landmarks(query, stage1, model)
    if affine is None:
        return np.asarray(1e-3 * (asked.seen - asked.pen)[0])
    own = place_landmarks(fitted, stage1, model)
    a = np.atleast_2d(affine)
    centre = min(CENTRE, len(fitted.uv_px) - 1)
    first = apply_affine(a[:, :5], own.seen, own.seen[:, centre])
    about = (first - own.pen)[:, centre]
    moved = apply_affine(a[:, :5], asked.seen, own.seen[:, centre]) - asked.pen
    return np.asarray(1e-3 * apply_affine(a[:, 5:], moved, about)[0])


PUBLISHED_POPULATION = 10_000
PUBLISHED_GENERATIONS = 10_000
CROSSOVER = 0.9  # the paper's Table 4
WEIGHT = 0.5  # the paper's Table 4


def evolve(
    residuals: Residuals, search_range: Array, seed: int, population: int = 240, generations: int = 1250
) -> DistanceMinimum:
    """Minimise mean |e_1..n| + mean |e_n+1..2n| by DE/rand/1/bin in a range (p, 2); deterministic for a seed.

    The paper's population and generations (10,000 each) are far more than it takes: 3e5 evaluations already end at the
    same minimum for every seed. Whole generations are computed in one call.
    """
    low, high = search_range[:, 0], search_range[:, 1]
    start = np.random.default_rng(seed).uniform(low, high, (population, len(low)))
    evaluations = 0

    def objective(columns: Array, /, *_: object) -> Any:
        nonlocal evaluations
        r = residuals(columns.T)
        evaluations += len(r)
        return np.asarray(np.sqrt((r**2).sum(axis=2)).sum(axis=1) / (r.shape[1] // 2))

    found = differential_evolution(
        objective,
        Bounds(low, high),
        strategy="rand1bin",
        maxiter=generations,
        init=start,
        mutation=WEIGHT,
        recombination=CROSSOVER,
        tol=0.0,
        atol=1e-9,
        rng=seed,
        polish=False,
        updating="deferred",
        vectorized=True,
    )
    return DistanceMinimum(np.asarray(found.x), residuals(found.x[None])[0], evaluations)
