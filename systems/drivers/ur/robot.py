"""The worker's interface to the robot: connect, upload the guard, read samples, send numbered velocities."""

import sys
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from weldcal.models.arms.kinematics import ArmModel, kinematics_and_jacobian
from weldcal.systems.drivers.ur.faults import Fault, RobotRefused, RobotUnreachable, reported_as
from weldcal.systems.drivers.ur.set_points import OUTPUTS as OUTPUTS_OF_SET_POINTS
from weldcal.systems.drivers.ur.set_points import ArcInputs, Level, apart
from weldcal.systems.drivers.ur.supervisor import PLAYING, STALE_REGISTER, Limits, RobotSample
from weldcal.systems.drivers.ur.wire.rtde_client import (
    DOUBLES,
    SET_POINTS,
    UPPER_OFFSET,
    NotFinite,
    RtdeProbe,
    Value,
    register_names,
)
from weldcal.systems.drivers.ur.wire.transport import (
    NATIVE,
    NO_COMMAND,
    SET_PAYLOAD,
    SPEED_STOP,
    STOP_SCRIPT,
    UR_RTDE,
    VELOCITY,
    NativeTransport,
    Switch,
    Transport,
)

BIN_S = 0.5  # as in sensors/stamps.py, for packages at 500 Hz: the earliest of 250
BINS = 60  # half a minute of bins
BINS_FOR_DRIFT = 8
DRIFT_LIMIT = 5e-4  # the drift of two quartz clocks is below 1e-4
STEP_S = 0.005  # more than this off the line for a whole bin: the controller stalled, or its clock was set


class ClockMap:
    """host time = robot time / pace + offset + drift * robot time.

    A package can only be late, so the minimum of (host - robot) in each half second is the best estimate of the offset.
    An unweighted line through these minima gives offset and drift; its residual is a measure of the accuracy. Where a
    whole bin is off the line by more than STEP_S, all earlier data are dropped. Where the slope exceeds the drift of
    two quartz clocks, the controller does not keep its pace, and only the last bin is used.
    """

    def __init__(self, pace: float = 1.0) -> None:
        self._pace = pace
        self._bins: deque[tuple[float, float]] = deque(maxlen=BINS)
        self._bin_end = -np.inf
        self._least: tuple[float, float] | None = None
        self._origin = 0.0
        self._offset = 0.0
        self.drift = 0.0
        self.residual_s = 0.0

    def update(self, robot_time: float, host_time: float) -> None:
        """Add a package with this robot time (s), received at this host time (s, monotonic)."""
        seen = host_time - robot_time / self._pace
        if self._least is None:
            self._origin, self._offset = robot_time, seen
            self._bin_end = robot_time + BIN_S
        if robot_time >= self._bin_end and self._least is not None:
            at, least = self._least
            if abs(least - self._offset - self.drift * (at - self._origin)) > STEP_S:
                self._bins.clear()
            self._bins.append(self._least)
            self._least, self._bin_end = None, robot_time + BIN_S
            self._fit()
        if self._least is None or seen < self._least[1]:
            self._least = (robot_time, seen)
            if not self._bins:
                self._offset = seen

    def _fit(self) -> None:
        t, seen = (np.array(column) for column in zip(*self._bins, strict=True))
        if t.size < BINS_FOR_DRIFT:
            self._offset, self.drift = float(seen.min()), 0.0
        else:
            slope, at_origin = np.polyfit(t - self._origin, seen, 1)
            self.drift, self._offset = float(slope), float(at_origin)
            if abs(slope) > DRIFT_LIMIT:
                # Above quartz drift: the controller lost time, and only the newest packages show the present offset.
                self.drift, self._offset = 0.0, float(seen[-1])
        line = self._offset + self.drift * (t - self._origin)
        self.residual_s = float(np.sqrt(np.mean((seen - line) ** 2)))

    def to_host(self, robot_time: float) -> float:
        """Convert robot time (s) to host time (s)."""
        return robot_time / self._pace + self._offset + self.drift * (robot_time - self._origin)


OUTPUTS = "actual_digital_output_bits"
INPUTS = "actual_digital_input_bits"
FIRST_LIMIT_S = 2.0  # a choice: a controller sends 500 packages a second, and may take 1 s to begin
# a choice: the guard answers in the next frame; a lost packet of TCP comes again after 0.2 s to 1 s
ANSWER_LIMIT_S = 2.0
START_LIMIT_S = 8.0  # a choice: a script is compiled and started in seconds; half of it fails a slow control box
EXCUSED_S = 0.5  # as Limits.lost_s: the arm is at rest by then, and a longer silence is a lost link whoever was silent
ONLY_WITH_OUTPUT, ONLY_WITH_VALVE = "# only with an output", "# only with a gas valve"
ONLY_WITH_ANALOG = "# only with analog output {}"
ANALOG_TYPES = "analog_io_types"
READ_BACK = ("tcp_offset", "payload", "payload_cog")
# a choice: the controller applies a payload in some frames, and a connection takes a part of 1 s
READ_BACK_LIMIT_S = 1.0
SCALINGS = ("speed_scaling", "target_speed_fraction")
ALWAYS = ("timestamp", "actual_q", "actual_qd", "robot_mode", "safety_mode", "runtime_state", *SCALINGS)


def same_payload(found: Mapping[str, Value], mass_kg: float, cog_m: Sequence[float]) -> bool:
    """Return whether the controller reports this payload, within what it may round: 0.01 kg and 1 mm."""
    if not {"payload", "payload_cog"} <= found.keys():
        return False
    mass, cog = np.array(found["payload"]), np.array(found["payload_cog"])
    return bool(abs(mass - mass_kg) <= 0.0101 and np.abs(cog - np.array(cog_m)).max() <= 1.01e-3)


class Refused(Exception):
    """The start failed, with the fault that caused it."""

    def __init__(self, fault: Fault, detail: float = 0.0) -> None:
        super().__init__(fault.name)
        self.fault, self.detail = fault, detail


def guard_script(
    upper_registers: bool, output: int | None = None, gas: int | None = None, levels: Sequence[Level] = ()
) -> str:
    """Return the text of the guard script for the register range in use: 24 to 47, or 0 to 23, which fieldbuses share.

    `output` and `gas`: the standard digital outputs of the process and of the gas valve, None where none is wired;
    `levels`: set points.
    """
    analog = {level.output: int(level.volts) for level in levels}
    text = files("weldcal.systems.drivers.ur").joinpath("guard.script").read_text(encoding="utf-8")
    for n in OUTPUTS_OF_SET_POINTS:
        text = text.replace(f"global domain{n} = 1", f"global domain{n} = {analog.get(n, 1)}")
        if n not in analog:
            text = _without(text, ONLY_WITH_ANALOG.format(n))
    for number, name, mark in ((output, "output", ONLY_WITH_OUTPUT), (gas, "valve", ONLY_WITH_VALVE)):
        known = text.replace(f"global {name} = -1", f"global {name} = {number}")
        text = _without(text, mark) if number is None else known
    if upper_registers:
        return text
    changed = text.replace("global base = 24", "global base = 0").replace("global word = 36", "global word = 12")
    return changed.replace("input_int_register_24", "input_int_register_0")


def _without(text: str, mark: str) -> str:
    """Return the script without the lines of a mark.

    A controller may refuse a program for the name of a function that it never calls.
    """
    return "".join(line for line in text.splitlines(keepends=True) if mark not in line)


@dataclass(frozen=True, eq=False, kw_only=True)
class WorkerConfig:
    """The configuration that the cell passes to its worker. `arm` has the robot's own kinematics."""

    host: str
    arm: ArmModel
    limits: Limits
    parent: int
    rate_hz: float = 250.0
    upper_registers: bool = True
    payload_kg: float = 0.0
    payload_cog_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    process_output: int | None = None
    arc_input: int | None = None
    arc_fault_input: int | None = None
    gas_output: int | None = None
    gas_before_s: float = 0.0
    gas_after_s: float = 0.0
    levels: tuple[Level, ...] = ()
    transport: str = NATIVE
    version: tuple[int, ...] = ()


class ControllerStream:
    """The stream to and from the controller, the clock map and the newest complete package."""

    def __init__(self, config: WorkerConfig) -> None:
        self._host, self._levels, output, levels = config.host, config.levels, config.process_output, config.levels
        base = UPPER_OFFSET if config.upper_registers else 0
        self._output, self._arm, self._pace = output, config.arm, config.limits.pace
        self._script = guard_script(config.upper_registers, output, config.gas_output, levels)
        self._doubles = DOUBLES + (SET_POINTS if levels else 0)
        self._arc_inputs = ArcInputs(config.arc_input, config.arc_fault_input)
        self.clock = ClockMap(self._pace)
        self._latch = f"output_int_register_{base + 12}"
        # echo of the newest command number, the time for which the guard kept the arm from moving, its passes
        self._told = tuple(f"output_double_register_{base + 12 + i}" for i in range(3))
        names = [*ALWAYS, "actual_TCP_pose", self._latch, *self._told]
        names += [] if output is None else [OUTPUTS]
        names += [INPUTS] if self._arc_inputs.wired else []
        # of each set point: what the guard gives its output, and what the output shows
        self._points = [
            (f"output_double_register_{base + 15 + level.output}", f"standard_analog_output{level.output}")
            for level in levels
        ]
        names += [ANALOG_TYPES, *(name for pair in self._points for name in pair)] if levels else []
        try:
            self._stream = self._connected(config.transport, names, base)
        except NotFinite as error:
            raise Refused(Fault.STATE_NOT_FINITE, reported_as(error.output)) from error
        except (RobotUnreachable, RobotRefused) as error:
            sys.stderr.write(f"{error}\n")
            raise Refused(Fault.CONTROL_REFUSED) from error
        self._switch = None if output is None else self._off_switch(output, config.gas_output)
        self._fresh_at, self._robot_time = time.monotonic(), -1.0
        self._excused = 0.0
        self._sent: dict[float, float] = {}
        self._passes, self._passed_at = -1.0, 0.0
        self._number = 0.0
        self._heard = self._first_unheard = 0.0
        self.echo_latency = 0.0

    def _connected(self, transport: str, names: list[str], base: int) -> Transport:
        if transport == UR_RTDE:
            from weldcal.systems.drivers.ur.wire.ur_rtde_client import UrRtdeTransport

            return UrRtdeTransport(self._host, names, base == UPPER_OFFSET)
        answer = f"output_int_register_{base}"
        return NativeTransport(self._host, [*names, answer], register_names(base, self._doubles), answer, FIRST_LIMIT_S)

    def _off_switch(self, output: int, gas: int | None) -> Switch:
        try:
            return self._stream.switch(output, gas, self._levels)
        except (RobotUnreachable, RobotRefused) as error:
            sys.stderr.write(f"{error}\n")
            raise Refused(Fault.OUTPUT_IN_USE) from error

    def start_guard(self) -> None:
        """Clear the command register, upload the guard and wait until it is active."""
        self.forget()
        if not self._stream.upload(self._script, self._started, time.monotonic() + START_LIMIT_S / self._pace):
            raise Refused(Fault.UPLOAD_REFUSED)

    def _started(self) -> bool:
        if self._stream.number(self._latch) == STALE_REGISTER:
            raise Refused(Fault.GUARD_REFUSED)
        return self._playing and self._stream.number(self._latch) == 1

    def set_load(self, mass_kg: float, cog_m: list[float]) -> None:
        """Set the payload, then read it back, and the TCP, which the guard has set to zero."""
        if not self._once(SET_PAYLOAD, mass_kg, *cog_m):
            raise Refused(Fault.START_FAILED)
        found: dict[str, Value] = {}
        wrong: list[str] = []  # an output that is not finite
        reader = threading.Thread(target=self._read_back, args=(found, wrong, mass_kg, cog_m), daemon=True)
        reader.start()
        while reader.is_alive():
            self.forget()
            self._stream.poll()
            reader.join(0.01)
        if wrong:
            raise Refused(Fault.STATE_NOT_FINITE, reported_as(wrong[0]))
        if np.abs(np.array(found.get("tcp_offset", np.inf))).max() > 1e-6:
            raise Refused(Fault.TCP_NOT_ZERO)
        if not same_payload(found, mass_kg, cog_m):
            raise Refused(Fault.PAYLOAD_NOT_SET)

    def _once(self, command: int, *arguments: float) -> bool:
        """Give a command that the guard answers once; returns whether it did."""
        return self._stream.once(time.monotonic() + ANSWER_LIMIT_S / self._pace, command, *arguments)

    def _write(self, command: int, *arguments: float, armed: bool = False, shares: np.ndarray | None = None) -> None:
        """Write a command; `armed`: with the set points of the power source."""
        points = [0.0] * (self._doubles - DOUBLES)
        for level in self._levels if armed else ():
            points[level.output] = level.wanted(shares)
        self._stream.send(command, *arguments, *points)

    def _read_back(self, found: dict[str, Value], wrong: list[str], mass_kg: float, cog_m: list[float]) -> None:
        """Read until the payload is the one that was set, in a thread.

        The connection's end may take longer than the guard waits for a package.
        """
        until = time.monotonic() + READ_BACK_LIMIT_S / self._pace
        try:
            with RtdeProbe(self._host) as probe:
                while True:
                    found.update(probe.read(READ_BACK))
                    if same_payload(found, mass_kg, cog_m) or time.monotonic() > until:
                        return
                    time.sleep(0.01)
        except NotFinite as error:
            wrong.append(error.output)
        except RobotUnreachable:
            return

    def sample(self, now: float) -> RobotSample:
        """Return the newest sample, all fields of one package."""
        stream = self._stream
        stream.poll()
        robot_time = stream.number("timestamp")
        echo, lost_s, passes = (stream.number(name) for name in self._told)
        inputs = int(stream.number(INPUTS)) if self._arc_inputs.wired else 0
        q = np.array(stream.vector("actual_q"))
        if robot_time != self._robot_time:
            self._robot_time, self._fresh_at, self._excused = robot_time, now, 0.0
            self.clock.update(robot_time, now)
        if passes != self._passes:
            self._passes, self._passed_at = passes, robot_time
        self._listen(echo, now)
        return RobotSample(
            robot_time=robot_time,
            fresh_at=self._fresh_at,
            q=q,
            qd=np.array(stream.vector("actual_qd")),
            robot_mode=int(stream.number("robot_mode")),
            safety_mode=int(stream.number("safety_mode")),
            runtime_state=int(stream.number("runtime_state")),
            # the slider is in the second one; the first is the limiter's
            speed_scaling=stream.number("speed_scaling") * stream.number("target_speed_fraction"),
            guard=int(stream.number(self._latch)),
            connected=stream.connected,
            not_finite=stream.not_finite,
            pose_error_m=float(
                np.linalg.norm(
                    kinematics_and_jacobian(self._arm, q)[1] - np.array(stream.vector("actual_TCP_pose")[:3])
                )
            ),
            unheard_s=now - self._first_unheard if self._sent else 0.0,
            lost_s=lost_s,
            guard_silent_s=robot_time - self._passed_at,
            process_on=None if self._output is None else self.process_on,
            process_asked=echo < 0.0,
            arc=self._arc_inputs.arc(inputs),
            arc_fault=self._arc_inputs.fault(inputs),
            set_points=self._shown(),
        )

    def _shown(self) -> tuple[tuple[float, float], ...]:
        """Of each set point the share that the guard gives its analog output, and the share that the output shows."""
        if not self._levels:
            return ()
        domains = int(self._stream.number(ANALOG_TYPES))
        return tuple(
            (self._stream.number(asked), level.shown(self._stream.number(shown), domains))
            for level, (asked, shown) in zip(self._levels, self._points, strict=True)
        )

    def excuse(self, seconds: float) -> None:
        """Do not count this time, in which the process was suspended, as silence of the robot.

        At most EXCUSED_S in a row.
        """
        seconds = min(seconds, max(EXCUSED_S - self._excused, 0.0))
        self._excused += seconds
        self._fresh_at += seconds
        self._first_unheard += seconds

    @property
    def _playing(self) -> bool:
        return self._stream.number("runtime_state") == PLAYING

    def _listen(self, echo: float, now: float) -> None:
        if echo in self._sent:
            self.echo_latency = now - self._sent[echo]
            self._sent = {number: t for number, t in self._sent.items() if t > self._sent[echo]}
            self._first_unheard = min(self._sent.values(), default=now)

    def send(
        self,
        qd: np.ndarray,
        acceleration: float,
        process: bool = False,
        armed: bool = False,
        shares: np.ndarray | None = None,
    ) -> bool:
        """Send one velocity, numbered for the guard's watchdog.

        A negative number enables the process, `armed` the set points, `shares` (2,) as in Given. Returns False where
        the program does not run.
        """
        self._number = (abs(self._number) % 1_000_000.0 + 1.0) * (-1.0 if process else 1.0)
        now = time.monotonic()
        if not self._sent:
            self._first_unheard = now
        self._sent[self._number] = now
        if not self._playing:
            self.forget()
            return False
        self._write(VELOCITY, *qd.tolist(), acceleration, self._number, armed=armed, shares=shares)
        return True

    def torch_off(self) -> None:
        """Turn the process output off without the guard, which may have stopped."""
        if self._switch is not None:
            self._switch.off()

    def gas(self, on: bool) -> None:
        """Open or close the gas valve, where one is wired."""
        if self._switch is not None:
            self._switch.gas(on)

    @property
    def process_on(self) -> bool:
        """The state of the process output as reported by the controller."""
        return self._output is not None and bool(int(self._stream.number(OUTPUTS)) >> self._output & 1)

    @property
    def powered(self) -> bool:
        """Whether the process output is on, or a set point is not at zero, as the controller reports them."""
        return self.process_on or any(apart(0.0, shown) for _, shown in self._shown())

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Number of the newest command sent, its time, and the newest number that the guard has read."""
        sent_at = self._sent.get(self._number, 0.0)
        return abs(self._number), sent_at, abs(self._stream.number(self._told[0]))

    def forget(self) -> None:
        """Clear the command register."""
        self._write(NO_COMMAND)

    def end_program(self) -> None:
        """End the guard script while the arm is at rest."""
        if self._playing and self._once(SPEED_STOP, 5.0):
            self._write(STOP_SCRIPT)
