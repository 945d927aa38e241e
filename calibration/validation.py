"""Errors on poses a calibration never saw: folds, and how the error falls with the number of scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.iterative import Cost, algorithm1_start, algorithm1_step, translation_cost
from weldcal.calibration.observation import Observation
from weldcal.calibration.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.verification import VerificationError, Verifier
from weldcal.models.errors import InputError

Array = NDArray[np.float64]


def position_errors(X_BC: RigidTransform, observations: Sequence[Observation]) -> Array:
    """Distance (n,) m between where a calibration puts the flange centres and where the robot says they are."""
    return np.array([float(np.linalg.norm(X_BC @ o.p_CR - o.p_BR)) for o in observations])


def tilt_errors(X_BC: RigidTransform, observations: Sequence[Observation]) -> Array:
    """Angle (n,) rad between seen and stated face normals; NaN where no normal was seen."""
    out = []
    for o in observations:
        if o.n_C is None:
            out.append(np.nan)
            continue
        seen = X_BC.rotation() @ o.n_C
        out.append(float(np.arctan2(np.linalg.norm(np.cross(seen, o.n_B)), seen @ o.n_B)))
    return np.array(out)


def k_fold(
    observations: Sequence[Observation],
    *,
    folds: int = 5,
    repeats: int = 10,
    seed: int = 0,
    config: SolveConfig | None = None,
) -> Array:
    """Held-out position errors (repeats, n) m, NaN where a fold could not be solved (too few or coplanar poses left).

    Deterministic for ``seed``. Raises InputError when there are fewer poses than folds.
    """
    n = len(observations)
    if not 2 <= folds <= n:
        raise InputError(f"{n} poses cannot be divided into {folds} folds; ask for 2 to {n}.")
    plain = replace(config or SolveConfig(), leave_one_out=False, hypotheses=150)
    rng = np.random.default_rng(seed)
    errors = np.full((repeats, n), np.nan)
    for r in range(repeats):
        order = rng.permutation(n)
        for f in range(folds):
            test = order[f::folds]
            train = [observations[i] for i in range(n) if i not in set(test.tolist())]
            try:
                X = estimate_eye_on_base(train, plain).X_BC
            except InputError:
                continue
            errors[r, test] = position_errors(X, [observations[i] for i in test])
    return errors


@dataclass(frozen=True)
class Convergence:
    """Errors against the number of scans (m): rows are seeded orders of the scans, columns ``counts``; NaN where open.

    ``held_out``: median error of this software's calibration on the scans not used. ``figure``: Algorithm 1's own
    figure at its verification pose. ``figure_true``: median true error of Algorithm 1's calibration on the scans
    outside its pool.
    """

    counts: Array
    held_out: Array
    figure: Array
    figure_true: Array


@dataclass(frozen=True)
class Algorithm1Run:
    """The end of one run of Algorithm 1: its calibration, its own figure, and errors (m) on poses outside its pool."""

    X_BC: RigidTransform
    error: VerificationError
    cost: float
    pool: tuple[str, ...]
    true_errors: Array
    counts: Array
    figures: Array
    true_medians: Array


def run_algorithm1(
    observations: Sequence[Observation], verification: Verifier, *, cost: Cost = translation_cost
) -> Algorithm1Run | None:
    """Feed all observations, in order, to Algorithm 1 without a stop at a required error; None if it never
    registered."""
    state = algorithm1_start(e_required=1e-12, k_max=max(1, len(observations)))
    counts, figures, medians = [], [], []
    for used, o in enumerate(observations, start=1):
        state = algorithm1_step(state, o, verification, cost)
        if state.X_BC is None:
            continue
        outside = _outside(observations, state.pool)
        counts.append(used)
        figures.append(state.cost)
        medians.append(float(np.median(position_errors(state.X_BC, outside))) if outside else np.nan)
    if state.X_BC is None:
        return None
    outside = _outside(observations, state.pool)
    return Algorithm1Run(
        state.X_BC,
        state.error,
        state.cost,
        tuple(o.id for o in state.pool),
        position_errors(state.X_BC, outside),
        np.array(counts, dtype=float),
        np.array(figures),
        np.array(medians),
    )


def convergence(
    observations: Sequence[Observation], verification: Verifier | None, *, orders: int = 5, seed: int = 0
) -> Convergence:
    """Both methods over seeded orders of the same scans, in the manner of the paper's Fig. 11."""
    n = len(observations)
    counts = np.unique(
        np.concatenate([np.arange(4, min(n, 9)), np.round(np.geomspace(9, max(n - 1, 9), 7)).astype(int)])
    )
    counts = counts[(counts >= 4) & (counts < n)]
    rng = np.random.default_rng(seed)
    config = SolveConfig(leave_one_out=False, hypotheses=150)
    held_out, figure, figure_true = (np.full((orders, len(counts)), np.nan) for _ in range(3))
    for r in range(orders):
        shuffled = [observations[i] for i in rng.permutation(n)]
        for k, m in enumerate(counts):
            try:
                X = estimate_eye_on_base(shuffled[:m], config).X_BC
            except InputError:
                continue
            held_out[r, k] = float(np.median(position_errors(X, shuffled[m:])))
        run = None if verification is None else run_algorithm1(shuffled, verification)
        if run is None:
            continue
        for k, m in enumerate(counts):
            at = np.nonzero(run.counts <= m)[0]
            if len(at):
                figure[r, k], figure_true[r, k] = run.figures[at[-1]], run.true_medians[at[-1]]
    return Convergence(counts.astype(float), held_out, figure, figure_true)


def _outside(observations: Sequence[Observation], pool: Sequence[Observation]) -> list[Observation]:
    inside = {o.id for o in pool}
    return [o for o in observations if o.id not in inside]
