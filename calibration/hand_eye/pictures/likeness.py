"""Correlate the robot's errors at poses near each other, and enlarge the covariance by what they share."""

import numpy as np

from weldcal.calibration.geometry.se3 import angle_of
from weldcal.models.arrays import Array

TURN_RAD, SHIFT_M = 0.35, 0.15  # over which an arm's errors change: 20 degrees of its joints, a quarter of a forearm
_MOST = 300  # poses up to which it is computed: beyond them most poses are far apart


def likeness(robot: Array) -> Array:
    """Correlation (n, n) of the errors of a robot at its poses (n, 4, 4), were all of them kinematic.

    They are smooth functions of the joints, which repeat: Rasmussen and Williams 2006, 4.2.1, exponential of distance.
    """
    turn = angle_of(np.einsum("aji,bjk->abik", robot[:, :3, :3], robot[:, :3, :3]))
    shift = np.linalg.norm(robot[:, None, :3, 3] - robot[None, :, :3, 3], axis=2)
    return np.asarray(np.exp(-np.hypot(turn / TURN_RAD, shift / SHIFT_M)))


def shared_errors(robot: Array, off: Array, sigma: Array, taken: Array, effect: Array) -> tuple[float, float, Array]:
    """Share of the variance that poses near each other have in common, and what it adds to a covariance.

    The share makes the products of neighbours' errors what they are expected to be after the solution took its part
    (Helmert's estimator); the variances grow by what the solution took of errors that are alike.

    Args:
        robot: poses (n, 4, 4).
        off: their errors (n, 6) as found.
        sigma: of each number of an error (6,).
        taken: derivative (n, 6, 12) of the errors by the unknown poses.
        effect: of an error on the unknowns whose covariance it is (n, g, 6).

    Returns:
        The share; the independent errors that the poses are worth, over their number; the addition (g, g).
    """
    n, g = len(robot), effect.shape[1]
    if n > _MOST or not n:
        return 0.0, 1.0, np.zeros((g, g))
    k = likeness(robot)
    D = (taken / sigma[:, None]).reshape(6 * n, -1)
    U = np.linalg.qr(D / np.maximum(np.linalg.norm(D, axis=0), 1e-300))[0].reshape(n, 6, -1)  # (n, 6, 12)
    near = k - np.eye(n)
    e = off / sigma

    def left(M: Array, W: Array) -> float:
        """Trace of W Q M Q, where Q takes the columns of U out, of matrices alike for the six numbers."""
        UM, UW = np.einsum("aix,ab->bix", U, M), np.einsum("aix,ab->bix", U, W)
        a = np.einsum("bix,biy->xy", UM, U)
        b = np.einsum("bix,biy->xy", UW, U)
        return float(6.0 * (W * M).sum() - 2.0 * np.einsum("bix,bix->", UW, UM) + np.einsum("xy,xy->", a, b))

    one = np.eye(n)
    product = float(np.einsum("ai,ab,bi->", e, near, e))
    none, whole = left(one, near), left(k, near)
    # in units of the variance that independent errors would have
    share = float(np.clip((product - none) / max(whole - none, 1e-9), 0.0, 1.0))
    grown = left(one, one) / max((1.0 - share) * left(one, one) + share * left(k, one), 1e-9)
    both = (1.0 - share) * one + share * k
    K = grown * both - one
    E = effect * sigma
    return share, n / float((both**2).sum()), np.einsum("agi,ab,bhi->gh", E, K, E, optimize=True)
