"""Paths of the position motions: straight in the joints, straight or round with the tool centre point."""

from collections.abc import Callable

import numpy as np

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.tools.emulators.ur.controller.motions import MotionRefused, Path, newton
from weldcal.tools.emulators.ur.controller.poses import inverse, rotation_matrix, rotation_vector

NOTHING = 1e-9  # a path shorter than this (m or rad) is none
TURNED_ONLY_M = 1e-6


def joint_path(q_from: Array, q_to: Array, speed: float, acceleration: float, limit: Array) -> Path | None:
    """movej's path, its speed that of the leading joint; None where there is nothing to move."""
    change = q_to - q_from
    length = float(np.abs(change).max())
    if length < NOTHING:
        return None
    direction = change / length
    # [M] movej never asks a joint for more than it can do
    speed = min(speed, float((limit / np.maximum(np.abs(direction), 1e-9)).min()))
    return Path(lambda s, _: q_to if s >= length else q_from + direction * s, length, speed, acceleration)


def tool_path(
    model: ArmModel, X_FT: Array, X_from: Array, X_to: Array, speed: float, acceleration: float
) -> Path | None:
    """movel's path of the tool poses (4, 4), its speed that of the translation, or of the turn where that is all."""
    step = X_to[:3, 3] - X_from[:3, 3]
    turn = rotation_vector(X_to[:3, :3] @ X_from[:3, :3].T)
    distance, angle = float(np.linalg.norm(step)), float(np.linalg.norm(turn))
    length = distance if distance > TURNED_ONLY_M else angle
    if length < NOTHING:
        return None

    def pose(s: float) -> Array:
        X = np.eye(4)
        X[:3, :3] = rotation_matrix(turn * (s / length)) @ X_from[:3, :3]
        X[:3, 3] = X_from[:3, 3] + step * (s / length)
        return X

    return _path(model, X_FT, pose, length, speed, acceleration, "the straight line")


def arc_path(
    model: ArmModel,
    X_FT: Array,
    X_from: Array,
    p_via: Array,
    X_to: Array,
    speed: float,
    acceleration: float,
    fixed: bool,
) -> Path | None:
    """movec's path through p_via (3,), its speed that of the tool centre point.

    Args:
        fixed: the tool keeps its orientation against the circle, as in mode 1; else it turns evenly to that of X_to.
    """
    a, b = p_via - X_from[:3, 3], X_to[:3, 3] - X_from[:3, 3]
    normal = np.cross(a, b)
    area = float(normal @ normal)
    if area < 1e-16:
        return tool_path(model, X_FT, X_from, X_to, speed, acceleration)
    # circumcentre of the three points, from the first
    centre = X_from[:3, 3] + np.cross((a @ a) * b - (b @ b) * a, normal) / (2.0 * area)
    n = normal / np.sqrt(area)
    x = X_from[:3, 3] - centre
    radius = float(np.linalg.norm(x))
    x = x / radius
    y = np.cross(n, x)
    end = X_to[:3, 3] - centre
    angle = float(np.arctan2(end @ y, end @ x)) % (2.0 * np.pi)
    length = radius * angle
    turn = n * angle if fixed else rotation_vector(X_to[:3, :3] @ X_from[:3, :3].T)

    def pose(s: float) -> Array:
        share = s / length
        X = np.eye(4)
        X[:3, :3] = rotation_matrix(turn * share) @ X_from[:3, :3]
        X[:3, 3] = centre + radius * (np.cos(angle * share) * x + np.sin(angle * share) * y)
        return X

    return _path(model, X_FT, pose, length, speed, acceleration, "the arc")


def _path(
    model: ArmModel,
    X_FT: Array,
    pose: Callable[[float], Array],
    length: float,
    speed: float,
    acceleration: float,
    what: str,
) -> Path:
    X_TF = inverse(X_FT)

    def joints(s: float, q_near: Array) -> Array:
        q = newton(model, pose(s) @ X_TF, q_near)
        if q is None:
            raise MotionRefused(f"{what} leaves the arm's reach")
        return q

    return Path(joints, length, speed, acceleration)
