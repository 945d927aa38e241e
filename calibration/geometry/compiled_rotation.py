"""Rotations and cross products for loops that Numba compiles; se3.py has them for arrays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled


@compiled()
def cross_rows(J: Array, v: NDArray[np.floating[Any]], weight: float) -> None:
    """Set the first three columns of J (3, columns) to -skew(v), v (3,), times the weight: how v turns; the diagonal
    stays."""
    J[0, 1], J[0, 2], J[1, 2] = weight * v[2], -weight * v[1], weight * v[0]
    J[1, 0], J[2, 0], J[2, 1] = -weight * v[2], weight * v[1], -weight * v[0]


@compiled()
def rotation_of(w: NDArray[np.floating[Any]]) -> Array:
    """Rotation (3, 3) of a rotation vector (3,) rad (Rodrigues)."""
    angle = np.sqrt(w @ w)
    S = np.zeros((3, 3))
    cross_rows(S, w, -1.0)
    if angle < 1e-4:
        first, second = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0
    else:
        first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    R: Array = np.eye(3) + first * S + second * (S @ S)
    return R
