"""URScript functions that take frames: motions hold the arm until they return."""

import math
from typing import Any

import numpy as np

from weldcal.tools.emulators.ur.controller.motions import (
    STEP_S,
    JointVelocity,
    Motion,
    Servo,
    Stop,
    ToolVelocity,
    joint_path,
    tool_path,
)
from weldcal.tools.emulators.ur.script.answers import positive, six
from weldcal.tools.emulators.ur.script.compiler import Pose, Slices
from weldcal.tools.emulators.ur.script.sockets import Sockets


class Motions(Sockets):
    """Functions that take frames."""

    def sync(self) -> Slices:
        yield

    def sleep(self, t: float) -> Slices:
        for _ in range(max(1, round(float(t) / STEP_S))):
            yield

    def protective_stop(self) -> Slices:
        self._controller.protective_stop("the script asked for it")
        yield

    def movej(self, q: Any, a: float = 1.4, v: float = 1.05, t: float = 0.0, r: float = 0.0) -> Slices:
        arm = self._controller.arm
        goal = np.array(self.get_inverse_kin(q)) if isinstance(q, Pose) else six(q, "movej")
        a, v = positive(a, "The acceleration of movej"), positive(v, "The speed of movej")
        if t > 0.0:
            a, v = _timed(float(np.abs(goal - arm.q_target).max()), t, a)
        yield from self._drive(joint_path(arm.q_target, goal, v, a, arm.model.velocity_limit))

    def movel(self, pose: Any, a: float = 1.2, v: float = 0.25, t: float = 0.0, r: float = 0.0) -> Slices:
        arm = self._controller.arm
        goal = six(pose, "movel")
        X = arm.flange_goal(goal.tolist()) if isinstance(pose, Pose) else arm.flange(goal)
        a, v = positive(a, "The acceleration of movel"), positive(v, "The speed of movel")
        X_now = arm.flange(arm.q_target)
        if t > 0.0:
            a, v = _timed(float(np.linalg.norm(X[:3, 3] - X_now[:3, 3])), t, a)
        yield from self._drive(tool_path(arm.model, X_now, X, v, a))

    def movep(self, pose: Any, a: float = 1.2, v: float = 0.25, r: float = 0.0) -> Slices:
        yield from self.movel(pose, a, v)

    def speedj(self, qd: Any, a: float = 1.4, t: float = 0.0) -> Slices:
        target, rate = six(qd, "speedj"), positive(a, "The acceleration of speedj")
        yield from self._drive(JointVelocity(target, rate), t)

    def speedl(self, xd: Any, a: float = 1.2, t: float = 0.0, aRot: float | None = None) -> Slices:
        target, rate = six(xd, "speedl"), positive(a, "The acceleration of speedl")
        angular = rate if aRot is None else positive(aRot, "aRot of speedl")
        arm = self._controller.arm
        before = arm.motion
        # successive calls go on from the commanded twist, whatever rounding the Jacobian adds
        start = before.twist if isinstance(before, ToolVelocity) else np.array(arm.tool_speed(target=True))
        yield from self._drive(ToolVelocity(target, rate, angular, start), t)

    def servoj(
        self,
        q: Any,
        a: float = 0.0,
        v: float = 0.0,
        t: float = STEP_S,
        lookahead_time: float = 0.1,
        gain: float = 300.0,
    ) -> Slices:
        lookahead = min(0.2, max(0.03, float(lookahead_time)))
        yield from self._drive(Servo(six(q, "servoj"), lookahead), max(float(t), STEP_S))

    def servoc(self, pose: Any, a: float = 1.2, v: float = 0.25, r: float = 0.0) -> Slices:
        yield from self.movel(pose, a, v)

    def stopj(self, a: float = 2.0) -> Slices:
        yield from self._drive(Stop(positive(a, "The deceleration of stopj")))

    def stopl(self, a: float = 2.0, aRot: float | None = None) -> Slices:
        twist = np.array(self._controller.arm.tool_speed(target=True))
        yield from self._drive(Stop(positive(a, "The deceleration of stopl"), twist))

    def _drive(self, motion: Motion | None, t: float = 0.0) -> Slices:
        """Holds the arm until the motion is done, or for t seconds where that is given."""
        if motion is None:
            yield
            return
        thread = self._program.claim()
        try:
            self._controller.arm.motion = motion
            frames = 0
            while True:
                yield
                frames += 1
                if (frames * STEP_S >= t - 1e-9) if t > 0.0 else motion.done:
                    return
        finally:
            self._program.release(thread)


def _timed(length: float, t: float, a: float) -> tuple[float, float]:
    """Acceleration and speed of a trapezoid of this length that takes t; a is raised where it is too small for that."""
    a = max(a, 4.0 * length / (t * t) * (1.0 + 1e-9), 1e-9)
    return a, max((a * t - math.sqrt(max(0.0, a * a * t * t - 4.0 * a * length))) / 2.0, 1e-9)
