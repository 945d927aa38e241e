"""Held-out errors of a calibration.

k-fold cross-validation, convergence over the number of scans, intervals of new errors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import t_quantile
from weldcal.calibration.published.algorithm1 import (
    Cost,
    VerificationError,
    Verifier,
    algorithm1_start,
    algorithm1_step,
    translation_cost,
)
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

Solve = Callable[[list[Observation]], tuple[RigidTransform, ScannerCorrection]]
"""Camera pose and scanner correction from observations."""


def position_errors(X_BC: RigidTransform, observations: Sequence[Observation]) -> Array:
    """Distances (n,) m between the flange centres by the calibration and by the robot."""
    p_C, p_B = (np.array([getattr(o, name) for o in observations]).reshape(-1, 3) for name in ("p_CR", "p_BR"))
    return np.asarray(np.linalg.norm(X_BC.multiply(p_C.T).T - p_B, axis=1))


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


def _plain(config: SolveConfig) -> Solve:
    """The plain estimate, which takes the scanner as it is."""
    return lambda observations: (estimate_eye_on_base(observations, config).X_BC, ScannerCorrection())


def k_fold(
    observations: Sequence[Observation],
    *,
    folds: int = 5,
    repeats: int = 10,
    seed: int = 0,
    config: SolveConfig | None = None,
    solve: Solve | None = None,
) -> Array:
    """Held-out position errors (repeats, n) m, NaN where a fold could not be solved (too few or coplanar poses left).

    ``solve`` replaces the plain estimate and may correct the scanner as well; it sees the poses of its fold only.
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
            held = set(test.tolist())
            train = [o for i, o in enumerate(observations) if i not in held]
            try:
                X, correction = (solve or _plain(plain))(train)
            except InputError:
                continue
            errors[r, test] = position_errors(X, [corrected_observation(correction, observations[i]) for i in test])
    return errors


@dataclass(frozen=True)
class Convergence:
    """Errors (m) against the number of scans: columns are ``counts``; NaN where open.

    ``held_out`` and ``figure_true`` hold, row by row, the errors of this software's and of Algorithm 1's calibration on
    the scans that were not used yet, the same for both, over seeded orders of the scans; ``figure`` is what Algorithm 1
    itself reports, one row an order.
    """

    counts: Array
    held_out: Array
    figure: Array
    figure_true: Array


@dataclass(frozen=True, kw_only=True)
class Algorithm1Run:
    """The end of one run of Algorithm 1: its calibration, its own figure, and errors (m) on poses outside its pool."""

    X_BC: RigidTransform
    error: VerificationError
    cost: float
    pool: tuple[str, ...]
    true_errors: Array
    counts: Array
    figures: Array
    path: tuple[RigidTransform, ...]


def run_algorithm1(
    observations: Sequence[Observation], verification: Verifier, *, cost: Cost = translation_cost
) -> Algorithm1Run | None:
    """Feed all observations, in order, to Algorithm 1 without a stop at a required error.

    None if it never registered.
    """
    state = algorithm1_start(e_required=1e-12, k_max=max(1, len(observations)))
    counts, figures, path = [], [], []
    for used, o in enumerate(observations, start=1):
        state = algorithm1_step(state, o, verification, cost)
        if state.X_BC is None:
            continue
        counts.append(used)
        figures.append(state.cost)
        path.append(state.X_BC)
    if state.X_BC is None:
        return None
    inside = {o.id for o in state.pool}
    return Algorithm1Run(
        X_BC=state.X_BC,
        error=state.error,
        cost=state.cost,
        pool=tuple(o.id for o in state.pool),
        true_errors=position_errors(state.X_BC, [o for o in observations if o.id not in inside]),
        counts=np.array(counts, dtype=float),
        figures=np.array(figures),
        path=tuple(path),
    )


def convergence(
    observations: Sequence[Observation],
    verification: Verifier | None,
    *,
    orders: int = 8,
    seed: int = 0,
    solve: Solve | None = None,
) -> Convergence:
    """Both methods over seeded orders of the same scans, in the manner of the paper's Fig. 11.

    At least two scans judge. ``solve`` replaces the plain estimate, as in k_fold.
    """
    n = len(observations)
    counts = np.unique(np.concatenate([np.arange(4, 10), np.round(np.geomspace(9, max(n, 10), 8)).astype(int)]))
    counts = counts[counts <= n - 2]
    rng = np.random.default_rng(seed)
    config = SolveConfig(leave_one_out=False, hypotheses=150)
    held_out, figure_true = np.full((2, orders * n, len(counts)), np.nan)
    figure = np.full((orders, len(counts)), np.nan)
    for r in range(orders):
        shuffled = [observations[i] for i in rng.permutation(n)]
        run = None if verification is None else run_algorithm1(shuffled, verification)
        for k, m in enumerate(counts):
            rows = slice(r * n, r * n + n - int(m))
            try:
                X, correction = (solve or _plain(config))(shuffled[:m])
                seen = correction.points(np.array([o.p_CR for o in shuffled[m:]]))
                p_B = np.array([o.p_BR for o in shuffled[m:]])
                held_out[rows, k] = np.linalg.norm(X.multiply(seen.T).T - p_B, axis=1)
            except InputError:
                pass  # the first m scans of this order lie in one plane
            taken = 0 if run is None else int((run.counts <= m).sum())
            if run is not None and taken:
                figure[r, k] = run.figures[taken - 1]
                figure_true[rows, k] = position_errors(run.path[taken - 1], shuffled[m:])
    return Convergence(counts.astype(float), held_out, figure, figure_true)


def mean_interval(errors: Array, level: float = 0.95) -> tuple[float, float] | None:
    """Interval in which the mean error of as many new poses lies with that probability.

    None for fewer than four errors.

    From the scatter of the held-out ``errors`` (n,) themselves: both means know theirs to c / sqrt(n), c the
    coefficient of variation, so the logarithm of their ratio has the variance 2 c^2 / n (Student's t with n - 1 degrees
    of freedom).
    """
    e = np.asarray(errors, dtype=float)
    e = e[np.isfinite(e)]
    n = len(e)
    if n < 4 or not e.mean() > 0.0:
        return None
    spread = float(np.std(e, ddof=1) / e.mean() * np.sqrt(2.0 / n) * t_quantile(0.5 + 0.5 * level, n - 1))
    return float(e.mean() * np.exp(-spread)), float(e.mean() * np.exp(spread))


def bootstrap_interval(
    errors: Array, share: float = 0.5, level: float = 0.95, seed: int = 0
) -> tuple[float, float] | None:
    """Interval in which the quantile ``share`` of as many new errors lies with that probability.

    None for fewer than four errors.

    From 4 000 pairs of resamples of the held-out ``errors`` (n,): one stands for what was seen, the other for what
    comes, and the ratio of their quantiles is that of the new one to the reported one (bootstrap, Efron and Tibshirani
    1993, 13.3).
    """
    e = np.asarray(errors, dtype=float)
    e = e[np.isfinite(e)]
    if len(e) < 4 or not e.min() > 0.0:
        return None
    rng = np.random.default_rng(seed)
    # few resamples at a time: all of them would take memory for 8 000 times n numbers
    drawn = np.concatenate([np.quantile(e[rng.integers(len(e), size=(80, len(e)))], share, axis=1) for _ in range(100)])
    low, high = np.quantile(drawn[4000:] / drawn[:4000], [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    reported = float(np.quantile(e, share))
    return reported * float(low), reported * float(high)
