"""Three-vectors at servo rate: products that cost a microsecond where `numpy.cross` costs twenty."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

Array = NDArray[np.float64]


def cross(a: Array, b: Array) -> Array:
    """The vector product a x b of two (3,) arrays."""
    a0, a1, a2 = a.tolist()
    b0, b1, b2 = b.tolist()
    return np.array((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0))


def dot(a: Array, b: Array) -> float:
    """The scalar product of two (3,) arrays, as a Python float."""
    a0, a1, a2 = a.tolist()
    b0, b1, b2 = b.tolist()
    return float(a0 * b0 + a1 * b1 + a2 * b2)


def norm(a: Array) -> float:
    """The length of a (3,) array."""
    return math.sqrt(dot(a, a))


def within(a: Array, lower: Array, upper: Array) -> Array:
    """`a` held between two bounds, element by element, as numpy.clip does at three times the cost."""
    return np.minimum(np.maximum(a, lower), upper)


def unit(a: Array, otherwise: Array) -> Array:
    """The direction of a (3,), or `otherwise` (3,) where a is too short to have one."""
    length = norm(a)
    return a / length if length > 1e-12 else otherwise


def clip(value: float, low: float, high: float) -> float:
    """`value` held inside [low, high]."""
    return low if value < low else high if value > high else value


def finite(value: Any) -> bool:
    """Whether every number of `value` is finite."""
    return bool(np.isfinite(np.asarray(value, dtype=float)).all())


def pose(R: Any, p: Any) -> RigidTransform:
    """The rigid transform of a rotation matrix (3,3), rounding taken off, and a translation (3,) m."""
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)
