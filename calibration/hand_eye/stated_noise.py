"""Covariance of a hand-eye result whose observations state their own covariances."""

from dataclasses import replace

import numpy as np

from weldcal.calibration.hand_eye.determinacy import determinacy, with_open_directions
from weldcal.calibration.hand_eye.linearisation import inverse_information
from weldcal.calibration.hand_eye.problem import NAMES, Problem, State, linearise
from weldcal.calibration.hand_eye.solve import HandEyeResult
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError


def with_stated_noise(problem: Problem, known: State, result: HandEyeResult) -> HandEyeResult:
    """The result with the covariance of least squares whose noise is known: the inverse information of the stated covariances,
    inflated by the reduced chi-square where the residuals are larger than stated (Birge ratio, never below one).

    A few residuals may turn out small by chance, and a scale that is estimated from them then claims too much: with six
    poses by a factor of three. ``known`` holds the poses that were given. Raises InputError without covariances.
    """
    if problem.covariance is None:
        raise InputError("Every observation must state its covariance.")
    used = problem.pick(result.inliers)
    parts = [np.asarray(result.poses[k].GetAsMatrix4()) if k in result.poses else known[i] for i, k in enumerate(NAMES)]
    state = parts[0], parts[1], parts[2]
    N, chi2, numbers = information_of(used, state)
    rank = int(np.linalg.matrix_rank(inverse_information(N), hermitian=True))
    free = max(numbers - rank, 1)
    covariance = inverse_information(N) * max(1.0, chi2 / free)
    noise = (
        float(np.sqrt(np.median(np.diagonal(used.covariance, axis1=1, axis2=2)[:, :2])))
        if used.covariance is not None
        else 0.0
    )
    found = determinacy(used, state, N, covariance, result.extent, noise, result.labels)
    covariance = with_open_directions(covariance, found, result.extent)
    rows = {name: slice(6 * i, 6 * i + 6) for i, name in enumerate(result.poses)}
    return replace(
        result,
        covariance={name: covariance[r, r] for name, r in rows.items()},
        joint_covariance=covariance,
        degrees_of_freedom=float(free),
        unobservable=tuple(dict.fromkeys((*result.unobservable, *found.names))),
    )


def information_of(problem: Problem, state: State) -> tuple[Array, float, int]:
    """Information (m, m) of observations with stated covariances, their chi-square, and how many numbers were measured."""
    assert problem.covariance is not None
    lin = linearise(problem, state, np.zeros(3))
    N, chi2, numbers = np.zeros((problem.size, problem.size)), 0.0, 0
    for i, C in enumerate(problem.covariance):
        turns = [0, 1, 2] if problem.full[i] else [0, 1] if problem.normal[i] else []
        rows = [*turns, 3, 4, 5]
        W = np.linalg.inv(C[np.ix_(rows, rows)])
        J = np.vstack([lin.Jw[i], lin.Jd[i]])[rows]
        e = np.concatenate([lin.w[i], lin.d[i]])[rows]
        N += J.T @ W @ J
        chi2 += float(e @ W @ e)
        numbers += len(rows)
    return N, chi2, numbers
