"""Robust statistics, what compiled loops need besides (a median, a small Cholesky solution), and the order.

The order of rows says which of two lists of poses belong together. What is the same on both sides of every pair of rows
(the angle of the motion between them, or the distance of two points) gives orders by an assignment. A solution with
each order selects one and shows the rows that have no partner.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtri, fdtrc, fdtri, gammaincinv, stdtrit

from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled

FEWEST_IN_ORDER = 7  # a choice: with fewer rows a wrong order may fit by chance
_MOST_ROWS = 150  # a choice: the assignment of more rows takes minutes
_QUANTILES = np.linspace(0.02, 0.98, 25)
_FORMS = 24  # pairs of readings whose invariants are spread most alike
_ANCHORS = 5  # rows whose partner is tried one by one
_REFINED, _SOLVED = 12, 6  # orders that are refined by all invariants, and solved
_STEPS = 8
_CAP = 0.5  # a choice, of the median: invariants that differ by it are of no pair, however much they differ
_ALONE = 60.0  # squared residuals in sigmas beyond which a row has no partner: a chance of 5e-11
_CLEAR = 25.0  # by how much those of any other partner must exceed those of a row's own: five standard deviations
_LEAST_SHARE = 0.6  # of the shorter list: with fewer partners the lists are of different motions
_OUTSIDE = 6.0  # of the median: rows beyond it do not say how large the noise is
_FLOORS = (2e-6, 1e-6)  # rad, and of the extent: six printed digits
_SAME_POSE = 1e-9  # of two rows that are copies of each other

Rows = NDArray[np.int64]
Pairs = tuple[Rows, Rows]


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


@dataclass(frozen=True, eq=False, kw_only=True)
class OrderFit:
    """A solution with some pairs of rows, and what it leaves of every pair of rows (n, m) of the two lists.

    Attributes:
        turn2, off2: squared residuals of rotation, rad^2, and of position.
        turn, extent: size of the motions, rad, and of the positions.
        agrees: whether the residuals are small against them.
    """

    turn2: Array
    off2: Array
    turn: float
    extent: float
    agrees: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundOrder:
    """Rows (k,) of both lists that belong together, and what is not determined.

    Attributes:
        first, second: the rows, in the order of the first list.
        cost: negative log-likelihood per row; a constant left out.
        agrees: whether the residuals are small against the motion.
        unclear: rows of the first list whose partner is not determined.
    """

    first: Rows
    second: Rows
    cost: float
    agrees: bool
    unclear: tuple[int, ...] = ()

    def partners(self) -> dict[int, int]:
        """Return the row of the second list of each of the first."""
        return dict(zip(self.first.tolist(), self.second.tolist(), strict=True))


Solve = Callable[[int, int, Pairs], OrderFit]


def find_order(ours: Sequence[Array], theirs: Sequence[Array], solve: Solve, poses: Array) -> FoundOrder | None:
    """Return the order in which two lists of n and m rows agree; None where there is none.

    Args:
        ours, theirs: invariants (n, n) and (m, m) of all pairs of rows of each list, one for each of its readings.
        solve: the solution for a reading of each list and pairs of rows.
        poses: (n, ...) of the first list; rows that are copies of each other are no other partners.
    """
    n, m = len(ours[0]), len(theirs[0])
    if min(n, m) < FEWEST_IN_ORDER or max(n, m) > _MOST_ROWS:
        return None
    spread = [[np.quantile(A[np.triu_indices(len(A), 1)], _QUANTILES) for A in one] for one in (ours, theirs)]
    gaps = {
        (a, b): float(np.abs(p - q).mean() / (p.mean() + q.mean() + 1e-12))
        for (a, p), (b, q) in product(enumerate(spread[0]), enumerate(spread[1]))
    }
    guesses = []
    for a, b in sorted(gaps, key=gaps.__getitem__)[:_FORMS]:
        size = float(spread[0][a].mean()) + 1e-12
        guesses += [(cost / size, a, b, pairs) for cost, pairs in _by_invariants(ours[a], theirs[b])]
    guesses.sort(key=lambda one: one[0])
    fits = [_settled(solve, a, b, pairs, poses, min(n, m)) for _, a, b, pairs in guesses[:_SOLVED]]
    good = sorted((one for one in fits if one.agrees), key=lambda one: one.cost)
    if not good or len(good[0].first) < max(FEWEST_IN_ORDER, _LEAST_SHARE * min(n, m)):
        return None
    best, dof = good[0], 3 * min(n, m) - 6
    mine, unclear = best.partners(), set(best.unclear)
    for one in fits:
        if 2.0 * dof * (one.cost - best.cost) < _ALONE:  # another order that the data do not reject
            unclear |= {row for row, partner in one.partners().items() if mine.get(row, partner) != partner}
    return replace(best, unclear=tuple(sorted(unclear)))


def _assigned(cost: Array) -> Pairs:
    from scipy.optimize import linear_sum_assignment  # slow to import

    rows, columns = linear_sum_assignment(cost)
    return np.asarray(rows, dtype=np.int64), np.asarray(columns, dtype=np.int64)


def _by_invariants(A: Array, B: Array) -> list[tuple[float, Pairs]]:
    """Orders that make the invariants A (n, n) and B (m, m) agree, with their mean difference, the best first."""
    cap = _CAP * float(np.median(A[np.triu_indices(len(A), 1)]))
    starts = [np.abs(np.quantile(A, _QUANTILES, axis=1).T[:, None] - np.quantile(B, _QUANTILES, axis=1).T).mean(axis=2)]
    for i, j in product(np.unique(np.linspace(0, len(A) - 1, _ANCHORS).round().astype(int)), range(len(B))):
        starts.append(np.minimum(np.abs(A[:, i, None] - B[None, :, j]), cap))
    tried = [(cost, _assigned(cost)) for cost in starts]
    tried.sort(key=lambda one: float(one[0][one[1]].mean()))
    found: dict[bytes, tuple[float, Pairs]] = {}
    for _, pairs in tried[:_REFINED]:
        for _ in range(_STEPS):
            new = _assigned(np.minimum(np.abs(A[:, None, pairs[0]] - B[None, :, pairs[1]]), cap).mean(axis=2))
            if all(map(np.array_equal, new, pairs)):
                break
            pairs = new
        value = float(np.minimum(np.abs(A[np.ix_(pairs[0], pairs[0])] - B[np.ix_(pairs[1], pairs[1])]), cap).mean())
        found.setdefault(pairs[1].tobytes() + pairs[0].tobytes(), (value, pairs))
    return sorted(found.values(), key=lambda one: one[0])[:_SOLVED]


def _settled(solve: Solve, a: int, b: int, pairs: Pairs, poses: Array, shorter: int) -> FoundOrder:
    """Return the order to which solutions lead from a first one."""
    for _ in range(_STEPS):
        fit = solve(a, b, pairs)
        within = sum(d[pairs] / np.median(d[pairs] + 1e-30) for d in (fit.turn2, fit.off2))
        kept = within <= np.median(within) * _OUTSIDE
        size = [
            float(d[pairs][kept].sum()) / max(3 * int(kept.sum()) - 6, 1) + (floor * of) ** 2
            for d, floor, of in ((fit.turn2, _FLOORS[0], 1.0), (fit.off2, _FLOORS[1], fit.extent))
        ]
        misfit = np.minimum(fit.turn2 / size[0] + fit.off2 / size[1], _ALONE)
        rows, columns = _assigned(misfit)
        near = misfit[rows, columns] < _ALONE
        new = rows[near], columns[near]
        if len(new[0]) < FEWEST_IN_ORDER or all(map(np.array_equal, new, pairs)):
            break
        pairs = new
    logs = 0.5 * len(pairs[0]) * (np.log(size[0] / fit.turn**2) + np.log(size[1] / fit.extent**2)) / shorter
    unclear = tuple(_unclear(misfit, pairs, poses))
    return FoundOrder(first=pairs[0], second=pairs[1], cost=float(logs), agrees=fit.agrees, unclear=unclear)


def _unclear(misfit: Array, pairs: Pairs, poses: Array) -> Iterator[int]:
    """Rows of the first list that may have another partner, given squared residuals (n, m) in sigmas."""
    total = float(misfit[_assigned(misfit)].sum())
    flat = poses.reshape(len(poses), -1)
    for i, j in zip(*pairs, strict=True):
        alike = np.abs(flat - flat[i]).max(axis=1) <= _SAME_POSE * max(float(np.abs(flat[i]).max()), 1.0)
        other = misfit.copy()
        other[alike, j] = 2.0 * total + 1e3 * _ALONE  # a copy of the same pose is no other partner
        if float(other[_assigned(other)].sum()) - total < _CLEAR:
            yield int(i)
