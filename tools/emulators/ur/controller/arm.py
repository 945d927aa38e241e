"""Arm of the emulated controller: integrates the kinematic model in steps of 2 ms."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from weldcal.models.arms.kinematics import ArmModel, kinematics_and_jacobian
from weldcal.models.arrays import Array
from weldcal.tools.emulators.ur.controller.compliance import Compliance, Nominal
from weldcal.tools.emulators.ur.controller.motions import REST_RAD_S, STEP_S, ControllerMotion, MotionRefused, slowed
from weldcal.tools.emulators.ur.controller.poses import inverse, matrix, rotation_vector

# [M] how the arm slows when its program stops, pauses, or a safety function acts
STOP_RAD_S2 = 10.0
# [M] how far inside a joint's limit the controller stops the arm
LIMIT_MARGIN_RAD = 1e-6
HISTORY = 2000


class EmulatedArm:
    """Targets and actual values of six joints (rad, rad/s, rad/s^2), the tool frame, and the motion under way."""

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
        """Moves by one step; where it is not driven it brakes, and where it is not live force mode stands still.

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
        R, p, _ = kinematics_and_jacobian(self.model, q)
        X = np.eye(4)
        X[:3, :3], X[:3, 3] = R, p
        return X

    def flange_goal(self, pose: list[float]) -> Array:
        """X_BF (4, 4) that puts the tool at `pose`."""
        return matrix(pose) @ inverse(self.X_FT)

    def tool_pose(self, target: bool = False) -> list[float]:
        """The tool's pose in the base, from the actual or the target joints."""
        cache = self._cache_of(target)
        if "pose" not in cache:
            R, p, _ = self._tool(cache, target)
            cache["pose"] = [*p.tolist(), *rotation_vector(R @ self.X_FT[:3, :3]).tolist()]
        return list(cache["pose"])

    def tool_speed(self, target: bool = False) -> list[float]:
        """The tool's twist [v; w] in base axes (m/s, rad/s)."""
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
