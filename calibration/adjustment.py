"""Adjusts poses and numbers to several kinds of observations with losses and spreads, and chooses observations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from weldcal.calibration.geometry.se3 import moved, skew
from weldcal.models.arrays import Array

_MEDIAN = 1.5382  # of the chi distribution with three degrees of freedom
_SINGULAR = 1e-12  # of the information with a unit diagonal: 1e-6 of columns, between rounding and real motions
_SETTLED = 1e-3  # a choice: steps in sigmas, and changes of a spread over itself, that change no answer
_EARLY = 3  # steps at least: the first spreads follow from the start

Loss = Callable[[Array, float], Array]
"""Weights (n,) of squared residuals (n,) in sigmas, each of so many independent numbers."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Poses (4, 4), and numbers (K,).

    A step (6 P + K,) turns each pose on its parent's side about its own origin and moves this (``se3.moved``).
    """

    poses: tuple[Array, ...]
    numbers: Array

    def moved(self, step: Array) -> Unknowns:
        """Return the unknowns after a step."""
        poses = tuple(moved(X, step[6 * i : 6 * i + 6]) for i, X in enumerate(self.poses))
        return Unknowns(poses, self.numbers + step[6 * len(poses) :])


@dataclass(frozen=True, eq=False)
class Observed:
    """Residuals e (n, k) of n observations and derivatives J (n, k, 6 P + K).

    ``own``: variance (n,) or covariance (n, k, k) of each, beyond which the spread is estimated.
    """

    e: Array
    J: Array
    own: Array | float = 0.0


@dataclass(frozen=True, eq=False)
class Remainder:
    """What the unknowns leave of a kind, from which its spread is estimated.

    Residuals e (n, k); their last spread; the sum of their weighted squares in sigmas; how many independent numbers
    they are, and how many of these are spare.
    """

    e: Array
    sigma: float = 1.0
    weighted: float = 0.0
    numbers: float = 1.0
    spare: float = 1.0


Spread = Callable[[Remainder], float]
"""New spread of a kind."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Settings of one kind of observation.

    ``rank``: independent numbers of an observation (a normal has 2 of 3). ``sigma`` per number to begin with (None: by
    the median of the first residuals); ``spread`` estimates it (None: it is known). ``floor``: least sigma.
    """

    rank: float
    loss: Loss
    spread: Spread | None = None
    sigma: float | None = None
    floor: float = 1e-6  # m or rad: below any scanner or arm, keeps exact data from dividing by zero


@dataclass(frozen=True, eq=False, kw_only=True)
class Adjusted:
    """Unknowns at the optimum and what they are known to.

    ``information`` (m, m) with the prior, ``of`` each kind alone, ``covariance`` its pseudo-inverse; ``sigmas``,
    ``spare`` numbers and last ``rows`` of each kind.
    """

    at: Unknowns
    information: Array
    of: tuple[Array, ...]
    covariance: Array
    sigmas: tuple[float, ...]
    spare: tuple[float, ...]
    rows: tuple[Observed, ...]


def huber(square: Array, rank: float) -> Array:
    """Least squares within two sigmas per number: 99 % of its information on a normal axis (1.0 keeps 90 %)."""
    return np.minimum(1.0, 2.0 * np.sqrt(rank / np.maximum(square, 1e-30)))  # 1e-30: no division by zero


def huber_cost(square: Array, rank: float) -> Array:
    """Twice the loss (n,) whose weights are those of ``huber``."""
    limit = 4.0 * rank
    return np.where(square < limit, square, 2.0 * np.sqrt(limit * square) - limit)


def soft_l1(square: Array, rank: float) -> Array:
    """Least squares below two sigmas, proportional far beyond, in between smooth."""
    return np.asarray(1.0 / np.sqrt(1.0 + square / 4.0))


def plain(square: Array, rank: float) -> Array:
    """Least squares."""
    return np.ones_like(square)


def helmert(left: Remainder) -> float:
    """Weighted squares over the spare numbers (Helmert's simplified estimator); a variance falls to a tenth at most."""
    return left.sigma * float(np.sqrt(np.clip(left.weighted / left.spare, 0.1, 100.0)))


def likeliest(left: Remainder) -> float:
    """Weighted squares over all numbers: the maximum of the loss's likelihood."""
    return left.sigma * float(np.sqrt(left.weighted / left.numbers))


def by_median(left: Remainder) -> float:
    """By the median length of residuals (n, 3); 0 of none."""
    return float(np.median(np.linalg.norm(left.e, axis=1))) / _MEDIAN if len(left.e) else 0.0


def adjust(
    start: Unknowns,
    rows: Callable[[Unknowns], Sequence[Observed]],
    kinds: Sequence[Kind],
    *,
    prior: Array | None = None,
    mean: Array | float = 0.0,
    steps: int = 40,
) -> Adjusted:
    """Minimise the weighted squares of all kinds by Gauss-Newton, reweighted, and estimate their spreads between steps.

    Args:
        start: poses and numbers near the optimum.
        rows: the rows of each kind at some unknowns.
        kinds: settings of each kind, in the order of ``rows``.
        prior: information (K, K) of the numbers about ``mean`` (K,) before the data.

    Steps are shortest along directions that no data and no prior determine. Source: Koch, Parameter Estimation and
    Hypothesis Testing in Linear Models, 1999, 3.6 and 3.8.
    """
    at, P = start, 6 * len(start.poses)
    m = P + len(start.numbers)
    known = np.zeros((m, m))
    if prior is not None:
        known[P:, P:] = prior
    sigmas: list[float] = []
    for count in range(steps):
        seen = tuple(rows(at))
        N, g = known.copy(), known[:, P:] @ (at.numbers - mean)
        parts, squares = [], []
        for i, (kind, row) in enumerate(zip(kinds, seen, strict=True)):
            if count == 0:
                sigmas.append(kind.sigma or max(by_median(Remainder(row.e)), kind.floor))
            whole = isinstance(row.own, np.ndarray) and row.own.ndim == 3
            if whole:
                W = np.linalg.inv(row.own + sigmas[i] ** 2 * np.eye(row.J.shape[1]))
                square = np.vecdot(row.e, (W @ row.e[:, :, None])[:, :, 0])
            else:
                W = 1.0 / (np.reshape(row.own, (-1, 1, 1)) + sigmas[i] ** 2)
                square = np.vecdot(row.e, row.e) * W[:, 0, 0]
            w = kind.loss(square, kind.rank)
            wW = w[:, None, None] * W
            WJ = (wW @ row.J if whole else wW * row.J).reshape(-1, m).T
            parts.append(WJ @ row.J.reshape(-1, m))
            N += parts[-1]
            g += WJ @ row.e.ravel()
            squares.append(float(w @ square))
        own = N.diagonal()
        unit = np.sqrt(np.where(own > 0.0, own, 1.0))
        values, vectors = np.linalg.eigh(N / unit / unit[:, None])
        clear = values > _SINGULAR * values[-1]
        U = vectors[:, clear] / unit[:, None]
        V = (U / values[clear]) @ U.T
        step = -V @ g
        at = at.moved(step)
        spare = [
            max(kind.rank * len(row.e) - float(np.vdot(V, part)), 0.3)  # a part of one number: no division by zero
            for kind, row, part in zip(kinds, seen, parts, strict=True)
        ]
        change = 0.0
        for i, (kind, row) in enumerate(zip(kinds, seen, strict=True)):
            if kind.spread is not None and len(row.e):
                left = Remainder(row.e, sigmas[i], squares[i], kind.rank * len(row.e), spare[i])
                new = max(kind.spread(left), kind.floor)
                change, sigmas[i] = max(change, abs(new / sigmas[i] - 1.0)), new
        if count >= _EARLY and change < _SETTLED and float(step @ N @ step) < _SETTLED**2:
            break
    return Adjusted(
        at=at, information=N, of=tuple(parts), covariance=V, sigmas=tuple(sigmas), spare=tuple(spare), rows=seen
    )


def most_informative(
    known: Array,
    gains: Array,
    n: int,
    value: Callable[[Array], Array],
    allowed: Callable[[list[int]], Array] | None = None,
) -> tuple[list[int], list[float]]:
    """Choose observations, each the one that raises a value of the information most (Atkinson, Donev and Tobias 2007).

    Args:
        known: information (m, m) before. gains: what each of k observations adds (k, m, m). n: how many to choose.
        value: of informations (j, m, m), (j,). allowed: which (k,) may follow those chosen; None: all others.

    Returns:
        Indices of at most n observations in their order, and the value with each.
    """
    chosen: list[int] = []
    values: list[float] = []
    free = np.ones(len(gains), dtype=bool)
    while len(chosen) < n:
        left = np.flatnonzero(free if allowed is None else free & allowed(chosen))
        if not left.size:
            break
        each = value(known + gains[left])
        best = int(left[np.argmax(each)])
        known, free[best] = known + gains[best], False
        chosen.append(best)
        values.append(float(each.max()))
    return chosen, values


def scanned(X: Array, c: Array, basis: Array, factors: Array) -> tuple[Array, Array, Array]:
    """Places of scanned points, X c (1 + basis factors), and their derivatives.

    Args:
        X: pose (4, 4) of the scanner. c: points (n, 3) m in it. basis: terms (n, K) of its error, factors (K,).

    Returns:
        Places (n, 3) in X's parent; derivatives (n, 3, 6) by X and (n, 3, K) by the factors.
    """
    R, p = X[:3, :3], X[:3, 3]
    along = c @ R.T
    q = along * (1.0 + basis @ factors)[:, None]
    return (
        q + p,
        np.concatenate([-skew(q), np.broadcast_to(np.eye(3), (len(c), 3, 3))], axis=2),
        along[:, :, None] * basis[:, None],
    )
