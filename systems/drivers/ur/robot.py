"""The worker's interface to the robot through ur_rtde: connect, upload the guard, read samples, send numbered velocities."""

import contextlib
import os
import socket
import stat
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from weldcal.models.arms.kinematics import ArmModel, kinematics_and_jacobian
from weldcal.systems.drivers.ur.clock import ClockMap
from weldcal.systems.drivers.ur.errors import RobotRefused, RobotUnreachable
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.off_switch import OffSwitch
from weldcal.systems.drivers.ur.rtde_wire import RtdeProbe, Value
from weldcal.systems.drivers.ur.supervisor import PLAYING, STALE_REGISTER, RobotSample

RTDE_PORT = 30004
START_LIMIT_S = 8.0
EXCUSED_S = 0.5
ONLY_WITH_OUTPUT = "# only with an output"
READ_BACK = ("tcp_offset", "payload", "payload_cog")
READ_BACK_LIMIT_S = 1.0
SCALINGS = ("speed_scaling", "target_speed_fraction")
ALWAYS = ("timestamp", "actual_q", "actual_qd", "robot_mode", "safety_mode", "runtime_state", *SCALINGS)


def same_payload(found: Mapping[str, Value], mass_kg: float, cog_m: Sequence[float]) -> bool:
    """Whether the controller reports this payload, within what it may round: 0.01 kg and 1 mm."""
    if not {"payload", "payload_cog"} <= found.keys():
        return False
    mass, cog = np.array(found["payload"]), np.array(found["payload_cog"])
    return bool(abs(mass - mass_kg) <= 0.0101 and np.abs(cog - np.array(cog_m)).max() <= 1.01e-3)


@dataclass(frozen=True)
class ArcInputs:
    """Standard digital inputs of the power source: arc established, arc fault; None where one is not wired."""

    established: int | None = None
    arc_fault: int | None = None

    @property
    def wired(self) -> bool:
        """Whether there is one."""
        return self.established is not None or self.arc_fault is not None

    def arc(self, bits: int) -> bool | None:
        """Whether the arc is established; None where that is not wired."""
        return None if self.established is None else bool(bits >> self.established & 1)

    def fault(self, bits: int) -> bool:
        """Whether the power source reports a fault."""
        return self.arc_fault is not None and bool(bits >> self.arc_fault & 1)


class Refused(Exception):
    """The start failed, with the fault that caused it."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault.name)
        self.fault = fault


def guard_script(upper_registers: bool, output: int | None = None) -> str:
    """The text of the guard script for the register range in use: 24 to 47, or 0 to 23, which fieldbuses share; `output`: the
    standard digital output of the process, None where none is wired.
    """
    text = files("weldcal.systems.drivers.ur").joinpath("guard.script").read_text(encoding="utf-8")
    if output is None:
        # a controller may refuse a program for the name of a function that it never calls
        text = "".join(line for line in text.splitlines(keepends=True) if ONLY_WITH_OUTPUT not in line)
    else:
        text = text.replace("global output = -1", f"global output = {output}")
    if upper_registers:
        return text
    changed = text.replace("global base = 24", "global base = 0").replace("global word = 36", "global word = 12")
    return changed.replace("input_int_register_24", "input_int_register_0")


def _sockets_to(port: int) -> dict[int, int]:
    """File descriptors of this process's connections to a port, each with its inode."""
    found = {}
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            descriptor = int(name)
            status = os.fstat(descriptor)
            if stat.S_ISSOCK(status.st_mode):
                with socket.socket(fileno=os.dup(descriptor)) as copy:
                    if copy.getpeername()[1:2] == (port,):
                        found[descriptor] = status.st_ino
    return found


def _send_at_once(descriptors: Iterable[int]) -> None:
    """Send every package when it is written. ur_rtde leaves Nagle's algorithm on: where the controller's packages are lost, and
    with them its acknowledgements, commands would wait for up to 40 ms.
    """
    for descriptor in descriptors:
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as copy:
            copy.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class Robot:
    """Both ur_rtde interfaces, the clock map and the newest complete package."""

    def __init__(
        self,
        host: str,
        *,
        upper: bool,
        pace: float,
        arm: ArmModel,
        output: int | None = None,
        arc_inputs: ArcInputs | None = None,
    ) -> None:
        # Here and not above: the guard's text can be read where ur_rtde is not installed.
        from rtde_control import RTDEControlInterface
        from rtde_receive import RTDEReceiveInterface

        self._host = host
        self._word = 36 if upper else 12
        self._script = guard_script(upper, output)
        self._output = output
        self._arc_inputs = arc_inputs or ArcInputs()
        self._arm = arm
        self._pace = pace
        self.clock = ClockMap(pace)
        kind = RTDEControlInterface
        flags = kind.FLAG_CUSTOM_SCRIPT | kind.FLAG_NO_WAIT | kind.FLAG_NO_EXT_FT
        flags |= kind.FLAG_UPPER_RANGE_REGISTERS if upper else 0
        names = [
            *ALWAYS,
            "actual_TCP_pose",
            f"output_int_register_{self._word}",
            # echo of the newest command number, the time for which the guard kept the arm from moving, its passes
            *(f"output_double_register_{self._word + i}" for i in range(3)),
            *(() if output is None else ("actual_digital_output_bits",)),
            *(("actual_digital_input_bits",) if self._arc_inputs.wired else ()),
        ]
        try:
            self.receive = RTDEReceiveInterface(host, -1.0, names, False, upper)
            self.control = RTDEControlInterface(host, -1.0, flags)
        except (RuntimeError, ValueError) as error:
            sys.stderr.write(f"{error}\n")
            raise Refused(Fault.CONTROL_REFUSED) from error
        self._sockets = _sockets_to(RTDE_PORT)
        _send_at_once(self._sockets)
        self._switch = None if output is None else self._off_switch(host, output)
        self._fresh_at, self._robot_time = time.monotonic(), -1.0
        self._excused = 0.0
        self._sent: dict[float, float] = {}
        self._passes, self._passed_at = -1.0, 0.0
        self._number = 0.0
        self._heard = self._first_unheard = 0.0
        self.echo_latency = 0.0

    def _off_switch(self, host: str, output: int) -> OffSwitch:
        try:
            return OffSwitch(host, output)
        except (RobotUnreachable, RobotRefused) as error:
            sys.stderr.write(f"{error}\n")
            raise Refused(Fault.OUTPUT_IN_USE) from error

    def start_guard(self) -> None:
        """Clear the command register, upload the guard and wait until it is active."""
        with tempfile.NamedTemporaryFile("w", suffix=".script", delete=False) as file:
            file.write(self._script)
        try:
            # a call while nothing runs fails, but it writes zero into the command register
            self.control.kickWatchdog()
            self.control.setCustomScriptFile(file.name)
            until = time.monotonic() + START_LIMIT_S / self._pace
            while time.monotonic() < until:
                state, guard = self.receive.getRuntimeState(), self.receive.getOutputIntRegister(self._word)
                if guard == STALE_REGISTER:
                    raise Refused(Fault.GUARD_REFUSED)
                if state == PLAYING and guard == 1 and self.control.isProgramRunning():
                    return
                time.sleep(0.01)
            raise Refused(Fault.UPLOAD_REFUSED)
        finally:
            Path(file.name).unlink(missing_ok=True)

    def set_load(self, mass_kg: float, cog_m: list[float]) -> None:
        """Set the payload, then read it back, and the TCP, which the guard has set to zero."""
        if not self.control.setPayload(mass_kg, cog_m):
            raise Refused(Fault.START_FAILED)
        found: dict[str, Value] = {}
        reader = threading.Thread(target=self._read_back, args=(found, mass_kg, cog_m), daemon=True)
        reader.start()
        while reader.is_alive():
            self.control.kickWatchdog()
            reader.join(0.01)
        if np.abs(np.array(found.get("tcp_offset", np.inf))).max() > 1e-6:
            raise Refused(Fault.TCP_NOT_ZERO)
        if not same_payload(found, mass_kg, cog_m):
            raise Refused(Fault.PAYLOAD_NOT_SET)

    def _read_back(self, found: dict[str, Value], mass_kg: float, cog_m: list[float]) -> None:
        """Read until the payload is the one that was set, in a thread: the connection's end may take longer than the guard
        waits for a package. ur_rtde cannot read the TCP, and not all of its getters wait for their answer.
        """
        until = time.monotonic() + READ_BACK_LIMIT_S / self._pace
        with contextlib.suppress(RobotUnreachable), RtdeProbe(self._host) as probe:
            while True:
                found.update(probe.read(READ_BACK))
                if same_payload(found, mass_kg, cog_m) or time.monotonic() > until:
                    return
                time.sleep(0.01)

    def sample(self, now: float) -> RobotSample:
        """The newest sample, all fields of one package."""
        receive, word = self.receive, self._word
        for _ in range(5):
            robot_time = float(receive.getTimestamp())
            q, qd = np.array(receive.getActualQ()), np.array(receive.getActualQd())
            pose = receive.getActualTCPPose()
            echo, lost_s, passes = (float(receive.getOutputDoubleRegister(word + i)) for i in range(3))
            process_on = None if self._output is None else self.process_on
            inputs = int(receive.getActualDigitalInputBits()) if self._arc_inputs.wired else 0
            if robot_time == receive.getTimestamp():
                break
        if robot_time != self._robot_time:
            self._robot_time, self._fresh_at, self._excused = robot_time, now, 0.0
            self.clock.update(robot_time, now)
        if passes != self._passes:
            self._passes, self._passed_at = passes, robot_time
        self._listen(echo, now)
        return RobotSample(
            robot_time,
            self._fresh_at,
            q,
            qd,
            int(receive.getRobotMode()),
            int(receive.getSafetyMode()),
            int(receive.getRuntimeState()),
            # the slider is in the second one; the first is the limiter's
            float(receive.getSpeedScaling()) * float(receive.getTargetSpeedFraction()),
            int(receive.getOutputIntRegister(word)),
            self._connected(),
            float(np.linalg.norm(kinematics_and_jacobian(self._arm, q)[1] - np.array(pose[:3]))),
            now - self._first_unheard if self._sent else 0.0,
            lost_s,
            robot_time - self._passed_at,
            process_on,
            echo < 0.0,
            self._arc_inputs.arc(inputs),
            self._arc_inputs.fault(inputs),
        )

    def excuse(self, seconds: float) -> None:
        """Do not count this time, in which the process was suspended, as silence of the robot; at most EXCUSED_S in a row."""
        seconds = min(seconds, max(EXCUSED_S - self._excused, 0.0))
        self._excused += seconds
        self._fresh_at += seconds
        self._first_unheard += seconds

    def _connected(self) -> bool:
        """Whether both connections are still those of the start; ur_rtde reconnects by itself and then reports no error."""
        if not (self.receive.isConnected() and self.control.isConnected()):
            return False
        try:
            return all(os.fstat(descriptor).st_ino == inode for descriptor, inode in self._sockets.items())
        except OSError:
            return False

    def _listen(self, echo: float, now: float) -> None:
        if echo in self._sent:
            self.echo_latency = now - self._sent[echo]
            self._sent = {number: t for number, t in self._sent.items() if t > self._sent[echo]}
            self._first_unheard = min(self._sent.values(), default=now)

    def send(self, qd: np.ndarray, acceleration: float, process: bool = False) -> bool:
        """Send one velocity, numbered for the guard's watchdog; a negative number enables the process. Returns False where the
        program does not run.
        """
        self._number = (abs(self._number) % 1_000_000.0 + 1.0) * (-1.0 if process else 1.0)
        now = time.monotonic()
        if not self._sent:
            self._first_unheard = now
        self._sent[self._number] = now
        return bool(self.control.speedJ(qd.tolist(), acceleration, self._number))

    def torch_off(self) -> None:
        """Turn the process output off without the guard, which may have stopped."""
        if self._switch is not None:
            self._switch.off()

    @property
    def process_on(self) -> bool:
        """The state of the process output as reported by the controller."""
        return self._output is not None and bool(self.receive.getActualDigitalOutputBits() >> self._output & 1)

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Number of the newest command sent, its time, and the newest number that the guard has read."""
        sent_at = self._sent.get(self._number, 0.0)
        return abs(self._number), sent_at, abs(float(self.receive.getOutputDoubleRegister(self._word)))

    def forget(self) -> None:
        """Clear the command register: a call while the program does not run writes zero."""
        self.control.kickWatchdog()

    def end_program(self) -> None:
        """End the guard script while the arm is at rest."""
        if self.control.isProgramRunning():
            self.control.speedStop(5.0)
            self.control.stopScript()
