"""RTDE of the independent controller (port 30004), protocol version 2.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide": packages, field names and types.
"""

from __future__ import annotations

import math
import socket
import struct
from collections import deque
from collections.abc import Callable
from typing import Any

from tests.hardware.independent.machine import PLAYING, REGISTERS, Machine

CODES = {
    "DOUBLE": "d", "INT32": "i", "UINT32": "I", "UINT64": "Q", "UINT8": "B", "BOOL": "?",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip
HEADER = struct.Struct(">HB")
VERSION = (5, 21, 1, 1234567)
RATE_HZ = 500.0
UNREAD_S = 10.0  # a client that does not read for so long is disconnected

Output = tuple[str, Callable[[Machine], Any]]


def _bits(machine: Machine, *pairs: tuple[int, bool]) -> int:
    return sum(1 << bit for bit, on in pairs if on)


def _safety_bits(m: Machine) -> int:
    pairs = (0, m.safety_mode == 1), (1, m.safety_mode == 2), (2, m.safety_mode == 3), (6, m.safety_mode == 7)
    return _bits(m, *pairs, (7, m.safety_mode == 7), (10, m.safety_mode not in (1, 2)))


def outputs() -> dict[str, Output]:
    """The outputs by name: type, and how the value is found."""
    zeros6: Callable[[Machine], Any] = lambda _: (0.0,) * 6  # noqa: E731
    found: dict[str, Output] = {
        "timestamp": ("DOUBLE", lambda m: m.time),
        "robot_mode": ("INT32", lambda m: m.robot_mode),
        "safety_mode": ("INT32", lambda m: m.safety_mode),
        "safety_status": ("INT32", lambda m: m.safety_mode),
        "runtime_state": ("UINT32", lambda m: m.state),
        "robot_status_bits": ("UINT32", lambda m: _bits(m, (0, m.robot_mode >= 4), (1, m.state == PLAYING))),
        "safety_status_bits": ("UINT32", _safety_bits),
        "speed_scaling": ("DOUBLE", lambda m: m.scaling),
        "target_speed_fraction": ("DOUBLE", lambda m: m.slider),
        "actual_digital_input_bits": ("UINT64", lambda m: m.digital_in),
        "actual_digital_output_bits": ("UINT64", lambda m: m.digital_out),
        "analog_io_types": ("UINT32", lambda m: 3 | m.analog_volts[0] << 2 | m.analog_volts[1] << 3),
        "standard_analog_output0": ("DOUBLE", lambda m: m.analog_value(0)),
        "standard_analog_output1": ("DOUBLE", lambda m: m.analog_value(1)),
        "payload": ("DOUBLE", lambda m: m.payload),
        "payload_cog": ("VECTOR3D", lambda m: m.cog),
        "tcp_offset": ("VECTOR6D", lambda m: m.tcp),
        "joint_mode": ("VECTOR6INT32", lambda m: (253 if m.robot_mode == 7 else 239,) * 6),
        "actual_tool_accelerometer": ("VECTOR3D", lambda _: (0.0, 0.0, -9.82)),
        "elbow_position": ("VECTOR3D", lambda _: (0.0,) * 3),
        "elbow_velocity": ("VECTOR3D", lambda _: (0.0,) * 3),
        "tool_mode": ("UINT32", lambda _: 253),
        "tool_output_mode": ("UINT8", lambda _: 0),
        "tool_output_voltage": ("INT32", lambda _: 0),
        "tool_analog_input_types": ("UINT32", lambda _: 3),
        "script_control_line": ("UINT32", lambda _: 0),
        "output_bit_registers0_to_31": ("UINT32", lambda _: 0),
        "output_bit_registers32_to_63": ("UINT32", lambda _: 0),
    }
    for name in ("actual_q", "target_q"):
        found[name] = ("VECTOR6D", lambda m: m.q)
    found["target_qd"] = ("VECTOR6D", lambda m: m.qd)
    found["actual_qd"] = ("VECTOR6D", lambda m: m.measured_speeds())
    for name in ("actual_TCP_pose", "target_TCP_pose"):
        found[name] = ("VECTOR6D", lambda m: m.pose)
    for name in (
        "target_qdd", "target_current", "target_moment", "actual_current", "actual_current_window", "joint_control_output",
        "actual_TCP_speed", "target_TCP_speed", "actual_TCP_force", "joint_temperatures", "actual_joint_voltage",
        "payload_inertia", "ft_raw_wrench",
    ):  # fmt: skip
        found[name] = ("VECTOR6D", zeros6)
    for name in (
        "actual_execution_time", "actual_momentum", "actual_main_voltage", "actual_robot_voltage", "actual_robot_current",
        "standard_analog_input0", "standard_analog_input1", "tool_analog_input0", "tool_analog_input1", "io_current",
        "tool_output_current", "tool_temperature", "tcp_force_scalar",
    ):  # fmt: skip
        found[name] = ("DOUBLE", lambda _: 0.0)
    for i in range(REGISTERS):
        found[f"output_int_register_{i}"] = ("INT32", lambda m, i=i: m.ints_out[i])
        found[f"output_double_register_{i}"] = ("DOUBLE", lambda m, i=i: m.floats_out[i])
        found[f"input_int_register_{i}"] = ("INT32", lambda m, i=i: m.ints_in[i])
        found[f"input_double_register_{i}"] = ("DOUBLE", lambda m, i=i: m.floats_in[i])
    return found


def inputs() -> dict[str, str]:
    """The types of the inputs by name."""
    found = {f"input_int_register_{i}": "INT32" for i in range(REGISTERS)}
    found |= {f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)}
    found |= dict.fromkeys(("input_bit_registers0_to_31", "input_bit_registers32_to_63", "speed_slider_mask"), "UINT32")
    found |= {f"input_bit_register_{i}": "BOOL" for i in range(64, 128)}
    for kind in ("standard", "configurable", "tool"):
        found |= dict.fromkeys((f"{kind}_digital_output_mask", f"{kind}_digital_output"), "UINT8")
    found |= dict.fromkeys(("standard_analog_output_mask", "standard_analog_output_type"), "UINT8")
    found |= dict.fromkeys(("standard_analog_output_0", "standard_analog_output_1", "speed_slider_fraction"), "DOUBLE")
    return found | {"external_force_torque": "VECTOR6D"}


OUTPUTS, INPUTS = outputs(), inputs()


def apply_inputs(machine: Machine, values: dict[str, Any]) -> None:
    """What a received input package does. Registers keep their last value [D]."""
    for name, value in values.items():
        if name.startswith("input_int_register_"):
            machine.ints_in[int(name.rpartition("_")[2])] = value
        elif name.startswith("input_double_register_"):
            machine.floats_in[int(name.rpartition("_")[2])] = value
        machine.fed(name)
    mask = values.get("standard_digital_output_mask", 0)
    for pin in range(8):
        if mask >> pin & 1:
            machine.set_digital(pin, bool(values["standard_digital_output"] >> pin & 1))
    mask = values.get("standard_analog_output_mask", 0)
    for port in range(2):
        share = values.get(f"standard_analog_output_{port}", math.nan)
        if mask >> port & 1 and 0.0 <= share <= 1.0:
            machine.analog_volts[port] = bool(values["standard_analog_output_type"] >> port & 1)
            machine.set_analog(port, share)
    if values.get("speed_slider_mask", 0) & 1 and 0.0 <= values["speed_slider_fraction"] <= 1.0:
        machine.slider = values["speed_slider_fraction"]


class Rtde:
    """All RTDE connections, with the faults of the network that a test asks for."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.clients: list[RtdeClient] = []
        self.wrong: dict[
            str, tuple[float, float]
        ] = {}  # value of an output in place of the right one, until this robot time
        self.delay_s, self.silent_until, self.mute_until = 0.0, 0.0, 0.0

    def accept(self, connection: socket.socket) -> RtdeClient:
        """A new client."""
        client = RtdeClient(self, connection)
        self.clients.append(client)
        return client

    def owner(self, name: str) -> RtdeClient | None:
        """The client that writes an input."""
        return next((client for client in self.clients if name in client.claimed), None)

    def value(self, name: str) -> Any:
        """The value of an output in this frame, right or wrong."""
        found = OUTPUTS[name][1](self.machine)
        if name not in self.wrong:
            return found
        wrong, until = self.wrong[name]
        if self.machine.time > until:
            del self.wrong[name]
            return found
        return [wrong, *found[1:]] if isinstance(found, list | tuple) else wrong

    def publish(self, now: float) -> None:
        """Send the outputs of this frame."""
        for client in list(self.clients):
            client.publish(now)


class RtdeClient:
    """One connection."""

    def __init__(self, rtde: Rtde, connection: socket.socket) -> None:
        self._rtde, self.connection = rtde, connection
        self.claimed: set[str] = set()
        self._inputs: dict[int, tuple[struct.Struct, list[tuple[str, int]]]] = {}
        self._names: list[str] = []
        self._layout = struct.Struct(">B")
        self._each, self._counted = 1, 0
        self._started = False
        self._inbox = bytearray()
        self._outbox = bytearray()
        self._later: deque[tuple[float, bytes]] = deque()
        self._stuck_since: float | None = None
        self.open = True

    def close(self) -> None:
        """End the connection; its inputs are free."""
        self.open = False
        self.connection.close()
        if self in self._rtde.clients:
            self._rtde.clients.remove(self)

    def received(self, data: bytes) -> None:
        """Handle what has arrived."""
        self._inbox += data
        while len(self._inbox) >= HEADER.size:
            size, kind = HEADER.unpack_from(self._inbox)
            if size < HEADER.size:
                self.close()
                return
            if len(self._inbox) < size:
                return
            payload = bytes(self._inbox[HEADER.size : size])
            del self._inbox[:size]
            self._handle(chr(kind), payload)

    def _handle(self, kind: str, payload: bytes) -> None:
        match kind:
            case "V":
                self._reply("V", bytes([payload == b"\x00\x02"]))
            case "v":
                self._reply("v", struct.pack(">4I", *VERSION))
            case "O":
                self._choose(payload)
            case "I":
                self._claim(payload)
            case "S":
                self._started = bool(self._names)  # refused without outputs
                self._reply("S", bytes([self._started]))
            case "P":
                self._started = False
                self._reply("P", b"\x01")
            case "U":
                self._data(payload)

    def _choose(self, payload: bytes) -> None:
        (frequency,) = struct.unpack_from(">d", payload)
        names = [name for name in payload[8:].decode("ascii", "replace").split(",") if name]
        types = [OUTPUTS[name][0] if name in OUTPUTS else "NOT_FOUND" for name in names]
        right = names != [] and "NOT_FOUND" not in types and 0.0 < frequency <= RATE_HZ
        self._names = names if right else []
        if right:
            self._layout = struct.Struct(">B" + "".join(CODES[kind] for kind in types))
            self._each = max(round(RATE_HZ / frequency), 1)
        self._reply("O", bytes([right]) + ",".join(types).encode())

    def _claim(self, payload: bytes) -> None:
        names = [name for name in payload.decode("ascii", "replace").split(",") if name]
        types = []
        for name in names:
            owner = self._rtde.owner(name)
            taken = owner is not None and owner is not self
            types.append("NOT_FOUND" if name not in INPUTS else "IN_USE" if taken else INPUTS[name])
        recipe = 0
        if names and not {"NOT_FOUND", "IN_USE"} & set(types):
            recipe = len(self._inputs) + 1
            codes = [CODES[kind] for kind in types]
            widths = [int(code[:-1] or 1) for code in codes]
            self._inputs[recipe] = (struct.Struct(">" + "".join(codes)), list(zip(names, widths, strict=True)))
            self.claimed |= set(names)
        self._reply("I", bytes([recipe]) + ",".join(types).encode())

    def _data(self, payload: bytes) -> None:
        recipe = self._inputs.get(payload[0]) if payload else None
        if recipe is None or len(payload) - 1 != recipe[0].size or self._rtde.machine.time < self._rtde.mute_until:
            return
        numbers, at, values = recipe[0].unpack_from(payload, 1), 0, {}
        for name, width in recipe[1]:
            values[name] = numbers[at] if width == 1 else numbers[at : at + width]
            at += width
        apply_inputs(self._rtde.machine, values)

    def publish(self, now: float) -> None:
        """Send the outputs of this frame, if they are due; a client that does not read misses them."""
        rtde = self._rtde
        self._counted += 1
        if self._started and self._counted % self._each == 0 and rtde.machine.time >= rtde.silent_until:
            values: list[Any] = [1]
            for name in self._names:
                found = rtde.value(name)
                values.extend(found) if isinstance(found, list | tuple) else values.append(found)
            self._later.append((now + rtde.delay_s, self._layout.pack(*values)))
        while self._later and self._later[0][0] <= now:
            _, package = self._later.popleft()
            if not self._outbox:
                self._reply("U", package)
        self._flush(now)

    def _reply(self, kind: str, payload: bytes) -> None:
        self._outbox += HEADER.pack(len(payload) + HEADER.size, ord(kind)) + payload
        self._flush(None)

    def _flush(self, now: float | None) -> None:
        if not self._outbox:
            self._stuck_since = None
            return
        try:
            sent = self.connection.send(self._outbox)
            del self._outbox[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self.close()
            return
        if now is not None and self._outbox:
            self._stuck_since = now if self._stuck_since is None else self._stuck_since
            if now - self._stuck_since > UNREAD_S:
                self.close()
