"""Calibrates simulated frames in motion with the motion known exactly: what chance alone makes of the errors of the same draws."""

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.geometry.se3 import difference, exp_rotation, skew
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.calibration.planning.moves import Moves
from weldcal.models.arrays import Array

_STEP_S = 1e-4
_ROUNDS = 3


def exact_errors(frames: ObservedFrames, capture: Array, moves: Moves, X_BC: RigidTransform) -> Array:
    """Errors (7,) of X_BC's six and of the clock's offset in sigmas, by least squares with the true motion and noise.

    The capture times (N,) s are known but for an offset and a drift, as those of a device are. An estimator can do no better, so that
    what this differs from the normal law by is the draw.
    """
    X = moves.at(capture)
    rate = (moves.at(capture + _STEP_S) - moves.at(capture - _STEP_S)) / (2.0 * _STEP_S)
    p, n = X[:, :3, 3], X[:, :3, 2]
    A = _tangents(n)
    At = np.swapaxes(A, 1, 2)
    g = np.concatenate([rate[:, :3, 3], np.einsum("nij,nj->ni", At, rate[:, :3, 2])], axis=1)
    found = X_BC
    N = np.eye(8)
    offset = 0.0
    for _ in range(_ROUNDS):
        R, t = found.rotation().matrix(), np.asarray(found.translation())
        y = np.concatenate([frames.p_C @ R.T + t - p, np.einsum("nij,nj->ni", At, frames.n_C @ R.T - n)], axis=1)
        J = np.zeros((len(capture), 5, 8))
        J[:, :3, :3], J[:, :3, 3:6] = -skew(frames.p_C @ R.T), np.eye(3)
        J[:, 3:, :3] = -At @ skew(frames.n_C @ R.T)
        J[:, :, 6], J[:, :, 7] = -g, -g * (capture - capture.mean())[:, None]
        W = np.zeros((len(capture), 5, 5))
        W[:, :3, :3] = np.linalg.inv(R @ frames.covariance @ R.T)
        W[:, 3, 3] = W[:, 4, 4] = 1.0 / frames.normal_sigma**2
        N = np.einsum("nia,nij,njb->ab", J, W, J)
        step = -np.linalg.solve(N, np.einsum("nia,nij,nj->a", J, W, y))
        turn = RotationMatrix.ProjectToRotationMatrix(exp_rotation(step[:3]) @ R)
        found, offset = RigidTransform(turn, t + step[3:6]), float(step[6])
    error = np.append(-difference(found.GetAsMatrix4(), X_BC.GetAsMatrix4()), offset)
    return np.asarray(error / np.sqrt(np.diag(np.linalg.inv(N))[:7]))


def _tangents(n: Array) -> Array:
    """Two unit vectors (N, 3, 2) at right angles to normals n (N, 3)."""
    other = np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(n, other)
    x /= np.linalg.norm(x, axis=1)[:, None]
    return np.stack([x, np.cross(n, x)], axis=2)
