"""The Denavit-Hartenberg numbers of a chain of link transforms, as a controller's KinematicsInfo holds them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from weldcal.models.arms.kinematics import ArmModel

# Below this twist two axes count as parallel: their distance along the axis then has no part of its own.
PARALLEL_RAD = 1e-9


@dataclass(frozen=True)
class DhChain:
    """theta, a, d, alpha (6 each, rad and m): link i is RotZ(q_i + theta_i) Tz(d_i) Tx(a_i) RotX(alpha_i)."""

    theta: tuple[float, ...]
    a: tuple[float, ...]
    d: tuple[float, ...]
    alpha: tuple[float, ...]


def dh_parameters(model: ArmModel) -> DhChain:
    """X_{i-1,i}(0) = Tx(a) RotX(alpha) Tz(d) RotZ(theta), with the slide along axis i-1 given back to that axis' own d.

    The arm model may slide frames along their axes; with calibrated, nearly parallel axes the numbers that come out are
    hundreds of metres that cancel, just as the robot's own do.
    """
    theta, a, d, alpha = [], [0.0] * 6, [0.0] * 6, [0.0] * 6
    for i, X in enumerate(model.stack):
        theta.append(math.atan2(-X[0, 1], X[0, 0]))
        x, y, z = (float(v) for v in X[:3, 3])
        if i == 0:
            d[0] = z
            continue
        twist = math.atan2(-X[1, 2], X[2, 2])
        a[i - 1], alpha[i - 1] = x, twist
        if abs(math.sin(twist)) < PARALLEL_RAD:
            d[i] = z * math.cos(twist)
        else:
            d[i] = -y / math.sin(twist)
            d[i - 1] -= d[i] * math.cos(twist) - z
    return DhChain(tuple(theta), tuple(a), tuple(d), tuple(alpha))
