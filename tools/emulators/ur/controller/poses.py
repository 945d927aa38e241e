"""UR poses [x, y, z, rx, ry, rz] and their conversions."""

from collections.abc import Sequence

import numpy as np

from weldcal.calibration.geometry.se3 import exp_rotation, log_rotation, pose
from weldcal.models.arrays import Array


def rotation_vector(R: Array) -> Array:
    """The rotation vector (3,) rad of R, its angle in [0, pi]."""
    return np.asarray(log_rotation(R[None])[0])


def matrix(values: Sequence[float] | Array) -> Array:
    """Return the homogeneous matrix (4, 4) of a pose."""
    return pose(exp_rotation(np.asarray(values[3:6], dtype=float)), np.asarray(values[:3], dtype=float))


def pose_of(X: Array) -> list[float]:
    """Return the pose of a homogeneous matrix (4, 4)."""
    return [*X[:3, 3].tolist(), *rotation_vector(X[:3, :3]).tolist()]
