"""URScript functions of the controller, as far as the client's script and a guard script call them.

Motions and the reads of sockets are generators that take frames; all other functions answer at once. What the emulator
has no physics for (friction, conveyors) is accepted and noted in the log.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np

from weldcal.models.arrays import Array
from weldcal.tools.emulators.ur.controller.motions import (
    STEP_S,
    ControllerMotion,
    JointTorque,
    JointVelocity,
    Servo,
    Stop,
    ToolVelocity,
    arc_path,
    joint_path,
    tool_path,
)
from weldcal.tools.emulators.ur.controller.poses import matrix
from weldcal.tools.emulators.ur.controller.registers import register_index
from weldcal.tools.emulators.ur.controller.state import ControllerState
from weldcal.tools.emulators.ur.script.answers import (
    CALCULATIONS,
    DIGITAL,
    READS,
    REGISTERS,
    Answers,
    TerminalFunctions,
    positive,
    six,
)
from weldcal.tools.emulators.ur.script.arithmetic import TEXTS, Pose
from weldcal.tools.emulators.ur.script.compiler import Slices
from weldcal.tools.emulators.ur.script.forces import Dynamics, Forces, mass_matrix
from weldcal.tools.emulators.ur.script.program import Program
from weldcal.tools.emulators.ur.script.sockets import Sockets
from weldcal.tools.emulators.ur.script.syntax import ScriptError

# [M] what optimovel's full speed and acceleration are with the tool
OPTIMOVE_M_S, OPTIMOVE_M_S2 = 1.0, 2.0


class Motions(Sockets):
    """Functions that take frames."""

    def sync(self) -> Slices:
        yield

    def sleep(self, t: float) -> Slices:
        for _ in range(max(1, round(float(t) / STEP_S))):
            yield

    def movej(self, q: Any, a: float = 1.4, v: float = 1.05, t: float = 0.0, r: float = 0.0) -> Slices:
        arm = self._controller.arm
        goal = self._goal_joints(q, "movej")
        a, v = positive(a, "The acceleration of movej"), positive(v, "The speed of movej")
        q_now = arm.commanded.q_target
        if t > 0.0:
            a, v = _timed(float(np.abs(goal - q_now).max()), t, a)
        yield from self._drive(joint_path(q_now, goal, v, a, arm.model.velocity_limit))

    def movel(self, pose: Any, a: float = 1.2, v: float = 0.25, t: float = 0.0, r: float = 0.0) -> Slices:
        arm = self._controller.arm
        X, X_now = self._goal_pose(pose, "movel"), self._pose_now()
        a, v = positive(a, "The acceleration of movel"), positive(v, "The speed of movel")
        if t > 0.0:
            a, v = _timed(float(np.linalg.norm(X[:3, 3] - X_now[:3, 3])), t, a)
        yield from self._drive(tool_path(arm.model, arm.X_FT, X_now, X, v, a))

    def movep(self, pose: Any, a: float = 1.2, v: float = 0.25, r: float = 0.0) -> Slices:
        yield from self.movel(pose, a, v)

    def movec(
        self, pose_via: Any, pose_to: Any, a: float = 1.2, v: float = 0.25, r: float = 0.0, mode: float = 0
    ) -> Slices:
        arm = self._controller.arm
        via, X = self._goal_pose(pose_via, "movec")[:3, 3], self._goal_pose(pose_to, "movec")
        a, v = positive(a, "The acceleration of movec"), positive(v, "The speed of movec")
        yield from self._drive(arc_path(arm.model, arm.X_FT, self._pose_now(), via, X, v, a, fixed=mode == 1))

    def optimovej(self, goal: Any, a: float = 0.3, v: float = 0.3, r: float = 0.0) -> Slices:
        limit = self._controller.arm.model
        a, v = _share(a, "acceleration of optimovej"), _share(v, "speed of optimovej")
        speed, acceleration = float(limit.velocity_limit.min()), float(limit.acceleration_limit.min())
        yield from self.movej(self._goal_joints(goal, "optimovej").tolist(), a * acceleration, v * speed)

    def optimovel(self, goal: Any, a: float = 0.3, v: float = 0.3, r: float = 0.0) -> Slices:
        a, v = _share(a, "acceleration of optimovel"), _share(v, "speed of optimovel")
        yield from self.movel(goal, a * OPTIMOVE_M_S2, v * OPTIMOVE_M_S)

    def speedj(self, qd: Any, a: float = 1.4, t: float = 0.0, t_min: float = 0.0) -> Slices:
        target, rate = six(qd, "speedj"), positive(a, "The acceleration of speedj")
        yield from self._drive(JointVelocity(target, rate), t or t_min)

    def speedl(self, xd: Any, a: float = 1.2, t: float = 0.0, aRot: float | None = None, t_min: float = 0.0) -> Slices:
        target, rate = six(xd, "speedl"), positive(a, "The acceleration of speedl")
        angular = rate if aRot is None else positive(aRot, "aRot of speedl")
        arm = self._controller.arm
        before = arm.motion
        # successive calls go on from the commanded twist, whatever rounding the Jacobian adds
        start = before.twist if isinstance(before, ToolVelocity) else np.array(arm.tool_speed(target=True))
        yield from self._drive(ToolVelocity(target, rate, angular, start), t or t_min)

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

    def direct_torque(
        self, torque: Any, friction_comp: bool = True, viscous_scale: Any = None, coulomb_scale: Any = None
    ) -> Slices:
        arm = self._controller.arm
        acceleration = np.linalg.solve(mass_matrix(arm.model, arm.q_target), six(torque, "direct_torque"))
        yield from self._drive(JointTorque(np.asarray(acceleration, dtype=np.float64)), STEP_S)

    def stopj(self, a: float = 2.0) -> Slices:
        yield from self._drive(Stop(positive(a, "The deceleration of stopj")))

    def stopl(self, a: float = 2.0, aRot: float | None = None) -> Slices:
        twist = np.array(self._controller.arm.tool_speed(target=True))
        yield from self._drive(Stop(positive(a, "The deceleration of stopl"), twist))

    def _goal_joints(self, goal: Any, what: str) -> Array:
        joints = np.array(self.get_inverse_kin(goal)) if isinstance(goal, Pose) else six(goal, what)
        model = self._controller.arm.model
        outside = (joints < model.position_lower) | (joints > model.position_upper)
        if outside.any():
            raise ScriptError(f"{what}: joint {int(np.argmax(outside))} of the target is outside its limits.")
        return joints

    def _goal_pose(self, goal: Any, what: str) -> Array:
        """Return the tool's pose (4, 4) of a goal given as a pose or as joint angles."""
        values, arm = six(goal, what), self._controller.arm
        return matrix(values) if isinstance(goal, Pose) else np.asarray(arm.flange(values) @ arm.X_FT)

    def _pose_now(self) -> Array:
        arm = self._controller.arm
        return np.asarray(arm.flange(arm.commanded.q_target) @ arm.X_FT, dtype=np.float64)

    def _drive(self, motion: ControllerMotion | None, t: float = 0.0) -> Slices:
        """Holds the arm until the motion is done, or for t seconds of the program where that is given.

        The speed slider stretches these seconds: with it UR's own test follows a spline sent as steps of speedj.
        """
        if motion is None:
            yield
            return
        thread = self._program.claim()
        try:
            self._controller.arm.motion = motion
            elapsed = 0.0
            while True:
                yield
                elapsed += STEP_S * self._controller.motion_scaling
                if (elapsed >= t - 1e-9) if t > 0.0 else motion.done:
                    return
        finally:
            self._program.release(thread)


def _timed(length: float, t: float, a: float) -> tuple[float, float]:
    """Acceleration and speed of a trapezoid of this length that takes t; a is raised where it is too small for that."""
    a = max(a, 4.0 * length / (t * t) * (1.0 + 1e-9), 1e-9)
    return a, max((a * t - math.sqrt(max(0.0, a * a * t * t - 4.0 * a * length))) / 2.0, 1e-9)


def _share(value: Any, what: str) -> float:
    """Return a share of what the arm can do."""
    if positive(value, f"The {what}") > 1.0:
        raise ScriptError(f"The {what} is a share of what the arm can do, from 0 to 1, not {value!r}.")
    return float(value)


BLOCKING = frozenset(
    {
        *("movej", "movel", "movep", "movec", "optimovej", "optimovel", "speedj", "speedl", "servoj", "servoc"),
        *("stopj", "stopl", "direct_torque", "sync", "sleep", "popup"),
        *("socket_open", "socket_get_var"),
        *(f"socket_read_{what}" for what in ("line", "string", "ascii_float", "binary_integer", "byte_list")),
    }
)
# The first 5.x and 10.x that know a function, where that is later than any version emulated here.
FIRST = ((0, 0), (10, 0))
SINCE = {
    **dict.fromkeys(
        ("set_target_payload", "get_inverse_kin_has_solution", "get_target_payload_inertia"), ((5, 10), FIRST[1])
    ),
    **dict.fromkeys((name for name in vars(Dynamics) if not name.startswith("_")), ((5, 23), (10, 9))),
    **dict.fromkeys(("optimovej", "optimovel"), ((5, 21), (10, 8))),
    "direct_torque": ((5, 23), (10, 9)),
}
MATH = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sqrt")
NO_EFFECT = ("set_friction_scales", "set_safety_mode_transition_hardness", "set_conveyor_tick_count")


def script_functions(
    controller: ControllerState, program: Program
) -> tuple[Mapping[str, Callable[..., Any]], Iterable[str]]:
    """All functions by their URScript name, and the names of those that are generators."""
    functions = Motions(controller, program)

    def known(name: str) -> bool:
        return controller.version.at_least(*SINCE.get(name, FIRST))

    named: dict[str, Callable[..., Any]] = {name: partial(_no_effect, controller, name) for name in NO_EFFECT}
    named |= {
        name: getattr(functions, name)
        for kind in (Motions, Sockets, Forces, Dynamics, TerminalFunctions, Answers)
        for name in vars(kind)
        if not name.startswith("_") and known(name)
    }
    named |= {name: partial(read, controller) for name, read in READS.items() if known(name)}
    named |= {f"set_{kind}_out": partial(functions._set, *group) for kind, group in DIGITAL.items()}
    for way in ("in", "out"):
        named |= {
            f"get_{kind}_{way}": partial(functions._get, f"digital_{way}puts", *group)
            for kind, group in DIGITAL.items()
        }
    named |= {name: partial(_register, controller, *bank) for name, bank in REGISTERS.items()}
    named |= {name: getattr(math, name) for name in MATH} | CALCULATIONS | TEXTS
    return named, BLOCKING


def _no_effect(controller: ControllerState, name: str, *arguments: Any, **keywords: Any) -> None:
    if not any(line.endswith(name) for line in controller.log):
        controller.note(f"no effect here: {name}")


def _register(controller: ControllerState, bank: str, kind: str, count: int, index: int) -> Any:
    return getattr(getattr(controller, bank), kind)[register_index(index, count)]
