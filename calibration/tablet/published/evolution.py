"""Differential evolution with the settings of the paper's Table 4: DE/rand/1, binomial crossover, CR 0.9, F 0.5."""

from typing import Any

import numpy as np
from scipy.optimize import Bounds, differential_evolution

from weldcal.calibration.tablet.published.distances import DistanceMinimum, Residuals
from weldcal.models.arrays import Array

PUBLISHED_POPULATION = 10_000
PUBLISHED_GENERATIONS = 10_000
CROSSOVER = 0.9
WEIGHT = 0.5


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
