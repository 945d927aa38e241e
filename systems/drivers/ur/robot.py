"""The worker's interface to the robot through ur_rtde: connect, upload the guard, read samples, send numbered velocities."""

import contextlib
import os
import socket
import stat
import sys
import tempfile
import time
from importlib.resources import files
from pathlib import Path

import numpy as np

from weldcal.models.arms.kinematics import ArmModel, kinematics_and_jacobian
from weldcal.systems.drivers.ur.clock import ClockMap
from weldcal.systems.drivers.ur.errors import RobotRefused, RobotUnreachable
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.off_switch import OffSwitch
from weldcal.systems.drivers.ur.supervisor import PLAYING, STALE_REGISTER, RobotSample

RTDE_PORT = 30004
START_LIMIT_S = 8.0
EXCUSED_S = 0.5
ALWAYS = ("timestamp", "actual_q", "actual_qd", "robot_mode", "safety_mode", "runtime_state", "speed_scaling")


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
    if output is not None:
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


class Robot:
    """Both ur_rtde interfaces, the clock map and the newest complete package."""

    def __init__(self, host: str, *, upper: bool, pace: float, arm: ArmModel, output: int | None = None) -> None:
        # Here and not above: the guard's text can be read where ur_rtde is not installed.
        from rtde_control import RTDEControlInterface
        from rtde_receive import RTDEReceiveInterface

        self._word = 36 if upper else 12
        self._script = guard_script(upper, output)
        self._output = output
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
            # echo of the newest command number, and the TCP read back
            *(f"output_double_register_{self._word + i}" for i in range(7)),
            *(() if output is None else ("actual_digital_output_bits",)),
        ]
        try:
            self.receive = RTDEReceiveInterface(host, -1.0, names, False, upper)
            self.control = RTDEControlInterface(host, -1.0, flags)
        except (RuntimeError, ValueError) as error:
            sys.stderr.write(f"{error}\n")
            raise Refused(Fault.CONTROL_REFUSED) from error
        self._sockets = _sockets_to(RTDE_PORT)
        self._switch = None if output is None else self._off_switch(host, output)
        self._fresh_at, self._robot_time = time.monotonic(), -1.0
        self._excused = 0.0
        self._sent: dict[float, float] = {}
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
        """Set the payload, and read back the TCP, which the guard has set to zero."""
        if not self.control.setPayload(mass_kg, cog_m):
            raise Refused(Fault.START_FAILED)
        # the register in which the client expects the answer depends on the controller's version: read our own registers
        self.control.getTCPOffset()
        asked = self.receive.getTimestamp()
        until = time.monotonic() + 0.5 / self._pace
        while self.receive.getTimestamp() - asked < 0.008 and time.monotonic() < until:
            self.control.kickWatchdog()
            time.sleep(0.002)
        offset = [self.receive.getOutputDoubleRegister(self._word + 1 + i) for i in range(6)]
        if np.abs(offset).max() > 1e-6:
            raise Refused(Fault.TCP_NOT_ZERO)

    def sample(self, now: float) -> RobotSample:
        """The newest sample, all fields of one package."""
        receive = self.receive
        for _ in range(5):
            robot_time = float(receive.getTimestamp())
            q, qd = np.array(receive.getActualQ()), np.array(receive.getActualQd())
            pose = receive.getActualTCPPose()
            echo = float(receive.getOutputDoubleRegister(self._word))
            if robot_time == receive.getTimestamp():
                break
        if robot_time != self._robot_time:
            self._robot_time, self._fresh_at, self._excused = robot_time, now, 0.0
            self.clock.update(robot_time, now)
        self._listen(echo, now)
        return RobotSample(
            robot_time,
            self._fresh_at,
            q,
            qd,
            int(receive.getRobotMode()),
            int(receive.getSafetyMode()),
            int(receive.getRuntimeState()),
            float(receive.getSpeedScaling()),
            int(receive.getOutputIntRegister(self._word)),
            self._connected(),
            float(np.linalg.norm(kinematics_and_jacobian(self._arm, q)[1] - np.array(pose[:3]))),
            now - self._first_unheard if self._sent else 0.0,
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
        """Send one velocity, numbered for the guard's watchdog; a number plus one half enables the process. Returns False where
        the program does not run.
        """
        self._number = np.floor(self._number) % 1_000_000.0 + (1.5 if process else 1.0)
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
        return self._number, sent_at, float(self.receive.getOutputDoubleRegister(self._word))

    def forget(self) -> None:
        """Clear the command register: a call while the program does not run writes zero."""
        self.control.kickWatchdog()

    def end_program(self) -> None:
        """End the guard script while the arm is at rest."""
        if self.control.isProgramRunning():
            self.control.speedStop(5.0)
            self.control.stopScript()
