"""Denavit-Hartenberg rows of an arm, from its link transforms and back."""

import math

import numpy as np

from weldcal.models.arms.kinematics import Chain, joint_frames
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

# Below this twist two axes count as parallel: their distance along the axis then has no part of its own.
PARALLEL_RAD = 1e-9


def dh_frames(rows: Array, q: Array) -> Array:
    """Poses (n, 7, 4, 4) of the base and of the frames after each joint, for rows (6, 4) and joints (n, 6) rad."""
    a, alpha, d, theta = rows.T
    links = np.tile(np.eye(4), (len(rows), 1, 1))
    links[:, 0, 3], links[:, 2, 3] = a, d
    links[:, 1, 1] = links[:, 2, 2] = np.cos(alpha)
    links[:, 2, 1] = np.sin(alpha)
    links[:, 1, 2] = -links[:, 2, 1]
    base = np.tile(np.eye(4), (len(q), 1, 1, 1))
    return np.concatenate([base, joint_frames(np.concatenate([base[0], links[:-1]]), q + theta) @ links], axis=1)


def dh_parameters(arm: Chain) -> Array:
    """Rows (n, 4) [a m, alpha rad, d m, theta rad] with X_BF = prod RotZ(q_i + theta_i) Tz(d_i) Tx(a_i) RotX(alpha_i).

    Each link transform is split about the common normal of its two joint axes into
    RotZ(theta') Tz(d') Tx(a) RotX(alpha) RotZ(theta) Tz(d); the primed parts belong to the joint before. The model may
    slide frames along their axes; with calibrated, nearly parallel axes the numbers that come out are hundreds of
    metres that cancel, just as the robot's own do.

    Raises:
        InputError: the first joint's axis is not the base's z axis, which these numbers cannot say.
    """
    a, alpha, d, theta = rows = np.zeros((4, arm.n))
    first = arm.stack[0]
    if float(np.abs([*first[:2, 3], *first[:2, 2]]).max()) > PARALLEL_RAD:
        raise InputError("The first joint of this calibration does not turn about the base's z axis.")
    theta[0], d[0] = math.atan2(first[1, 0], first[0, 0]), float(first[2, 3])
    for i, X in enumerate(arm.stack[1:], 1):
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
    return rows.T


def _half_turn(y: float, x: float) -> float:
    """atan2 of a line, which has no direction: in [-pi/2, pi/2], so that lengths keep their sign."""
    if x == 0.0 and y == 0.0:
        return 0.0
    return math.atan2(y, x) if x >= 0.0 else math.atan2(-y, -x)


def _about_z(angle: float) -> Array:
    X = np.eye(4)
    X[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return X
