"""URScript functions that return at once: registers, states, terminals, payload, kinematics, poses."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.math import RollPitchYaw, RotationMatrix

from weldcal.calibration.geometry.se3 import as_transform, exp_rotation, inverse
from weldcal.models.arms.inverse import continued_solution, nearest_solution
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.robots import get_robot
from weldcal.tools.emulators.ur.controller.motions import STEP_S
from weldcal.tools.emulators.ur.controller.poses import matrix, pose_of, rotation_vector
from weldcal.tools.emulators.ur.controller.registers import N_BITS, N_NUMBERS, Watchdog, register_index
from weldcal.tools.emulators.ur.controller.state import ControllerState
from weldcal.tools.emulators.ur.script.arithmetic import Effort, Pose
from weldcal.tools.emulators.ur.script.program import Program
from weldcal.tools.emulators.ur.script.syntax import ScriptError

SLOW = 5000  # effort of inverse kinematics and of dynamics
DIGITAL = {"standard_digital": (0, 8), "digital": (0, 8), "configurable_digital": (8, 8), "tool_digital": (16, 2)}
"""First bit and number of the terminals of each group, as they are named in set_..._out, get_..._out and get_..._in."""
TOOL_VOLTAGES = (0, 12, 24)


def six(values: Any, what: str, count: int = 6) -> Array:
    """Six finite numbers out of a script, or as many as `count`; raises ScriptError where they are not."""
    if not isinstance(values, list) or len(values) != count:
        raise ScriptError(f"{what} needs {count} numbers, it got {values!r}.")
    array = np.array(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise ScriptError(f"{what} got a number that is not finite.")
    return array


def positive(value: Any, what: str) -> float:
    """Return a positive finite number out of a script; raises ScriptError where it is not."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value <= 0.0:
        raise ScriptError(f"{what} must be a positive number, it is {value!r}.")
    return float(value)


READS: dict[str, Callable[[ControllerState], Any]] = {
    "get_steptime": lambda c: STEP_S,
    "get_actual_joint_positions": lambda c: c.arm.q.tolist(),
    "get_joint_positions": lambda c: c.arm.q.tolist(),
    "get_target_joint_positions": lambda c: c.arm.q_target.tolist(),
    "get_actual_joint_speeds": lambda c: c.arm.qd.tolist(),
    "get_target_joint_speeds": lambda c: c.arm.qd_target.tolist(),
    "get_actual_tcp_pose": lambda c: Pose(c.arm.tool_pose()),
    "get_target_tcp_pose": lambda c: Pose(c.arm.tool_pose(target=True)),
    "get_target_waypoint": lambda c: Pose(c.arm.tool_pose(target=True)),
    "get_actual_tcp_speed": lambda c: list(c.arm.tool_speed()),
    "get_target_tcp_speed": lambda c: list(c.arm.tool_speed(target=True)),
    "get_actual_tool_flange_pose": lambda c: Pose(pose_of(c.arm.flange(c.arm.q))),
    "get_joint_torques": lambda c: [0.0] * 6,
    "get_tcp_offset": lambda c: Pose(c.tcp_offset),
    "get_payload": lambda c: c.payload.mass,
    "get_target_payload": lambda c: c.payload.mass,
    "get_target_payload_cog": lambda c: list(c.payload.center),
    "get_target_payload_inertia": lambda c: list(c.payload.inertia),
    "get_controller_temp": lambda c: 30.0,
    "get_gravity": lambda c: list(c.gravity),
    "random": lambda c: float(c.random.random()),
    "get_tool_accelerometer_reading": lambda c: [0.0, 0.0, 9.81],
    "is_steady": lambda c: c.arm.at_rest,
}
"""Functions without arguments, by their URScript name."""
CALCULATIONS: dict[str, Callable[..., Any]] = {
    "pose_trans": lambda p_from, p_from_to: Pose(pose_of(matrix(p_from) @ matrix(p_from_to))),
    "pose_inv": lambda p_from: Pose(pose_of(inverse(matrix(p_from)))),
    "pose_dist": lambda pose_from, pose_to: math.dist(pose_from[:3], pose_to[:3]),
    "point_dist": lambda p_from, p_to: math.dist(p_from[:3], p_to[:3]),
    "norm": lambda a: math.sqrt(sum(float(v) ** 2 for v in a)) if isinstance(a, list) else abs(float(a)),
    # l is URScript's own name.
    "integer_to_binary_list": lambda x, l=32: [bool(x >> i & 1) for i in range(min(l, 64))],  # noqa: E741
    "d2r": lambda d: math.radians(d),
    "r2d": lambda r: math.degrees(r),
    "pow": math.pow,
    "inv": lambda m: Pose(pose_of(inverse(matrix(m)))) if isinstance(m, Pose) else np.linalg.inv(m).tolist(),
    "rpy2rotvec": lambda rpy_vector: rotation_vector(RollPitchYaw(rpy_vector).ToRotationMatrix().matrix()).tolist(),
    "rotvec2rpy": lambda rotation_vector: RollPitchYaw(RotationMatrix(exp_rotation(rotation_vector))).vector().tolist(),
    "floor": lambda f: math.floor(f),
    "ceil": lambda f: math.ceil(f),
    "log": lambda b, f: math.log(f, b),
}
"""Functions of their arguments alone, by their URScript name, with URScript's argument names."""
REGISTERS = {
    f"read_{bank}_{kind}_register": (f"{bank}s", numbers, count)
    for bank in ("input", "output")
    for kind, numbers, count in (
        ("integer", "integers", N_NUMBERS),
        ("float", "doubles", N_NUMBERS),
        ("boolean", "bits", N_BITS),
    )
}
"""Functions that read a register: direction, type and number of its bank."""


class Answers:
    """Functions that answer at once."""

    def __init__(self, controller: ControllerState, program: Program) -> None:
        self._controller = controller
        self._program = program

    def write_output_integer_register(self, index: int, value: int) -> None:
        if isinstance(value, bool) or not isinstance(value, int | float) or not -(2**31) <= value < 2**31:
            raise ScriptError(f"An integer register cannot hold {value!r}.")
        self._controller.outputs.integers[register_index(index, N_NUMBERS)] = int(value)

    def write_output_float_register(self, index: int, value: float) -> None:
        self._controller.outputs.doubles[register_index(index, N_NUMBERS)] = float(value)

    def write_output_boolean_register(self, index: int, value: bool) -> None:
        self._controller.outputs.bits[register_index(index, N_BITS)] = bool(value)

    def rtde_set_watchdog(self, variable: str, min_frequency: float, action: str = "pause") -> None:
        action = action.lower()  # UR's own examples write PAUSE
        if action not in ("ignore", "pause", "stop"):
            raise ScriptError(f"rtde_set_watchdog knows ignore, pause and stop, not {action!r}.")
        if action == "ignore":
            self._controller.watchdogs.pop(variable, None)
            return
        period = 1.0 / positive(min_frequency, "The frequency of a watchdog")
        self._controller.watchdogs[variable] = Watchdog(period, action, self._controller.frame)

    def get_actual_joint_positions_history(self, steps: int = 0) -> list[float]:
        history = self._controller.arm.history
        return list((history[-1 - min(int(steps), len(history) - 1)] if history else self._controller.arm.q).tolist())

    def set_tcp(self, pose: Any) -> None:
        self._controller.set_tcp(six(pose, "set_tcp").tolist())

    def get_forward_kin(self, q: Any = None, tcp: Any = None) -> Pose:
        arm = self._controller.arm
        X_FT = arm.X_FT if tcp is None else matrix(six(tcp, "get_forward_kin").tolist())
        return Pose(pose_of(arm.flange(arm.q if q is None else six(q, "get_forward_kin")) @ X_FT))

    def get_inverse_kin(
        self, x: Any, qnear: Any = None, maxPositionError: float = 1e-10, maxOrientationError: float = 1e-10
    ) -> list[float]:
        q = self._inverse(x, qnear)
        if q is None:
            raise ScriptError("get_inverse_kin: the pose is out of reach.")
        return list(q.tolist())

    def get_inverse_kin_has_solution(
        self, x: Any, qnear: Any = None, maxPositionError: float = 1e-10, maxOrientationError: float = 1e-10
    ) -> bool:
        return self._inverse(x, qnear) is not None

    def _inverse(self, pose: Any, q_near: Any) -> Array | None:
        arm = self._controller.arm
        Effort.spend(SLOW)
        X = as_transform(arm.flange_goal(six(pose, "A pose").tolist()))
        near = arm.q_target if q_near is None else six(q_near, "qnear")
        found = continued_solution(arm.model, X, near)
        if found is not None and float(np.abs(found - near).max()) < 1.0 and _inside(arm.model, found):
            return found
        try:
            return nearest_solution(arm.model, X, near)
        except InputError as error:
            raise ScriptError(str(error)) from error

    def get_joint_temp(self, j: int) -> float:
        register_index(j, 6)
        return 30.0

    def normalize(self, v: Any) -> list[float]:
        if not isinstance(v, list) or not (length := math.hypot(*v)):
            raise ScriptError(f"normalize needs numbers that are not all zero, it got {v!r}.")
        return [value / length for value in v]

    def wrench_trans(self, T_from_to: Any, w_from: Any) -> list[float]:
        """[M] T_from_to is the pose of the new point of view in the old one."""
        X, w = matrix(six(T_from_to, "wrench_trans")), six(w_from, "wrench_trans")
        force, torque = w[:3] @ X[:3, :3], (w[3:] - np.cross(X[:3, 3], w[:3])) @ X[:3, :3]
        return [*force.tolist(), *torque.tolist()]

    def pose_add(self, p_1: Any, p_2: Any) -> Pose:
        X, Y = matrix(p_1), matrix(p_2)
        X[:3, :3] = X[:3, :3] @ Y[:3, :3]
        X[:3, 3] += Y[:3, 3]
        return Pose(pose_of(X))

    def pose_sub(self, p_to: Any, p_from: Any) -> Pose:
        X, Y = matrix(p_to), matrix(p_from)
        X[:3, :3] = X[:3, :3] @ Y[:3, :3].T
        X[:3, 3] -= Y[:3, 3]
        return Pose(pose_of(X))

    def interpolate_pose(self, p_from: Any, p_to: Any, alpha: float) -> Pose:
        X, Y = matrix(six(p_from, "interpolate_pose")), matrix(six(p_to, "interpolate_pose"))
        turn = rotation_vector(Y[:3, :3] @ X[:3, :3].T)
        X[:3, 3] += alpha * (Y[:3, 3] - X[:3, 3])
        X[:3, :3] = exp_rotation(alpha * turn) @ X[:3, :3]
        return Pose(pose_of(X))

    def is_within_safety_limits(self, pose: Any) -> bool:
        if isinstance(pose, Pose):
            return self._inverse(pose, None) is not None
        return _inside(self._controller.arm.model, six(pose, "is_within_safety_limits"))


def _inside(model: ArmModel, q: Array) -> bool:
    return bool((q >= model.position_lower).all() and (q <= model.position_upper).all())


class TerminalFunctions(Answers):
    """Outputs keep their level when the program ends, unless they follow its state."""

    def set_runstate_standard_digital_output_to_value(self, outputId: int, state: int) -> None:
        self._controller.terminals.runstate[register_index(outputId, 8)] = register_index(state, 8)

    def set_runstate_standard_analog_output_to_value(self, outputId: int, state: int) -> None:
        self._controller.terminals.analog_runstate[register_index(outputId, 2)] = register_index(state, 8)

    def set_standard_analog_out(self, n: int, f: float) -> None:
        self._controller.terminals.set_analog(register_index(n, 2), float(f))

    set_analog_out = set_standard_analog_out

    def get_standard_analog_out(self, n: int) -> float:
        return self._controller.terminals.analog_outputs[register_index(n, 2)]

    def get_standard_analog_in(self, n: int) -> float:
        register_index(n, 2)
        return 0.0

    def set_analog_outputdomain(self, port: int, domain: int) -> None:
        bit = 1 << register_index(port, 2)
        types = self._controller.terminals.analog_output_types
        self._controller.terminals.analog_output_types = types | bit if domain else types & ~bit

    def set_tool_voltage(self, voltage: float) -> None:
        if voltage not in TOOL_VOLTAGES:
            raise ScriptError(f"The tool's voltage is 0, 12 or 24, not {voltage!r}.")
        self._controller.terminals.tool_voltage = int(voltage)

    def set_payload(self, m: float, cog: Any = None) -> None:
        model = self._controller.arm.model.name
        most = get_robot(model).payload_kg
        if not 0.0 <= float(m) <= most:  # [M] what a controller answers is not documented
            raise ScriptError(f"The payload of a {model} is 0 to {most:g} kg, not {m!r}.")
        self._controller.payload.mass = float(m)
        if cog is not None:
            self.set_payload_cog(cog)

    set_payload_mass = set_payload

    def set_payload_cog(self, CoG: Any) -> None:
        self._controller.payload.center = six(CoG, "The centre of gravity", 3).tolist()

    def set_target_payload(self, m: float, cog: Any, inertia: Any = None, transition_time: float = 0.0) -> None:
        self.set_payload(m, cog)
        if inertia is not None:
            self._controller.payload.inertia = six(inertia, "The inertia", 6).tolist()

    def set_gravity(self, d: Any) -> None:
        self._controller.gravity = six(d, "Gravity", 3).tolist()

    def _set(self, first: int, count: int, n: int, b: bool) -> None:
        self._controller.terminals.set_digital(first, 1 << register_index(n, count), (1 if b else 0) << n)

    def _get(self, bank: str, first: int, count: int, n: int) -> bool:
        return bool(getattr(self._controller.terminals, bank) >> (first + register_index(n, count)) & 1)
