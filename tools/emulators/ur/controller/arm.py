"""Arm of the emulated controller: integrates the kinematic model in steps of 2 ms, and yields to forces.

The arm that the motions see is `nominal`; the real one is it, moved by a deviation along and about the task frame's
axes. The deviation's speed is (force asked for + force felt) / DAMPING, up to the axis' limit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from weldcal.calibration.geometry.se3 import as_transform, exp_rotation, inverse
from weldcal.models.arms.inverse import continued_solution
from weldcal.models.arms.kinematics import ArmModel, chain_poses, kinematics_and_jacobian
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.tools.emulators.ur.controller.motions import REST_RAD_S, STEP_S, ControllerMotion, MotionRefused, slowed
from weldcal.tools.emulators.ur.controller.poses import matrix, rotation_vector

# [M] N s/m and N m s/rad
DAMPING = np.array([500.0] * 3 + [50.0] * 3)
FREE_DAMPING = DAMPING / 5.0
# [M] how fast the deviation's speed may change, m/s^2 and rad/s^2
ACCELERATION = np.array([10.0] * 3 + [50.0] * 3)
FREE_LIMITS = np.array([0.25] * 3 + [1.0] * 3)
# stiffer than this the compliant arm, 500 steps a second, would chatter
STIFFEST_N_M = 1e5
# [M] how the arm slows when its program stops, pauses, or a safety function acts
STOP_RAD_S2 = 10.0
# [M] how far inside a joint's limit the controller stops the arm
LIMIT_MARGIN_RAD = 1e-6
HISTORY = 2000


@dataclass
class Nominal:
    """The arm as its motions see it."""

    model: ArmModel
    q_target: Array
    qd_target: Array
    p_FT: Array


@dataclass
class Task:
    """What force_mode was asked for: frame in the base, 1 where compliant, wrench [f; t], type, limits."""

    frame: Array
    selection: Array
    wrench: Array
    kind: int
    limits: Array
    damping: Array


class Compliance:
    """Hold the current deviation."""

    def __init__(self, model: ArmModel, q: Array, qd: Array, p_FT: Array, task: Task) -> None:
        self.nominal = Nominal(model, q.copy(), qd.copy(), p_FT)
        self.task = task
        self._moved, self._turned, self._speed = np.zeros(3), np.eye(3), np.zeros(6)

    def velocity(self, q: Array, X_FT: Array, qd_nominal: Array, wrench: Array, live: bool) -> Array:
        """Return the joint velocity (6) of the real arm at q for the next step; not live, the deviation is frozen.

        Raises:
            MotionRefused: the deviation leads out of reach.
        """
        nominal, model = self.nominal, self.nominal.model
        nominal.q_target, nominal.qd_target = nominal.q_target + qd_nominal * STEP_S, qd_nominal
        R, p, J = kinematics_and_jacobian(model, q, nominal.p_FT)
        axes = _axes(self.task, p + R @ X_FT[:3, 3], (J @ qd_nominal)[3:])
        felt = np.concatenate([axes.T @ wrench[:3], axes.T @ wrench[3:]])
        asked = np.where(self.task.selection > 0.0, (self.task.wrench + felt) / self.task.damping, 0.0)
        asked = np.clip(asked, -self.task.limits, self.task.limits) if live else np.zeros(6)
        self._speed += np.clip(asked - self._speed, -ACCELERATION * STEP_S, ACCELERATION * STEP_S)
        self._moved = self._moved + axes @ self._speed[:3] * STEP_S
        self._turned = exp_rotation(axes @ self._speed[3:] * STEP_S) @ self._turned
        X = chain_poses(model, nominal.q_target) @ X_FT
        X[:3, :3], X[:3, 3] = self._turned @ X[:3, :3], X[:3, 3] + self._moved
        found = continued_solution(model, as_transform(X @ inverse(X_FT)), q)
        if found is None:
            raise MotionRefused("force mode leaves the arm's reach")
        return np.asarray((found - q) / STEP_S, dtype=np.float64)


def force_task(
    frame: list[float], selection: Array, wrench: Array, kind: int, limits: Array, gain_scaling: float
) -> Task:
    """Return the task of one call of force_mode."""
    # for an axis that is not compliant the limit is a deviation, which this arm has none of
    return Task(matrix(frame), selection, wrench, kind, np.abs(limits), DAMPING / max(gain_scaling, 1e-3))


def free_task(frame: list[float], free_axes: Array) -> Task:
    """Return the task of freedrive: every free axis follows the hand."""
    return Task(matrix(frame), free_axes, np.zeros(6), 2, FREE_LIMITS, FREE_DAMPING)


def _axes(task: Task, p: Array, v: Array) -> Array:
    """Axes (3, 3) of the task frame in the base.

    Type 1 turns y towards the frame's origin, type 3 x along the motion.
    """
    R = task.frame[:3, :3]
    if task.kind == 1:
        y = task.frame[:3, 3] - p
        if (distance := float(np.linalg.norm(y))) < 1e-6:
            return R
        y = y / distance
        x = np.cross(y, R[:, 2])
        if float(np.linalg.norm(x)) < 1e-6:
            return R
        x = x / np.linalg.norm(x)
        return np.column_stack([x, y, np.cross(x, y)])
    if task.kind == 3:
        x = v - (v @ R[:, 2]) * R[:, 2]
        if (speed := float(np.linalg.norm(x))) < 1e-6:
            return R
        return np.column_stack([x / speed, np.cross(R[:, 2], x / speed), R[:, 2]])
    return R


@dataclass
class ElasticContact:
    """An elastic half-space and a hand; wrenches are [f; t] on the tool centre point in base axes (N, N m)."""

    point: Array = field(default_factory=lambda: np.zeros(3))
    normal: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    stiffness: float = 0.0
    push: Array = field(default_factory=lambda: np.zeros(6))

    def place(self, point: list[float], normal: list[float], stiffness: float) -> None:
        """Puts the plane somewhere; a stiffness of 0 takes it away.

        Raises:
            InputError: a normal without a direction, or a stiffness that is negative or too high to be stable.
        """
        n = np.array(normal)
        if not (length := float(np.linalg.norm(n))) > 0.0:
            raise InputError("Give a normal that is not zero.")
        if not 0.0 <= stiffness <= STIFFEST_N_M:
            raise InputError(f"Give a stiffness from 0 to {STIFFEST_N_M:.0f} N/m.")
        self.point, self.normal, self.stiffness = np.array(point), n / length, stiffness

    @property
    def empty(self) -> bool:
        """Nothing touches the tool, wherever it is."""
        return self.stiffness == 0.0 and not self.push.any()

    def depth(self, p: Array) -> float:
        """How far p (3,) is behind the surface (m), 0 in front of it."""
        return max(0.0, float((self.point - p) @ self.normal)) if self.stiffness > 0.0 else 0.0

    def wrench(self, p: Array) -> Array:
        """What acts on the tool centre point at p (3,)."""
        found = self.push.copy()
        found[:3] += self.stiffness * self.depth(p) * self.normal
        return found


@dataclass
class ForceSensor:
    """Offset of zero_ftsensor, and the wrench that a client writes in place of the built-in sensor's."""

    offset: Array = field(default_factory=lambda: np.zeros(6))
    external: bool = False
    written: list[float] = field(default_factory=lambda: [0.0] * 6)


class EmulatedArm:
    """Hold targets and actual values of six joints (rad, rad/s, rad/s^2), the tool frame, and the current motion."""

    def __init__(self, model: ArmModel, q: Array) -> None:
        self.model = model
        self.q_target = np.array(q, dtype=np.float64)
        self.q = self.q_target.copy()
        self.qd_target, self.qdd_target, self.qd = np.zeros(6), np.zeros(6), np.zeros(6)
        self.X_FT = np.eye(4)
        self.p_FT = np.zeros(3)
        self.motion: ControllerMotion | None = None
        self.compliance: Compliance | None = None
        self.touch: Callable[[], Array] = lambda: np.zeros(6)
        self.lag_s = 0.0
        self.history: deque[Array] = deque(maxlen=HISTORY)
        self._cache: tuple[dict[str, Any], dict[str, Any]] = ({}, {})  # of the actual and of the target joints

    def place(self, q: Array) -> None:
        """Puts the arm somewhere at rest, as no robot can."""
        self.q_target = np.array(q, dtype=np.float64)
        self.q = self.q_target.copy()
        self.qd_target, self.qdd_target, self.qd = np.zeros(6), np.zeros(6), np.zeros(6)
        self.motion = self.compliance = None
        self._forget()

    def displace(self, q: Array) -> None:
        """The joints are elsewhere from one step to the next, as no robot's are; what moves goes on from there."""
        self.q_target = np.array(q, dtype=np.float64)
        self.q = self.q_target.copy()
        self._forget()

    def set_tcp(self, pose: list[float]) -> None:
        """The tool centre point in the flange frame."""
        self.X_FT = matrix(pose)
        self.p_FT = self.X_FT[:3, 3].copy()
        self._forget()

    @property
    def at_rest(self) -> bool:
        """No joint has a target velocity."""
        return bool(np.abs(self.qd_target).max() < REST_RAD_S)

    @property
    def commanded(self) -> EmulatedArm | Nominal:
        """The arm that motions start from and continue on: without what force mode adds."""
        return self if self.compliance is None else self.compliance.nominal

    def step(self, driven: bool, scaling: float, live: bool = True) -> None:
        """Move by one step; where it is not driven it brakes, and where it is not live force mode is frozen.

        Raises:
            MotionRefused: the arm cannot follow; it has begun to brake.
        """
        refusal: MotionRefused | None = None
        state = self.commanded
        before = state.qd_target
        qd = slowed(before, STOP_RAD_S2)
        if driven and self.motion is not None:
            try:
                qd = self.motion.velocity(state, scaling)
                if self.compliance is None:
                    qd = self._checked(qd)
            except MotionRefused as refused:
                refusal = refused
            except (ArithmeticError, ValueError) as error:  # numbers beyond what the arm's equations can hold
                refusal = MotionRefused(f"the motion cannot be computed: {error}")
        elif self.motion is not None:
            speed = float(np.abs(before).max())
            self.motion.braked(float(np.abs(qd).max()) / speed if speed > 0.0 else 0.0)
        if self.compliance is not None:
            try:
                qd = self._checked(self.compliance.velocity(self.q_target, self.X_FT, qd, self.touch(), live))
            except (MotionRefused, ArithmeticError, ValueError) as refused:
                refusal, self.compliance = MotionRefused(str(refused), getattr(refused, "code", 153)), None
                qd = slowed(self.qd_target, STOP_RAD_S2)
        self._integrate(qd)
        if refusal is not None:
            raise refusal

    def _checked(self, qd: Array) -> Array:
        if not np.isfinite(qd).all():
            raise MotionRefused("the commanded velocity is not finite")
        if (np.abs(qd) > self.model.velocity_limit * (1.0 + 1e-9) + 1e-9).any():
            raise MotionRefused(f"joint {int(np.argmax(np.abs(qd) / self.model.velocity_limit))} is too fast")
        # where the joint would come to rest if it braked from here
        ahead = self.q_target + qd * STEP_S + qd * np.abs(qd) / (2.0 * STOP_RAD_S2)
        outside = (ahead > self.model.position_upper - LIMIT_MARGIN_RAD) & (qd > 0.0)
        outside |= (ahead < self.model.position_lower + LIMIT_MARGIN_RAD) & (qd < 0.0)
        if outside.any():
            raise MotionRefused(f"joint {int(np.argmax(outside))} is at its limit", 150)
        return qd

    def _integrate(self, qd: Array) -> None:
        moves = qd.any() or self.lag_s > 0.0 or self.q is not self.q_target
        self.qdd_target = (qd - self.qd_target) / STEP_S
        self.qd_target = qd
        self.q_target = self.q_target + qd * STEP_S
        if self.lag_s > 0.0:
            share = STEP_S / (STEP_S + self.lag_s)
            q = self.q + share * (self.q_target - self.q)
            self.qd, self.q = (q - self.q) / STEP_S, q
        else:
            self.qd, self.q = qd, self.q_target
        self.history.append(self.q)
        if moves:
            self._forget()

    def _forget(self) -> None:
        for cache in self._cache:
            cache.clear()

    def flange(self, q: Array) -> Array:
        """X_BF (4, 4) at q."""
        return chain_poses(self.model, q)

    def flange_goal(self, pose: list[float]) -> Array:
        """X_BF (4, 4) that puts the tool at `pose`."""
        return matrix(pose) @ inverse(self.X_FT)

    def tool_pose(self, target: bool = False) -> list[float]:
        """Return the tool's pose in the base, from the actual or the target joints."""
        cache = self._cache_of(target)
        if "pose" not in cache:
            R, p, _ = self._tool(cache, target)
            cache["pose"] = [*p.tolist(), *rotation_vector(R @ self.X_FT[:3, :3]).tolist()]
        return list(cache["pose"])

    def tool_speed(self, target: bool = False) -> list[float]:
        """Return the tool's twist [v; w] in base axes (m/s, rad/s)."""
        qd = self.qd_target if target else self.qd
        if not qd.any():
            return [0.0] * 6
        cache = self._cache_of(target)
        if "speed" not in cache:
            V = (self._tool(cache, target)[2] @ qd).tolist()
            cache["speed"] = [*V[3:], *V[:3]]
        return list(cache["speed"])

    def _tool(self, cache: dict[str, Any], target: bool) -> tuple[Array, Array, Array]:
        """R_BF, the tool's place p_BT and its Jacobian: once a step for all that ask."""
        if "tool" not in cache:
            cache["tool"] = kinematics_and_jacobian(self.model, self.q_target if target else self.q, self.p_FT)
        found: tuple[Array, Array, Array] = cache["tool"]
        return found

    def _cache_of(self, target: bool) -> dict[str, Any]:
        """What was computed in this step; an arm that does not trail its target has one of both."""
        return self._cache[target and self.q is not self.q_target]
