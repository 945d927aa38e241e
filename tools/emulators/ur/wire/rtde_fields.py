"""RTDE fields, their types and their values, as in Universal Robots' RTDE guide."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from weldcal.models.arms.kinematics import link_frames
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.registers import (
    N_BITS,
    N_NUMBERS,
    RobotMode,
    RuntimeState,
    safety_status_bits,
)

# struct codes (big endian) by RTDE type
CODES = {
    "DOUBLE": "d",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "UINT8": "B",
    "BOOL": "?",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
Getter = Callable[[Controller], Any]
Setter = Callable[[Controller, Any], None]
ZERO3, ZERO6 = [0.0] * 3, [0.0] * 6
JOINT_RUNNING, JOINT_OFF = 253, 239
TOOL_IDLE = 253


@dataclass(frozen=True)
class Output:
    """A field that a client may ask for; `since` are the first 5.x and 10.x versions that have it."""

    type: str
    get: Getter
    since: tuple[tuple[int, int], tuple[int, int]] = ((0, 0), (10, 0))


@dataclass(frozen=True)
class Input:
    """A field that a client may write."""

    type: str
    set: Setter


def _constant(value: Any) -> Getter:
    return lambda _: value


def _constants(value: Any, names: str) -> dict[str, Getter]:
    """Return the same constant for several fields, named with spaces between."""
    return dict.fromkeys(names.split(), _constant(value))


def _status_bits(c: Controller) -> int:
    power = c.robot_mode in (RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.BACKDRIVE, RobotMode.RUNNING)
    running = c.runtime_state in (RuntimeState.PLAYING, RuntimeState.RESUMING)
    return int(power) | int(running) << 1 | int(power) << 3


def _elbow(c: Controller) -> list[float]:
    return [float(v) for v in link_frames(c.arm.model, c.arm.q)[3].translation()]


def _joint_modes(c: Controller) -> list[int]:
    return [JOINT_RUNNING if c.robot_mode == RobotMode.RUNNING else JOINT_OFF] * 6


def outputs() -> dict[str, Output]:
    """Return all output fields."""
    fields: dict[str, Output] = {}
    for direction in ("input", "output"):
        fields |= _register_outputs(direction)
    for kind, names in _SCALARS.items():
        for name, get in names.items():
            fields[name] = Output(kind, get, _SINCE.get(name, ((0, 0), (10, 0))))
    return fields


def _register_outputs(direction: str) -> dict[str, Output]:
    def bank(c: Controller) -> Any:
        return c.inputs if direction == "input" else c.outputs

    fields = {
        f"{direction}_bit_registers0_to_31": Output("UINT32", lambda c: bank(c).word(0)),
        f"{direction}_bit_registers32_to_63": Output("UINT32", lambda c: bank(c).word(32)),
    }
    for i in range(64, N_BITS):
        fields[f"{direction}_bit_register_{i}"] = Output("BOOL", lambda c, i=i: bank(c).bits[i])  # type: ignore[misc]
    for i in range(N_NUMBERS):
        of_int, of_double = f"{direction}_int_register_{i}", f"{direction}_double_register_{i}"
        fields[of_int] = Output("INT32", lambda c, i=i: bank(c).integers[i])  # type: ignore[misc]
        fields[of_double] = Output("DOUBLE", lambda c, i=i: bank(c).doubles[i])  # type: ignore[misc]
    return fields


_SINCE = {
    "payload": ((5, 6), (10, 0)),
    "payload_cog": ((5, 6), (10, 0)),
    "ft_raw_wrench": ((5, 9), (10, 0)),
    "payload_inertia": ((5, 11), (10, 0)),
    "actual_current_as_torque": ((5, 23), (10, 9)),
}

_SCALARS: dict[str, dict[str, Getter]] = {
    "DOUBLE": {
        "timestamp": lambda c: c.timestamp,
        "speed_scaling": lambda c: c.speed_scaling,
        "target_speed_fraction": lambda c: c.terminals.speed_slider,
        "actual_robot_voltage": lambda c: 48.0 if c.robot_mode > RobotMode.POWER_OFF else 0.0,
        "actual_robot_current": lambda c: 0.8 if c.robot_mode > RobotMode.POWER_OFF else 0.0,
        "standard_analog_output0": lambda c: c.terminals.analog_output(0),
        "standard_analog_output1": lambda c: c.terminals.analog_output(1),
        "payload": lambda c: c.payload.mass,
        "tcp_force_scalar": lambda c: math.hypot(*c.tcp_force()[:3]),
        "actual_execution_time": _constant(0.4),
        "target_execution_time": _constant(2.0),
        **_constants(0.0, "actual_momentum standard_analog_input0 standard_analog_input1 io_current"),
        **_constants(0.0, "actual_robot_energy_consumed actual_robot_braking_energy_dissipated euromap67_24V_voltage"),
        **_constants(0.0, "euromap67_24V_current tool_analog_input0 tool_analog_input1 tool_output_current"),
        **_constants(0.0, "joint_position_deviation_ratio collision_detection_ratio"),
        "actual_main_voltage": _constant(48.0),
        "tool_temperature": _constant(25.0),
    },
    "VECTOR6D": {
        "target_q": lambda c: c.arm.q_target.tolist(),
        "target_qd": lambda c: c.arm.qd_target.tolist(),
        "target_qdd": lambda c: c.arm.qdd_target.tolist(),
        "actual_q": lambda c: c.arm.q.tolist(),
        "actual_qd": lambda c: c.arm.qd.tolist(),
        "actual_TCP_pose": lambda c: c.arm.tool_pose(),
        "actual_TCP_speed": lambda c: c.arm.tool_speed(),
        "target_TCP_pose": lambda c: c.arm.tool_pose(target=True),
        "target_TCP_speed": lambda c: c.arm.tool_speed(target=True),
        "tcp_offset": lambda c: c.tcp_offset,
        "ft_raw_wrench": lambda c: c.flange_wrench(),
        "actual_TCP_force": lambda c: c.tcp_force(),
        "payload_inertia": lambda c: c.payload.inertia,
        **_constants(
            ZERO6, "target_current target_moment actual_current actual_current_window actual_current_as_torque"
        ),
        **_constants(ZERO6, "joint_control_output actual_TCP_acceleration target_TCP_acceleration"),
        **_constants(ZERO6, "wrench_calc_from_currents target_base_acceleration target_base_wrench"),
        "joint_temperatures": _constant([30.0] * 6),
        "actual_joint_voltage": _constant([48.0] * 6),
    },
    "VECTOR3D": {
        "elbow_position": _elbow,
        "payload_cog": lambda c: c.payload.center,
        "actual_tool_accelerometer": _constant([0.0, 0.0, 9.81]),
        "elbow_velocity": _constant(ZERO3),
        "target_gravity": lambda c: c.gravity,
    },
    "VECTOR6INT32": {"joint_mode": _joint_modes},
    "INT32": {
        "robot_mode": lambda c: int(c.robot_mode),
        "safety_mode": lambda c: int(c.safety_mode),
        "safety_status": lambda c: int(c.safety_mode),
        "tool_output_voltage": lambda c: c.terminals.tool_voltage,
        **_constants(0, "encoder0_raw encoder1_raw time_scale_source"),
    },
    "UINT32": {
        "runtime_state": lambda c: int(c.runtime_state),
        "robot_status_bits": _status_bits,
        "safety_status_bits": lambda c: safety_status_bits(c.safety_mode),
        "analog_io_types": lambda c: c.terminals.analog_output_types << 2,
        "script_control_line": lambda c: c.program.line if c.program else 0,
        **_constants(0, "euromap67_input_bits euromap67_output_bits tool_analog_input_types"),
        "tool_mode": _constant(TOOL_IDLE),
    },
    "UINT64": {
        "actual_digital_input_bits": lambda c: c.terminals.digital_inputs,
        "actual_configurable_digital_input_bits": lambda c: c.terminals.digital_inputs >> 8 & 0xFF,
        "actual_digital_output_bits": lambda c: c.terminals.digital_outputs,
        "actual_configurable_digital_output_bits": lambda c: c.terminals.digital_outputs >> 8 & 0xFF,
        "control_step": lambda c: c.frame,
    },
    "UINT8": {**_constants(0, "tool_output_mode tool_digital_output0_mode tool_digital_output1_mode")},
}


def _set(bank: str, i: int, c: Controller, value: Any) -> None:
    getattr(c.inputs, bank)[i] = value


def inputs() -> dict[str, Input]:
    """Return all plain input fields; the masked ones (terminals, slider) are applied together by `apply_masked`."""
    fields = {
        "input_bit_registers0_to_31": Input("UINT32", lambda c, v: c.inputs.set_word(0, v)),
        "input_bit_registers32_to_63": Input("UINT32", lambda c, v: c.inputs.set_word(32, v)),
        "external_force_torque": Input("VECTOR6D", _set_wrench),
    }
    for i in range(64, N_BITS):
        fields[f"input_bit_register_{i}"] = Input("BOOL", partial(_set, "bits", i))
    for i in range(N_NUMBERS):
        fields[f"input_int_register_{i}"] = Input("INT32", partial(_set, "integers", i))
        fields[f"input_double_register_{i}"] = Input("DOUBLE", partial(_set, "doubles", i))
    for name, kind in MASKED.items():
        fields[name] = Input(kind, _nothing)
    return fields


MASKED = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
}


def apply_masked(c: Controller, values: dict[str, Any]) -> None:
    """Terminals and slider of one input package: the mask says which of its values count."""
    if values.get("speed_slider_mask"):
        c.terminals.speed_slider = min(1.0, max(0.0, float(values.get("speed_slider_fraction", 1.0))))
    for first, kind in ((0, "standard"), (8, "configurable"), (16, "tool")):
        if mask := values.get(f"{kind}_digital_output_mask"):
            c.terminals.set_digital(first, mask, values.get(f"{kind}_digital_output", 0))
    if mask := values.get("standard_analog_output_mask"):
        types = values.get("standard_analog_output_type", 0)
        c.terminals.analog_output_types = c.terminals.analog_output_types & ~mask | types & mask
        for i in range(2):
            if mask >> i & 1:
                c.terminals.set_analog(i, float(values.get(f"standard_analog_output_{i}", 0.0)))


def _set_wrench(c: Controller, value: Any) -> None:
    c.sensor.written = list(value)


def _nothing(_: Controller, __: Any) -> None:
    return
