"""Kinematics of an arm for control ticks: those of `kinematics` in a tenth of the time.

The machine code is loaded with the module.
"""

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled


def tick_flange_pose(arm: ArmModel, q: Array) -> RigidTransform:
    """Flange pose X_BF at joint angles q (6,) rad; see `kinematics.forward_kinematics`."""
    return RigidTransform(_chain(arm.stack, q)[5])


def tick_jacobian(arm: ArmModel, q: Array, p_FP: Array) -> Array:
    """Geometric Jacobian (6, 6) of point P fixed in F; see `kinematics.kinematics_and_jacobian`."""
    X = _chain(arm.stack, q)
    J = np.empty((6, 6))
    _fill_jacobian(X, X[5, :3, :3] @ p_FP, J)
    return J


def _chain(stack: Array, q: Array) -> Array:
    """Poses (6, 4, 4) of the six links in B."""
    # copies: the code is compiled anew for each kind of view; sines as NumPy's
    poses = np.array(stack, dtype=np.float64, order="C")
    _turn_and_chain(poses, np.cos(q), np.sin(q))
    return poses


@compiled()
def _turn_and_chain(step: Array, c: Array, s: Array) -> None:
    """Turn each link's transform (6, 4, 4) by its joint about z, then multiply them along the chain, in place."""
    for i in range(6):
        for r in range(4):
            x, y = step[i, r, 0], step[i, r, 1]
            step[i, r, 0] = x * c[i] + y * s[i]
            step[i, r, 1] = y * c[i] - x * s[i]
    # element by element: np.dot and whole rows take five times the time to compile, and longer to run
    product = np.empty((3, 4))
    for i in range(1, 6):
        for r in range(3):
            for k in range(4):
                product[r, k] = (
                    step[i - 1, r, 0] * step[i, 0, k]
                    + step[i - 1, r, 1] * step[i, 1, k]
                    + step[i - 1, r, 2] * step[i, 2, k]
                    + step[i - 1, r, 3] * step[i, 3, k]
                )
        for r in range(3):
            for k in range(4):
                step[i, r, k] = product[r, k]


@compiled()
def _fill_jacobian(X: Array, p_F: Array, J: Array) -> None:
    """Fill J (6, 6) from the links' poses X (6, 4, 4); ``p_F`` (3,) m is P from the flange, in axes of B."""
    for i in range(6):
        z0, z1, z2 = X[i, 0, 2], X[i, 1, 2], X[i, 2, 2]
        r0, r1, r2 = (
            (p_F[0] + X[5, 0, 3]) - X[i, 0, 3],
            (p_F[1] + X[5, 1, 3]) - X[i, 1, 3],
            (p_F[2] + X[5, 2, 3]) - X[i, 2, 3],
        )
        J[0, i], J[1, i], J[2, i] = z0, z1, z2
        J[3, i] = z1 * r2 - z2 * r1
        J[4, i] = z2 * r0 - z0 * r2
        J[5, i] = z0 * r1 - z1 * r0


def _load() -> None:
    """Load the machine code, for which no tick has time."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    _turn_and_chain(poses, np.ones(6), np.zeros(6))
    _fill_jacobian(poses, np.zeros(3), np.empty((6, 6)))


_load()
