"""URScript motions: each computes the joint velocity of the next 2 ms from the arm's state.

Marked [M] in docs/ur_emulator.md: profiles are trapezoids without jerk limit, blends are stops, servoj is a first-order
chase, and the reaction to limits is a protective stop.
"""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from weldcal.calibration.geometry.se3 import as_transform, exp_rotation, inverse
from weldcal.models.arms.inverse import continued_solution
from weldcal.models.arms.kinematics import ArmModel, kinematics_and_jacobian
from weldcal.models.arrays import Array
from weldcal.tools.emulators.ur.controller.poses import rotation_vector

STEP_S = 0.002
# [M] where speedl gives up: smallest singular value of the tool's Jacobian (m and rad as they are)
SINGULAR = 0.01
REST_RAD_S = 1e-6
SLOWINGS = 3  # how often a step of a path is shortened until every joint can do it


class MotionRefused(Exception):
    """The arm cannot follow: the controller answers with a protective stop; the text says why, `code` is its report."""

    def __init__(self, reason: str, code: int = 153) -> None:
        super().__init__(reason)
        self.code = code


class ArmState(Protocol):
    """What a motion reads."""

    model: ArmModel
    q_target: Array
    qd_target: Array
    p_FT: Array


class ControllerMotion(Protocol):
    """Hold a current motion."""

    streamed: bool
    done: bool
    """The target is reached."""

    def velocity(self, arm: ArmState, scaling: float) -> Array:
        """Joint velocity (6) rad/s for the next step; scaling is the speed slider."""

    def braked(self, factor: float) -> None:
        """The arm was slowed by `factor` instead, along its path."""


def limited(current: Array, wanted: Array, step: float, model: ArmModel) -> Array:
    """`current` moved towards `wanted`: the leading joint by at most `step`, each joint by what its drive can do."""
    change = wanted - current
    largest = float(np.abs(change).max())
    if largest > step:
        change = change * (step / largest)
    drive = model.acceleration_limit * STEP_S
    return np.asarray(current + np.clip(change, -drive, drive), dtype=np.float64)


class JointVelocity:
    """speedj."""

    streamed = True

    def __init__(self, target: Array, acceleration: float) -> None:
        self.target, self.acceleration = target, acceleration
        self.done = False

    def velocity(self, arm: ArmState, scaling: float) -> Array:
        wanted = self.target * scaling
        qd = limited(arm.qd_target, wanted, self.acceleration * STEP_S, arm.model)
        self.done = bool(np.abs(qd - wanted).max() < REST_RAD_S)
        return qd

    def braked(self, factor: float) -> None:
        self.done = False


class ToolVelocity:
    """speedl: the twist is commanded as [v; w] of the tool centre point in base axes, as URScript orders it."""

    streamed = True

    def __init__(self, target: Array, acceleration: float, angular: float, start: Array) -> None:
        self.target, self._linear, self._angular = target, acceleration, angular
        # kept as its own variable: the twist recomputed through the Jacobian never equals the target
        self.twist = start.copy()
        self.done = False

    def velocity(self, arm: ArmState, scaling: float) -> Array:
        wanted = self.target * scaling
        change = wanted - self.twist
        time = max(float(np.linalg.norm(change[:3])) / self._linear, float(np.linalg.norm(change[3:])) / self._angular)
        self.twist = wanted.copy() if time <= STEP_S else self.twist + change * (STEP_S / time)
        self.done = time <= STEP_S
        return joint_velocity(arm, self.twist)

    def braked(self, factor: float) -> None:
        self.twist = self.twist * factor
        self.done = False


class Path:
    """movej, movel, movec: a trapezoid in the path's own length, along q(s) or along a pose in space."""

    streamed = False

    def __init__(self, joints: Callable[[float, Array], Array], length: float, speed: float, acceleration: float):
        self._joints, self._length = joints, length
        self._speed, self._acceleration = speed, acceleration
        self._s, self._sdot, self.done = 0.0, 0.0, False

    def velocity(self, arm: ArmState, scaling: float) -> Array:
        left = self._length - self._s
        faster = self._sdot + self._acceleration * STEP_S
        slower = self._sdot - self._acceleration * STEP_S
        self._sdot = min(faster, max(self._speed * scaling, slower), math.sqrt(2.0 * self._acceleration * left))
        before, self._s = self._s, min(self._length, self._s + self._sdot * STEP_S)
        q = self._joints(self._s, arm.q_target)
        for _ in range(SLOWINGS):
            # [M] a path that asks a joint for more than it can do is followed more slowly
            excess = float((np.abs(q - arm.q_target) / arm.model.velocity_limit).max()) / STEP_S
            if excess <= 1.0:
                break
            self._s = before + (self._s - before) * 0.99 / excess
            q = self._joints(self._s, arm.q_target)
        self._sdot = 0.0 if self._s >= self._length else (self._s - before) / STEP_S
        # one step at the goal without speed, so that what follows has nothing to brake
        self.done = left <= 0.0
        return np.asarray((q - arm.q_target) / STEP_S, dtype=np.float64)

    def braked(self, factor: float) -> None:
        # the arm leaves its place on the path by nothing: the next step starts from the slower speed
        self._sdot *= factor
        self._s = min(self._length, self._s + self._sdot * STEP_S)
        self.done = self._s >= self._length


class Servo:
    """servoj: a first-order chase of the newest joint target with the look-ahead as time constant [M]."""

    streamed = True
    done = False

    def __init__(self, goal: Array, lookahead: float) -> None:
        self._goal, self._lookahead = goal, lookahead

    def velocity(self, arm: ArmState, scaling: float) -> Array:
        limit = arm.model.velocity_limit * scaling
        wanted = np.clip((self._goal - arm.q_target) / self._lookahead, -limit, limit)
        return limited(arm.qd_target, wanted, math.inf, arm.model)

    def braked(self, factor: float) -> None:
        return


class JointTorque:
    """direct_torque for one step: gravity is taken care of, friction slows as a brake would in half a second [M]."""

    streamed = True
    done = False
    FRICTION_PER_S = 2.0

    def __init__(self, acceleration: Array) -> None:
        self._acceleration = acceleration

    def velocity(self, arm: ArmState, scaling: float) -> Array:
        free = arm.qd_target + self._acceleration * STEP_S
        return np.asarray(free * (1.0 - self.FRICTION_PER_S * STEP_S), dtype=np.float64)

    def braked(self, factor: float) -> None:
        return


class Stop:
    """stopj, and stopl where the arm can hold its line: every joint slows by the same share."""

    streamed = False

    def __init__(self, deceleration: float, twist: Array | None = None) -> None:
        self._deceleration, self._twist = deceleration, twist
        self._share, self.done = 1.0, False

    def velocity(self, arm: ArmState, scaling: float) -> Array:
        if self._twist is not None and (speed := float(np.abs(self._twist).max())) > 0.0:
            norm = float(np.linalg.norm(self._twist[:3])) or speed
            self._share = max(0.0, self._share - self._deceleration * STEP_S / norm)
            qd = joint_velocity(arm, self._twist * self._share)
        else:
            qd = slowed(arm.qd_target, self._deceleration)
        self.done = bool(np.abs(qd).max() < REST_RAD_S)
        return qd

    def braked(self, factor: float) -> None:
        self._share *= factor
        self.done = factor == 0.0


def slowed(qd: Array, deceleration: float) -> Array:
    """Return qd with its leading joint slowed by `deceleration` (rad/s^2) over one step, in the same direction."""
    speed = float(np.abs(qd).max())
    if speed <= deceleration * STEP_S:
        return np.zeros(6)
    return qd * (1.0 - deceleration * STEP_S / speed)


def tool_jacobian(arm: ArmState) -> Array:
    """J (6, 6) of the tool centre point, [v; w] = J qd, in URScript's order."""
    J = kinematics_and_jacobian(arm.model, arm.q_target, arm.p_FT)[2]
    return np.concatenate([J[3:], J[:3]])


def joint_velocity(arm: ArmState, twist: Array) -> Array:
    """Joint velocity of a tool twist [v; w].

    Raises:
        MotionRefused: the arm is near a singularity.
    """
    if not twist.any():
        return np.zeros(6)
    J = tool_jacobian(arm)
    if float(np.linalg.svd(J, compute_uv=False)[-1]) < SINGULAR:
        raise MotionRefused("the arm is near a singularity", 154)
    return np.asarray(np.linalg.solve(J, twist), dtype=np.float64)


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
        X[:3, :3] = exp_rotation(turn * (s / length)) @ X_from[:3, :3]
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
        X[:3, :3] = exp_rotation(turn * share) @ X_from[:3, :3]
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
        q = continued_solution(model, as_transform(pose(s) @ X_TF), q_near)
        if q is None:
            raise MotionRefused(f"{what} leaves the arm's reach")
        return q

    return Path(joints, length, speed, acceleration)
