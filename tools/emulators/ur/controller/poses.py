"""UR poses [x, y, z, rx, ry, rz] with a rotation vector, and their conversions."""

import math
from collections.abc import Sequence

import numpy as np

from weldcal.models.arrays import Array


def rotation_matrix(vector: Sequence[float] | Array) -> Array:
    """R (3, 3) of a rotation vector (rad), by Rodrigues' formula."""
    x, y, z = (float(value) for value in vector)
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    x, y, z = x / angle, y / angle, z / angle
    c, s = math.cos(angle), math.sin(angle)
    t = 1.0 - c
    return np.array(
        [
            [t * x * x + c, t * x * y - s * z, t * x * z + s * y],
            [t * x * y + s * z, t * y * y + c, t * y * z - s * x],
            [t * x * z - s * y, t * y * z + s * x, t * z * z + c],
        ]
    )


def rotation_vector(R: Array) -> Array:
    """The rotation vector (3,) rad of R, its angle in [0, pi]; through the quaternion, so exact at every angle."""
    m = R.tolist()
    trace = m[0][0] + m[1][1] + m[2][2]
    squares = [trace, m[0][0], m[1][1], m[2][2]]
    largest = squares.index(max(squares))
    if largest == 0:
        w, x, y, z = 1.0 + trace, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        part = [0.0, 0.0, 0.0]
        part[i] = 1.0 + m[i][i] - m[j][j] - m[k][k]
        part[j] = m[j][i] + m[i][j]
        part[k] = m[k][i] + m[i][k]
        w = m[k][j] - m[j][k]
        x, y, z = part
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    if sine < 1e-15 * w:
        return np.zeros(3)
    scale = 2.0 * math.atan2(sine, w) / sine
    return np.array([x * scale, y * scale, z * scale])


def matrix(pose: Sequence[float] | Array) -> Array:
    """The homogeneous matrix (4, 4) of a pose."""
    X = np.eye(4)
    X[:3, :3] = rotation_matrix(pose[3:6])
    X[:3, 3] = pose[:3]
    return X


def pose_of(X: Array) -> list[float]:
    """The pose of a homogeneous matrix (4, 4)."""
    return [*X[:3, 3].tolist(), *rotation_vector(X[:3, :3]).tolist()]


def inverse(X: Array) -> Array:
    """The inverse of a rigid homogeneous matrix."""
    out = np.eye(4)
    out[:3, :3] = X[:3, :3].T
    out[:3, 3] = -X[:3, :3].T @ X[:3, 3]
    return out


def pose_error(X_goal: Array, R: Array, p: Array) -> Array:
    """The twist [omega; v] that takes (R, p) to X_goal in one unit of time, in base axes."""
    return np.concatenate([rotation_vector(X_goal[:3, :3] @ R.T), X_goal[:3, 3] - p])
