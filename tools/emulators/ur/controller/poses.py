"""UR poses [x, y, z, rx, ry, rz] and Denavit-Hartenberg parameters, and their conversions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

# Below this twist two axes count as parallel: their distance along the axis then has no part of its own.
PARALLEL_RAD = 1e-9


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
    """Return the homogeneous matrix (4, 4) of a pose."""
    X = np.eye(4)
    X[:3, :3] = rotation_matrix(pose[3:6])
    X[:3, 3] = pose[:3]
    return X


def pose_of(X: Array) -> list[float]:
    """Return the pose of a homogeneous matrix (4, 4)."""
    return [*X[:3, 3].tolist(), *rotation_vector(X[:3, :3]).tolist()]


def inverse(X: Array) -> Array:
    """Return the inverse of a rigid homogeneous matrix."""
    out = np.eye(4)
    out[:3, :3] = X[:3, :3].T
    out[:3, 3] = -X[:3, :3].T @ X[:3, 3]
    return out


def pose_error(X_goal: Array, R: Array, p: Array) -> Array:
    """Return the twist [omega; v] that takes (R, p) to X_goal in one unit of time, in base axes."""
    return np.concatenate([rotation_vector(X_goal[:3, :3] @ R.T), X_goal[:3, 3] - p])


@dataclass(frozen=True)
class DhChain:
    """theta, a, d, alpha (6 each, rad and m): link i is RotZ(q_i + theta_i) Tz(d_i) Tx(a_i) RotX(alpha_i)."""

    theta: tuple[float, ...]
    a: tuple[float, ...]
    d: tuple[float, ...]
    alpha: tuple[float, ...]


def dh_parameters(model: ArmModel) -> DhChain:
    """Return the numbers whose plain chain is the model's: prod RotZ(q_i + theta_i) Tz(d_i) Tx(a_i) RotX(alpha_i).

    Each link transform is split about the common normal of its two joint axes into
    RotZ(theta') Tz(d') Tx(a) RotX(alpha) RotZ(theta) Tz(d); the primed parts belong to the joint before. The model may
    slide frames along their axes; with calibrated, nearly parallel axes the numbers that come out are hundreds of
    metres that cancel, just as the robot's own do.

    Raises:
        InputError: the first joint's axis is not the base's z axis, which these numbers cannot say.
    """
    theta, a, d, alpha = [0.0] * 6, [0.0] * 6, [0.0] * 6, [0.0] * 6
    first = model.stack[0]
    if float(np.abs([*first[:2, 3], *first[:2, 2]]).max()) > PARALLEL_RAD:
        raise InputError("The first joint of this calibration does not turn about the base's z axis.")
    theta[0], d[0] = math.atan2(first[1, 0], first[0, 0]), float(first[2, 3])
    for i, X in enumerate(model.stack[1:], 1):
        across = math.hypot(X[0, 2], X[1, 2])
        if across < PARALLEL_RAD:
            before, twist = _half_turn(float(X[1, 3]), float(X[0, 3])), math.atan2(0.0, X[2, 2])
        else:
            before = _half_turn(float(X[0, 2]), -float(X[1, 2]))
            twist = math.atan2(X[0, 2] * math.sin(before) - X[1, 2] * math.cos(before), X[2, 2])
        Y = _about_z(-before) @ X
        a[i - 1], alpha[i - 1] = float(Y[0, 3]), twist
        theta[i - 1] += before
        # the turn that is left about the new axis: RotX(-alpha) applied to the first column
        theta[i] = math.atan2(Y[1, 0] * math.cos(twist) + Y[2, 0] * math.sin(twist), Y[0, 0])
        if across < PARALLEL_RAD:
            d[i] = float(Y[2, 3]) * math.cos(twist)
        else:
            d[i] = -float(Y[1, 3]) / math.sin(twist)
            d[i - 1] += float(Y[2, 3]) - d[i] * math.cos(twist)
    return DhChain(tuple(theta), tuple(a), tuple(d), tuple(alpha))


def _half_turn(y: float, x: float) -> float:
    """atan2 of a line, which has no direction: in [-pi/2, pi/2], so that lengths keep their sign."""
    if x == 0.0 and y == 0.0:
        return 0.0
    return math.atan2(y, x) if x >= 0.0 else math.atan2(-y, -x)


def _about_z(angle: float) -> NDArray[np.float64]:
    X = np.eye(4)
    X[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return X
