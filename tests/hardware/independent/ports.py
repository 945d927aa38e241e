"""The text and state ports of the independent controller: script and client interface, real-time port, dashboard.

Sources: Universal Robots, "Client Interfaces 5.x" (primary, secondary and real-time), "Dashboard Server e-Series, port
29999".
"""

from __future__ import annotations

import socket
import struct

from tests.hardware.independent.grammar import complete_programs
from tests.hardware.independent.machine import (
    ALPHA,
    FASTEST,
    IDLE,
    PAUSED,
    PLAYING,
    POWER_OFF,
    RUNNING,
    TURN,
    A,
    D,
    Machine,
)  # fmt: skip
from tests.hardware.independent.rtde import VERSION

ROBOT_MODES = {3: "POWER_OFF", 4: "POWER_ON", 5: "IDLE", 7: "RUNNING"}
SAFETY_MODES = {1: "NORMAL", 2: "REDUCED", 3: "PROTECTIVE_STOP", 7: "ROBOT_EMERGENCY_STOP"}
GREETING = "Connected: Universal Robots Dashboard Server"
LONGEST_LINE = 1 << 20
TOO_EARLY = (
    "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking"
)


def _part(kind: int, body: bytes) -> bytes:
    return struct.pack(">IB", len(body) + 5, kind) + body


def version_message(machine: Machine) -> bytes:
    """The message that a client of the primary or secondary port gets first."""
    name, date = b"URControl", b"01-01-2025, 00:00:00"
    body = struct.pack(">QbbB", int(1e6 * machine.time), -2, 3, len(name)) + name
    body += struct.pack(">BBii", VERSION[0], VERSION[1], VERSION[2], VERSION[3]) + date
    return struct.pack(">iB", len(body) + 5, 20) + body


def state_package(machine: Machine) -> bytes:
    """The robot state with its sub packages 0 mode, 1 joints, 4 Cartesian, 5 kinematics, 6 configuration."""
    m = machine
    playing, paused = m.state == PLAYING, m.state == PAUSED
    mode = struct.pack(
        ">Q7?BB3dB", int(1e6 * m.time), True, True, m.robot_mode >= 4, m.safety_mode == 7, m.safety_mode == 3,
        playing, paused, m.robot_mode, 0, m.slider, m.scaling, 1.0, 0,
    )  # fmt: skip
    joints = b"".join(
        struct.pack(">3d4fB", q, q, qd, 0.0, 48.0, 25.0, 25.0, 253) for q, qd in zip(m.q, m.qd, strict=True)
    )
    cartesian = struct.pack(">12d", *m.pose, *m.tcp)
    checksums = (0x1111, 0x2222, 0x3333, 0x4444, 0x5555, 0x6666)
    theta = (0.0,) * 6
    kinematics = struct.pack(">6I24dI", *checksums, *theta, *A, *D, *ALPHA, 0)
    limits = b"".join(struct.pack(">2d", -TURN, TURN) for _ in range(6))
    limits += b"".join(struct.pack(">2d", speed, 40.0) for speed in FASTEST)
    defaults = struct.pack(">5d", 1.05, 1.4, 0.25, 1.2, 0.425)
    configuration = limits + defaults + struct.pack(">24d4i", *A, *D, *ALPHA, *theta, 4, 1, 2, 0)
    parts = (0, mode), (1, joints), (4, cartesian), (5, kinematics), (6, configuration)
    body = b"".join(_part(kind, part) for kind, part in parts)
    return struct.pack(">iB", len(body) + 5, 16) + body


def real_time_package(machine: Machine) -> bytes:
    """The package of port 30003 (1220 bytes): time, target and actual joints and poses; the rest is zero."""
    m, zeros = machine, (0.0,) * 6
    numbers = [
        m.time,
        *m.q,
        *m.qd,
        *zeros,
        *zeros,
        *zeros,
        *m.q,
        *m.qd,
        *zeros,
        *zeros,
        *m.pose,
        *zeros,
        *zeros,
        *m.pose,
    ]
    body = struct.pack(f">i{len(numbers)}d", 1220, *numbers)
    return body + bytes(1220 - len(body))


class Client:
    """A connection of one of these ports."""

    def __init__(self, machine: Machine, connection: socket.socket, port: int) -> None:
        self._machine, self.connection, self.port = machine, connection, port
        self._text = ""
        self._unsent = b""
        self.open = True
        if port == 29999:
            self.send(GREETING.encode() + b"\n")
        elif port in (30001, 30002):
            self.send(version_message(machine))

    def close(self) -> None:
        """End the connection."""
        self.open = False
        self.connection.close()

    def send(self, data: bytes) -> None:
        """Send data; a client that does not read misses whole packages."""
        if not self.open:
            return
        try:
            if self._unsent:
                self._unsent = self._unsent[self.connection.send(self._unsent) :]
            if not self._unsent:
                self._unsent = data[self.connection.send(data) :]
        except BlockingIOError:
            pass
        except OSError:
            self.close()

    def received(self, data: bytes) -> None:
        """Handle what has arrived."""
        self._text += data.decode("utf-8", "replace")
        if len(self._text) > LONGEST_LINE:
            self.close()
            return
        if self.port != 29999:
            programs, self._text = complete_programs(self._text)
            for program in programs:
                self._machine.upload(program)
            return
        while "\n" in self._text and self.open:
            line, _, self._text = self._text.partition("\n")
            self.send(dashboard_answer(self._machine, line.strip()).encode() + b"\n")
            if line.strip() == "quit":
                self.close()


def dashboard_answer(machine: Machine, command: str) -> str:
    """The dashboard's answer to one line."""
    m = machine
    state = {PLAYING: "PLAYING", PAUSED: "PAUSED"}.get(m.state, "STOPPED")
    failed = f"Failed to execute: {command}"
    match command:
        case "PolyscopeVersion":
            return f"URSoftware {VERSION[0]}.{VERSION[1]}.{VERSION[2]}.{VERSION[3]} (Jan 01 2025)"
        case "get serial number":
            return "20255500001"
        case "get robot model":
            return "UR10"
        case "get operational mode":
            return "NONE"
        case "is in remote control":
            return "true" if m.remote else "false"
        case "robotmode":
            return f"Robotmode: {ROBOT_MODES[m.robot_mode]}"
        case "safetymode" | "safetystatus":
            return f"Safety{command[6:]}: {SAFETY_MODES[m.safety_mode]}"
        case "running":
            return f"Program running: {'true' if m.state == PLAYING else 'false'}"
        case "programState":
            return f"{state} {m.name or 'unnamed.urp'}"
        case "quit":
            return "Disconnected"
    if not m.remote:
        return failed
    match command:
        case "stop":
            m.stop("by the dashboard")
            return "Stopped"
        case "pause":
            m.pause("by the dashboard")
            return "Pausing program" if m.program is not None else failed
        case "play":
            return "Starting program" if m.play() else failed
        case "unlock protective stop":
            return "Protective stop releasing" if m.unlock() else TOO_EARLY
        case "close safety popup":
            return "closing safety popup"
        case "power on":
            if m.robot_mode == POWER_OFF and m.safety_mode in (1, 2):
                m.robot_mode = IDLE
            return "Powering on"
        case "brake release":
            if m.robot_mode in (POWER_OFF, IDLE) and m.safety_mode in (1, 2):
                m.robot_mode = RUNNING
            return "Brake releasing"
        case "power off":
            m.robot_mode = POWER_OFF
            m.stop("power off")
            return "Powering off"
    return f"could not understand: '{command}'"
