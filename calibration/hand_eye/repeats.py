"""Repeats of a pose: one observation, measured as often as it was repeated."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from weldcal.calibration.geometry.se3 import IDENTITY, inverse, log_rotation, mean_of
from weldcal.calibration.hand_eye.choice import solve
from weldcal.calibration.hand_eye.problem import Problem, State
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError

SAME_RAD = 5e-4  # 0.03 deg, a choice: above what arms repeat to (1e-4), below any turn taken on purpose
"""Angle up to which two robot poses are one."""
SAME_SHARE = 5e-4  # a choice: as the angle, at a lever of the extent
"""Distance up to which two robot poses are one, as a share of the extent of the motion."""
_GROSS = 8.0  # sigma of a sample: a repeat beyond it is not averaged with the others


@dataclass(frozen=True)
class Repeats:
    """Observations without repeats.

    Attributes:
        problem: the means over the repeats (m observations); its covariances state by how much a mean of few repeats is
            less certain than one of the most repeats.
        observation: (n,) for each sample the observation that it belongs to.
        agrees: (n,) whether the sample is part of its observation's mean: not where it disagrees grossly with the other
            repeats.
    """

    problem: Problem
    observation: NDArray[np.int64]
    agrees: NDArray[np.bool_]


@dataclass(frozen=True)
class _Noise:
    """Variances per axis of one sample, and the point ``centre`` (3,) of the target where they hold."""

    rotation: float
    translation: float
    centre: Array


def one_per_pose(problem: Problem, known: State = (IDENTITY, IDENTITY, IDENTITY), *, join: bool = True) -> Repeats:
    """Join the samples at one robot pose into one observation.

    An error of the robot or of the camera at that pose is the same in each repeat, so that repeats do not average it.
    Poses and measurements are averaged on SE(3). The noise of a sample, which holds that error and the repeat's own, is
    the most that repeats may vary by. Motions, points and normals stay as they are.
    """
    n = len(problem)
    alone = Repeats(problem, np.arange(n), np.ones(n, dtype=bool))
    if not join or problem.tied or n < 2 or not problem.all_full:
        return alone
    place = distinct_poses(problem)
    if int(place.max()) == n - 1:
        return alone
    noise = _noise(problem.pick(np.unique(place, return_index=True)[1]), known)
    return _joined(problem, *_without_gross(problem, place, noise), noise)


def _noise(problem: Problem, known: State) -> _Noise:
    """Return the noise of one sample of each pose; infinite where no solution is found."""
    try:
        found = solve(problem, known, usual_discord=0.0).fit
    except WeldcalError:
        return _Noise(np.inf, np.inf, np.zeros(3))
    own = np.zeros(6) if problem.covariance is None else problem.covariance.diagonal(axis1=1, axis2=2).max(axis=0)
    return _Noise(found.noise.rotation + own[:3].max(), found.noise.translation + own[3:].max(), found.centre)


def distinct_poses(problem: Problem) -> NDArray[np.int64]:
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


def _without_gross(
    problem: Problem, place: NDArray[np.int64], noise: _Noise
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the numbers (n,) of the observations, and whether each sample agrees with its like.

    Of three repeats or more, one that disagrees grossly with the others is wrong. Of two, nobody knows which: each is
    an observation.
    """
    gross = np.zeros(len(place), dtype=bool)
    for k in np.flatnonzero(np.bincount(place) > 1):
        rows = np.flatnonzero(place == k)
        middle = _most_central(problem.G[rows], problem.extent)
        w, d = _deviation(problem.G[rows[middle]], problem.G[rows], noise.centre)
        # the difference of two samples
        size = np.maximum((w**2).sum(axis=1) / noise.rotation, (d**2).sum(axis=1) / noise.translation) / 2.0
        gross[rows] = size > 3.0 * _GROSS**2
    agreeing = np.bincount(place, weights=~gross)[place]
    lone = gross & (agreeing < 2)
    out = place.copy()
    out[lone] = int(place.max()) + 1 + np.arange(int(lone.sum()))
    _, first, label = np.unique(out, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first, kind="stable"), kind="stable")
    return np.asarray(order[label], dtype=np.int64), ~gross | lone


def _most_central(G: Array, extent: float) -> int:
    """Return the pose with the least median distance to the others; of many, one of an even choice."""
    some = np.unique(np.linspace(0, len(G) - 1, min(len(G), 30)).round().astype(int))
    cost = []
    for k in some:
        w, d = _deviation(G[k], G[some], np.zeros(3))
        cost.append(float(np.median((w**2).sum(axis=1) + (d**2).sum(axis=1) / extent**2)))
    return int(some[int(np.argmin(cost))])


def _deviation(middle: Array, G: Array, centre: Array) -> tuple[Array, Array]:
    """Rotations (n, 3) rad of poses from one, and displacements (n, 3) of a point of the target, in its axes."""
    D = inverse(middle) @ G
    return log_rotation(D[:, :3, :3]), D[:, :3, 3] + (D[:, :3, :3] - np.eye(3)) @ centre


def _joined(problem: Problem, place: NDArray[np.int64], agrees: NDArray[np.bool_], noise: _Noise) -> Repeats:
    used = np.flatnonzero(agrees)
    first = used[np.unique(place[used], return_index=True)[1]]
    count = np.bincount(place[used])
    out = {name: getattr(problem, name)[first].copy() for name in ("F", "G", "H")}
    turned, shifted = [], []
    for k in np.flatnonzero(count > 1):
        rows = used[place[used] == k]
        for name, X in out.items():
            X[k] = mean_of(list(getattr(problem, name)[rows]))
        w, d = _deviation(out["G"][k], problem.G[rows], noise.centre)
        turned.append(w)
        shifted.append(d)
    covariance = _own(problem.pick(used), place[used], count, turned, shifted, noise)
    m = len(first)
    joined = replace(problem, **out, full=np.ones(m, dtype=bool), normal=np.zeros(m, dtype=bool), covariance=covariance)
    return Repeats(joined, place, agrees)


def _own(
    problem: Problem,
    place: NDArray[np.int64],
    count: NDArray[np.int64],
    turned: list[Array],
    shifted: list[Array],
    noise: _Noise,
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
    C = np.zeros((m, 6, 6))
    axes = np.arange(3)
    C[:, axes, axes] = more[:, None] * min(float((w**2).sum()) / free, noise.rotation)
    C[:, axes + 3, axes + 3] = more[:, None] * min(float((d**2).sum()) / free, noise.translation)
    return C
