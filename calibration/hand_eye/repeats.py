"""Repeats of a pose: one observation, measured as often as it was repeated."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from weldcal.calibration.geometry.se3 import inverse, log_rotation, mean_of
from weldcal.calibration.hand_eye.problem import Problem
from weldcal.models.arrays import Array

SAME_RAD = 5e-4
"""Angle up to which two robot poses are one."""
SAME_SHARE = 5e-4
"""Distance up to which two robot poses are one, as a share of the extent of the motion."""
_MANY, _MOSTLY = 40, 0.5
"""Of more poses, of which fewer than this share are repeated, the samples are of a recorded motion: its pauses are no repeats. Chosen on two
recorded arms (81 and 198 poses, 6 % and 1 % repeated); poses that an operator takes are tens."""
_GROSS = 8.0  # sigma of a repeat, from the medians: a repeat beyond it is not averaged with the others
_MEDIAN_CHI2_3 = 2.366  # of a chi-square of three numbers


@dataclass(frozen=True)
class Repeats:
    """Observations without repeats.

    Attributes:
        problem: the means over the repeats (m observations); its covariances state by how much a mean of few repeats is less
            certain than one of the most repeats.
        observation: (n,) for each sample the observation that it belongs to.
        agrees: (n,) whether the sample is part of its observation's mean: not where it disagrees grossly with the other repeats.
    """

    problem: Problem
    observation: NDArray[np.int64]
    agrees: NDArray[np.bool_]


def one_per_pose(problem: Problem, *, join: bool = True) -> Repeats:
    """Join the samples at one robot pose into one observation.

    An error of the robot or of the camera at that pose is the same in each repeat, so that repeats do not average it. Poses and
    measurements are averaged on SE(3). A recorded motion with pauses, motions, points and normals stay as they are.
    """
    n = len(problem)
    alone = Repeats(problem, np.arange(n), np.ones(n, dtype=bool))
    if not join or problem.tied or n < 2 or not problem.all_full:
        return alone
    place = _places(problem)
    count = np.bincount(place)
    recorded = len(count) > _MANY and float((count > 1).mean()) < _MOSTLY
    if len(count) == n or recorded:
        return alone
    return _joined(problem, *_without_gross(problem, place))


def _places(problem: Problem) -> NDArray[np.int64]:
    """Number (n,) of the distinct robot pose of each sample, in the order of first appearance."""
    stated = (problem.F, problem.H) if float(np.abs(problem.H - problem.H[0]).max()) > 0.0 else (problem.F,)
    # the chordal distance of two rotation matrices is sqrt(2) times the angle
    x = np.concatenate(
        [
            part
            for X in stated
            for part in (
                X[:, :3, :3].reshape(-1, 9) / (np.sqrt(2.0) * SAME_RAD),
                X[:, :3, 3] / (SAME_SHARE * problem.extent),
            )
        ],
        axis=1,
    )
    tree = cKDTree(x)
    near = np.asarray(tree.query(x, k=2)[0])[:, 1] <= 1.0
    place = np.full(len(x), -1, dtype=np.int64)
    count = 0
    for i in range(len(x)):
        if place[i] >= 0:
            continue
        like = np.asarray(tree.query_ball_point(x[i], 1.0), dtype=int) if near[i] else np.array([i])
        place[like[place[like] < 0]] = count
        count += 1
    return place


def _without_gross(problem: Problem, place: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The numbers (n,) of the observations, and whether each sample agrees with its like.

    Of three repeats or more, one that disagrees grossly with the others is wrong. Of two, nobody knows which: each is an observation.
    """
    squares = np.zeros((len(place), 2))
    repeated = np.flatnonzero(np.bincount(place) > 1)
    groups = [np.flatnonzero(place == k) for k in repeated]
    for rows in groups:
        middle = _most_central(problem.G[rows], problem.extent)
        w, d = _deviation(problem.G[rows[middle]], problem.G[rows])
        squares[rows] = np.column_stack([(w**2).sum(axis=1), (d**2).sum(axis=1)])
    own = np.concatenate(groups)
    sigma = np.median(squares[own], axis=0) / _MEDIAN_CHI2_3
    sigma = np.where(sigma > 0.0, sigma, squares[own].mean(axis=0))
    gross = (squares > 3.0 * _GROSS**2 * np.maximum(sigma, 1e-300)).any(axis=1)
    agreeing = np.bincount(place, weights=~gross)[place]
    lone = gross & (agreeing < 2)
    out = place.copy()
    out[lone] = int(place.max()) + 1 + np.arange(int(lone.sum()))
    _, first, label = np.unique(out, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first, kind="stable"), kind="stable")
    return np.asarray(order[label], dtype=np.int64), ~gross | lone


def _most_central(G: Array, extent: float) -> int:
    """The pose with the least median distance to the others; of many, one of an even choice."""
    some = np.unique(np.linspace(0, len(G) - 1, min(len(G), 30)).round().astype(int))
    cost = []
    for k in some:
        w, d = _deviation(G[k], G[some])
        cost.append(float(np.median((w**2).sum(axis=1) + (d**2).sum(axis=1) / extent**2)))
    return int(some[int(np.argmin(cost))])


def _deviation(middle: Array, G: Array) -> tuple[Array, Array]:
    """Rotations (n, 3) rad and displacements (n, 3) of poses from one, in its axes."""
    D = inverse(middle) @ G
    return log_rotation(D[:, :3, :3]), D[:, :3, 3]


def _joined(problem: Problem, place: NDArray[np.int64], agrees: NDArray[np.bool_]) -> Repeats:
    used = np.flatnonzero(agrees)
    first = used[np.unique(place[used], return_index=True)[1]]
    count = np.bincount(place[used])
    out = {name: getattr(problem, name)[first].copy() for name in ("F", "G", "H")}
    turned, shifted = [], []
    for k in np.flatnonzero(count > 1):
        rows = used[place[used] == k]
        for name, X in out.items():
            X[k] = mean_of(list(getattr(problem, name)[rows]))
        w, d = _deviation(out["G"][k], problem.G[rows])
        turned.append(w)
        shifted.append(d)
    covariance = _own(problem.pick(used), place[used], count, turned, shifted)
    m = len(first)
    joined = replace(problem, **out, full=np.ones(m, dtype=bool), normal=np.zeros(m, dtype=bool), covariance=covariance)
    return Repeats(joined, place, agrees)


def _own(
    problem: Problem, place: NDArray[np.int64], count: NDArray[np.int64], turned: list[Array], shifted: list[Array]
) -> Array | None:
    """Covariances (m, 6, 6) of the means beyond what all share; None where all are repeated alike.

    The noise that the solver estimates is that of a mean of the most repeats, so that it is never below zero.
    """
    m = len(count)
    if problem.covariance is not None:
        total = np.zeros((m, 6, 6))
        np.add.at(total, place, problem.covariance)
        return np.asarray(total / count[:, None, None] ** 2)
    more = 1.0 / count - 1.0 / count.max()
    if not turned or not more.any():
        return None
    w, d = np.concatenate(turned), np.concatenate(shifted)
    free = 3.0 * float((count[count > 1] - 1).sum())
    # a board errs about its middle, not about the origin of its frame
    lever = np.zeros((len(w), 3, 3))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        lever[:, i, j], lever[:, i, k] = -w[:, k], w[:, j]
    centre = np.linalg.lstsq(lever.reshape(-1, 3), -d.reshape(-1), rcond=1e-9)[0]
    d = d + lever @ centre
    C = np.zeros((m, 6, 6))
    axes = np.arange(3)
    C[:, axes, axes] = more[:, None] * float((w**2).sum()) / free
    C[:, axes + 3, axes + 3] = more[:, None] * float((d**2).sum()) / free
    return C
