"""The loops of the forward kinematics and of the geometric Jacobian, compiled: a control tick runs them."""

import numpy as np

from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled


@compiled()
def turn_and_chain(step: Array, q: Array) -> None:
    """Turn each link's transform (6, 4, 4) by its joint about z, then multiply them along the chain, in place."""
    for i in range(6):
        c, s = np.cos(q[i]), np.sin(q[i])
        for r in range(3):
            x, y = step[i, r, 0], step[i, r, 1]
            step[i, r, 0] = x * c + y * s
            step[i, r, 1] = y * c - x * s
        if i == 0:
            continue
        for k in range(4):
            a, b, d = step[i, 0, k], step[i, 1, k], step[i, 2, k]
            for r in range(3):
                X = step[i - 1]
                step[i, r, k] = X[r, 0] * a + X[r, 1] * b + X[r, 2] * d + (X[r, 3] if k == 3 else 0.0)


@compiled()
def geometric_jacobian(X: Array, p_FP: Array, p: Array, J: Array) -> None:
    """Fill p_BP (3,) and J (6, 6) from the links' poses X (6, 4, 4)."""
    for r in range(3):
        p[r] = X[5, r, 3]
        for k in range(3):
            p[r] += X[5, r, k] * p_FP[k]
    for i in range(6):
        z0, z1, z2 = X[i, 0, 2], X[i, 1, 2], X[i, 2, 2]
        r0, r1, r2 = p[0] - X[i, 0, 3], p[1] - X[i, 1, 3], p[2] - X[i, 2, 3]
        J[0, i], J[1, i], J[2, i] = z0, z1, z2
        J[3, i] = z1 * r2 - z2 * r1
        J[4, i] = z2 * r0 - z0 * r2
        J[5, i] = z0 * r1 - z1 * r0
