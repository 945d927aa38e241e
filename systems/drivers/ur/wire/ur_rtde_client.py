"""The transport that uses the client library ur_rtde, with the guard as its control script. Only the worker imports it.

Its constructors hold the interpreter's lock, it connects again by itself, and it may crash after a lost connection: the
worker leaves at the first sign of one, and the guard obeys a number once only.
"""

import contextlib
import math
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rtde_control import RTDEControlInterface
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface

from weldcal.systems.drivers.ur.faults import RobotRefused, RobotUnreachable
from weldcal.systems.drivers.ur.set_points import Level
from weldcal.systems.drivers.ur.wire import transport
from weldcal.systems.drivers.ur.wire.rtde_client import RTDE_PORT, NotFinite

READS = 5  # of a state, until no package arrives meanwhile
# a quarter of the controller's frame: a state is read at most so late; half of it doubles the wake-ups
WAKES_S = 0.0005
# a choice: the off is sent within a frame of 2 ms, and a pass of 4 ms must not wait for a lost link
OFF_LIMIT_S = 0.005
# What the library decodes, in its own type table, and how it is read; a name that it lacks would shift all that follow.
GETTERS = {
    "timestamp": "getTimestamp",
    "actual_q": "getActualQ",
    "actual_qd": "getActualQd",
    "actual_TCP_pose": "getActualTCPPose",
    "robot_mode": "getRobotMode",
    "safety_mode": "getSafetyMode",
    "runtime_state": "getRuntimeState",
    "speed_scaling": "getSpeedScaling",
    "target_speed_fraction": "getTargetSpeedFraction",
    "actual_digital_output_bits": "getActualDigitalOutputBits",
    "actual_digital_input_bits": "getActualDigitalInputBits",
}
REGISTERS = {"output_int_register_": "getOutputIntRegister", "output_double_register_": "getOutputDoubleRegister"}
FLAGS = RTDEControlInterface.Flags


class UrRtdeTransport:
    """See Transport. `outputs` without the guard's answer, which the library itself waits for."""

    def __init__(self, host: str, outputs: Sequence[str], upper: bool) -> None:
        self._host, self._upper = host, upper
        # its own script is never uploaded; remote control is a check of the pre-flight, and the upload shows it
        flags = (
            FLAGS.FLAG_CUSTOM_SCRIPT
            | FLAGS.FLAG_NO_WAIT
            | FLAGS.FLAG_NO_EXT_FT
            | FLAGS.FLAG_DISABLE_REMOTE_CONTROL_CHECK
        )
        flags |= FLAGS.FLAG_UPPER_RANGE_REGISTERS if upper else 0
        try:
            self._receive = RTDEReceiveInterface(host, -1.0, list(outputs), False, upper)
            self._control = RTDEControlInterface(host, -1.0, int(flags))
        except (RuntimeError, ValueError) as error:
            raise RobotRefused(f"ur_rtde: {error}") from error
        send_at_once(RTDE_PORT)
        self._getters = {name: self._getter(name) for name in outputs}
        self._newest: dict[str, Any] = {}
        self.connected, self.not_finite = True, ""
        self.poll()
        if self.not_finite:
            raise NotFinite(self.not_finite)
        if not self._newest:
            raise RobotUnreachable("The controller accepts the recipe and sends no data.")

    def _getter(self, name: str) -> Callable[[], Any]:
        for start, method in REGISTERS.items():
            if name.startswith(start):
                return partial(getattr(self._receive, method), int(name.removeprefix(start)))
        return getattr(self._receive, GETTERS[name])  # type: ignore[no-any-return]

    def poll(self) -> None:
        """See Transport. Each value is read by itself: a state counts where no package arrived in between."""
        self.connected = self.connected and self._receive.isConnected() and self._control.isConnected()
        for _ in range(READS):
            time_before = self._receive.getTimestamp()
            found = {name: get() for name, get in self._getters.items()}
            wrong = [name for name, value in found.items() if not _finite(value)]
            if wrong:
                self.not_finite = wrong[0]
                return
            if self._receive.getTimestamp() == time_before == found["timestamp"]:
                self._newest = found
                return

    def wait(self, seconds: float) -> None:
        """See Transport."""
        before, until = self._receive.getTimestamp(), time.monotonic() + seconds
        while self._receive.getTimestamp() == before and time.monotonic() < until:
            time.sleep(WAKES_S)
        self.poll()

    def number(self, name: str) -> float:
        """See Transport."""
        return float(self._newest[name])

    def vector(self, name: str) -> tuple[float, ...]:
        """See Transport."""
        return tuple(self._newest[name])

    def send(self, *values: float) -> None:
        """See Transport. The number of a velocity is in ur_rtde's `time`, which it does not check."""
        command, *numbers = values
        if command == transport.VELOCITY:
            self._control.speedJ(numbers[:6], numbers[6], numbers[7])
        elif command == transport.STOP_SCRIPT:
            self._control.stopScript()
        elif command == transport.NO_COMMAND:
            self._control.kickWatchdog()
        else:
            raise ValueError(f"ur_rtde sends no command {command}")

    def once(self, until: float, *values: float) -> bool:
        """See Transport. ur_rtde waits for the answer itself, at most as long as the program runs."""
        command, *numbers = values
        if command == transport.SET_PAYLOAD:
            return bool(self._control.setPayload(numbers[0], numbers[1:4]))
        if command == transport.SPEED_STOP:
            return bool(self._control.speedStop(numbers[0]))
        raise ValueError(f"ur_rtde gives no command {command}")

    def upload(self, script: str, started: Callable[[], bool], until: float) -> bool:
        """See Transport."""
        if "$" in script:
            raise ValueError("ur_rtde would read the script's $ as a version")
        # it uploads its own script where it cannot read the file
        with tempfile.NamedTemporaryFile("w", suffix=".script", encoding="utf-8") as file:
            file.write(script)
            file.flush()
            self._control.setCustomScriptFile(file.name)
            while time.monotonic() < until:
                self.wait(transport.LOOK_S)
                # its control interface has a connection of its own, and gives no command before it has seen the program
                # run
                if started() and self._control.isProgramRunning():
                    return True
        return False

    def switch(self, output: int, gas: int | None, levels: Sequence[Level]) -> transport.Switch:
        """See Transport."""
        if levels:
            raise RobotRefused("ur_rtde cannot write the set points.")
        try:
            io = RTDEIOInterface(self._host, False, self._upper)
        except RuntimeError as error:
            raise RobotRefused(f"ur_rtde: {error}") from error
        send_at_once(RTDE_PORT)
        return UrRtdeSwitch(io, output, gas)


class UrRtdeSwitch:
    """See Switch.

    A lost connection makes ur_rtde connect again for as long as it takes: that must not hold the worker.
    """

    def __init__(self, io: RTDEIOInterface, output: int, gas: int | None) -> None:
        self._io, self._output, self._gas = io, output, gas

    def off(self) -> None:
        """See Switch."""
        self._set(self._output, False)

    def gas(self, on: bool) -> None:
        """See Switch."""
        if self._gas is not None:
            self._set(self._gas, on)

    def _set(self, output: int, on: bool) -> None:
        writer = threading.Thread(target=self._io.setStandardDigitalOut, args=(output, on), daemon=True)
        writer.start()
        writer.join(OFF_LIMIT_S)


def send_at_once(port: int) -> int:
    """Turn Nagle's algorithm off on this process's connections to a port; returns on how many it was on.

    ``ur_rtde`` sets the option before it connects, which opens another socket. Without it a command waits up to 40 ms
    for the controller's next package, which is long where states are lost.
    """
    changed = 0
    for name in os.listdir("/proc/self/fd"):
        if not os.path.realpath(f"/proc/self/fd/{name}").partition("socket:")[1]:
            continue
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(int(name))) as one:
            if one.family == socket.AF_INET and one.getpeername()[1] == port:
                changed += not one.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return changed


def _finite(value: Any) -> bool:
    return all(map(math.isfinite, value)) if isinstance(value, list) else math.isfinite(value)
