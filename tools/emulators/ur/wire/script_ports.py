"""Ports that accept script text and stream state: primary 30001, secondary 30002, real-time 30003."""

import struct
from collections.abc import Callable

from weldcal.models.arms.dh import dh_parameters
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.robots import CONTROLLER_MODELS
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.registers import (
    OPERATIONAL_MODES,
    ErrorCode,
    Event,
    Popup,
    RobotMode,
    RuntimeState,
    SafetyChanged,
    SafetyMode,
    ScriptStopped,
    Started,
    Text,
)
from weldcal.tools.emulators.ur.script.parser import split_programs
from weldcal.tools.emulators.ur.script.program import LONGEST_SCRIPT
from weldcal.tools.emulators.ur.wire.net import Connection, Server

STATE_PERIOD_FRAMES = 50  # 10 Hz
STATE, MESSAGE = 16, 20
CALIBRATED, NOMINAL = 2, 0
VERSION = 3
SOURCE_CONTROLLER = -2
REAL_TIME_BYTES = 1220
CLIENT_PORT = 50002
SILENCE_S = 0.1
GIVE_UP_S = 5.0
TEXT, POPUP, SAFETY_MODE, ERROR_CODE, KEY, RUNTIME_EXCEPTION = 0, 2, 5, 6, 7, 10
LONGEST_TITLE = 255


class ScriptServer(Server):
    """A port that runs the programs it is sent."""

    def __init__(self, controller: Controller, on_script: Callable[[float], None]) -> None:
        self._controller = controller
        self._on_script = on_script
        self._clients: list[Connection] = []

    def opened(self, connection: Connection, now: float) -> None:
        self._clients.append(connection)

    def gone(self, connection: Connection) -> None:
        self._clients.remove(connection)

    def arrived(self, connection: Connection, data: bytes, now: float) -> None:
        connection.inbox += data
        programs, rest = split_programs(connection.inbox.decode("utf-8", "replace"))
        connection.inbox[:] = rest.encode()
        if len(rest) > LONGEST_SCRIPT:
            programs.append(connection.inbox.decode("utf-8", "replace"))
            connection.inbox.clear()
        for program in programs:
            self._on_script(now)
            self._controller.submit(program)


class RealTimeServer(ScriptServer):
    """30003: 1220 bytes of state at 500 Hz to whoever reads them; the control client never does."""

    kind = "script"

    def opened(self, connection: Connection, now: float) -> None:
        super().opened(connection, now)
        connection.patient = True

    def frame(self, now: float) -> None:
        package: bytes | None = None
        for connection in self._clients:
            if connection.unread:
                continue
            package = package or self._package()
            connection.send(package, now, droppable=True)

    def _package(self) -> bytes:
        c, arm = self._controller, self._controller.arm
        zero6 = [0.0] * 6
        values = [
            *(c.timestamp, *arm.q_target, *arm.qd_target, *arm.qdd_target, *zero6, *zero6),
            *(*arm.q, *arm.qd, *zero6, *zero6),
            *(*arm.tool_pose(), *arm.tool_speed(), *zero6, *arm.tool_pose(target=True), *arm.tool_speed(target=True)),
            *(float(c.terminals.digital_inputs), *[30.0] * 6, 0.4, 0.0, float(c.robot_mode), *[253.0] * 6),
            *(float(c.safety_mode), *zero6, 0.0, 0.0, 9.81, *zero6, c.speed_scaling, 0.0, 0.0, 0.0),
            *(48.0, 48.0, 0.8, *[48.0] * 6, float(c.terminals.digital_outputs), float(c.runtime_state)),
            *([0.0] * 6 + [float(c.safety_mode)] + [0.0] * 3),
            *(c.payload.mass, *c.payload.center, *c.payload.inertia),
        ]
        return struct.pack(f">i{len(values)}d", REAL_TIME_BYTES, *values)


class PrimaryServer(ScriptServer):
    """30001 with messages, 30002 without: version on connection, robot state ten times a second."""

    def __init__(self, controller: Controller, on_script: Callable[[float], None], *, primary: bool) -> None:
        super().__init__(controller, on_script)
        self.kind = "primary" if primary else "secondary"
        self._messages = primary
        self._kinematics = kinematics_info(controller.arm.model)
        self._configuration = _configuration(controller.arm.model)

    def opened(self, connection: Connection, now: float) -> None:
        super().opened(connection, now)
        v = self._controller.version
        name, date = b"URControl", b"01-01-2025, 00:00:00"
        body = bytes([len(name)]) + name + struct.pack(">BBii", v.major, v.minor, v.bugfix, v.build) + date
        connection.send(self._message(VERSION, body), now)
        connection.send(self._state(), now)

    def frame(self, now: float) -> None:
        if not self._clients:
            return
        if self._controller.frame % STATE_PERIOD_FRAMES == 0:
            package = self._state()
            for connection in self._clients:
                connection.send(package, now, droppable=True)

    def announce(self, event: Event, now: float) -> None:
        """Messages, for the primary port; the state follows a change of the safety mode at once [M]."""
        if self._messages and self._clients:
            package = self._message(*message_body(event))
            if isinstance(event, SafetyChanged):
                package += self._state()
            for connection in self._clients:
                connection.send(package, now)

    def _message(self, kind: int, body: bytes) -> bytes:
        stamp = int(self._controller.timestamp * 1e6)
        payload = struct.pack(">QbB", stamp, SOURCE_CONTROLLER, kind) + body
        return struct.pack(">iB", len(payload) + 5, MESSAGE) + payload

    def _state(self) -> bytes:
        c, arm = self._controller, self._controller.arm
        power = c.robot_mode >= RobotMode.POWER_ON
        stopped = c.safety_mode == SafetyMode.PROTECTIVE_STOP
        emergency = c.safety_mode in (SafetyMode.SYSTEM_EMERGENCY_STOP, SafetyMode.ROBOT_EMERGENCY_STOP)
        playing = c.runtime_state in (RuntimeState.PLAYING, RuntimeState.RESUMING)
        paused = c.runtime_state in (RuntimeState.PAUSED, RuntimeState.PAUSING)
        mode = struct.pack(
            ">Q7?bB3d",
            *(int(c.timestamp * 1e6), True, True, power, emergency, stopped, playing, paused),
            *(int(c.robot_mode), 0, c.terminals.speed_slider, c.speed_scaling, 1.0),
        )
        joints = b"".join(
            struct.pack(">3d4fB", arm.q[i], arm.q_target[i], arm.qd[i], 0.0, 48.0, 30.0, 30.0, 253) for i in range(6)
        )
        tool = struct.pack(">12d", *arm.tool_pose(), *c.tcp_offset)
        parts = (
            *((0, mode), (1, joints), (3, self._masterboard()), (4, tool)),
            *((5, self._kinematics), (6, self._configuration)),
        )
        payload = b"".join(struct.pack(">IB", len(part) + 5, kind) + part for kind, part in parts)
        return struct.pack(">iB", len(payload) + 5, STATE) + payload

    def _masterboard(self) -> bytes:
        c, t = self._controller, self._controller.terminals
        return struct.pack(
            ">2I2B2d2b2d4f3BI3B",
            *(t.digital_inputs, t.digital_outputs, 0, 0, 0.0, 0.0),
            *(t.analog_output_types & 1, t.analog_output_types >> 1 & 1, t.analog_output(0), t.analog_output(1)),
            *(30.0, 48.0, 0.8, 0.0),
            *(int(c.safety_mode), c.safety_mode == SafetyMode.REDUCED, 0, 0),  # no Euromap interface
            *(OPERATIONAL_MODES.index(c.operational_mode), 0, 0),
        )


class ExternalControl(Server):
    """External Control node of a program on the pendant: fetches its URScript from a client on play, one at a time.

    This is the only way in on PolyScope X before 10.10, where ur_rtde neither opens the script port nor uploads. As the
    URCap does, it connects to the client's script sender, asks `request_program`, and takes what comes until 0.1 s of
    silence.
    """

    kind = "external_control"

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._connection: Connection | None = None
        self._last = 0.0

    def opened(self, connection: Connection, now: float) -> None:
        if self._connection is not None:
            self._connection.close(reset=False)
        self._connection, self._last = connection, now
        connection.send(b"request_program\n", now)

    def arrived(self, connection: Connection, data: bytes, now: float) -> None:
        connection.inbox += data
        self._last = now

    def gone(self, connection: Connection) -> None:
        if connection is self._connection:
            self._finish(connection)

    def frame(self, now: float) -> None:
        connection = self._connection
        if connection is not None and now - self._last > (SILENCE_S if connection.inbox else GIVE_UP_S):
            self._finish(connection)
            connection.close(reset=False)

    def _finish(self, connection: Connection) -> None:
        self._connection = None
        text = connection.inbox.decode("ascii", "replace")
        if not text.strip():
            self._controller.note("external control: the client sent no script")
            return
        self._controller.start(f"def external_control():\n{text}\nend\n")


def kinematics_info(model: ArmModel) -> bytes:
    """Return the body of KinematicsInfo.

    Six checksums, theta, a, d, alpha of the chain in use, and whether it is calibrated.
    """
    a, alpha, d, theta = dh_parameters(model).T
    packed = struct.pack(">24d", *theta, *a, *d, *alpha)
    checksums = [sum(packed[joint * 8 :: 48]) & 0xFFFFFFFF for joint in range(6)]
    status = NOMINAL if model.calibration is None else CALIBRATED
    return struct.pack(">6I", *checksums) + packed + struct.pack(">I", status)


def _configuration(model: ArmModel) -> bytes:
    (a, alpha, d, theta), robot_type = dh_parameters(model).T, CONTROLLER_MODELS[model.name][1]
    limits = [v for pair in zip(model.position_lower, model.position_upper, strict=True) for v in pair]
    speeds = [v for pair in zip(model.velocity_limit, model.acceleration_limit, strict=True) for v in pair]
    defaults = [1.05, 1.4, 0.25, 1.2, 0.35]
    body = struct.pack(">29d", *limits, *speeds, *defaults)
    return body + struct.pack(">24d4i", *a, *d, *alpha, *theta, 1, 2, robot_type, 0)


def message_body(event: Event) -> tuple[int, bytes]:
    """What the guide of the client interface lays down for this event."""
    match event:
        case Text(text=text):
            return TEXT, text.encode()
        case Popup():
            flags = struct.pack(">IB3?", 0, 0, event.warning, event.error, event.blocking)
            return POPUP, flags + _titled(event.title) + event.text.encode()
        case ScriptStopped():
            return RUNTIME_EXCEPTION, struct.pack(">ii", event.line, event.column) + event.text.encode()
        case ErrorCode():
            numbers = struct.pack(">3i2I", event.code, event.argument, event.level, 0, 0)
            return ERROR_CODE, numbers + event.text.encode()
        case SafetyChanged(mode=mode):
            return SAFETY_MODE, struct.pack(">2iB2I", 0, 0, mode, 0, 0)
        case _:
            title = "PROGRAM_XXX_STARTED" if isinstance(event, Started) else "PROGRAM_XXX_STOPPED"
            return KEY, struct.pack(">2i", 0, 0) + _titled(title) + event.text.encode()


def _titled(title: str) -> bytes:
    text = title.encode()[:LONGEST_TITLE]
    return bytes([len(text)]) + text
