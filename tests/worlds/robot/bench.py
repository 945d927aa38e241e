"""Test bench of the hardware link: an emulated controller, the link, and an arm that moves at 0.05 m/s."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tests.places import ROOT
from weldcal.models.arms.kinematics import ArmModel, kinematics_and_jacobian, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.link import LinkState, UrLink
from weldcal.systems.drivers.ur.readiness.preflight import preflight, require_ready
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.drivers.ur.wire.line import ask
from weldcal.systems.drivers.ur.wire.transport import NATIVE
from weldcal.systems.pacing import real_time_priority
from weldcal.tools.emulators.ur.main import HOME
from weldcal.tools.emulators.ur.process import Emulator

RATE_HZ = 125.0
SPEED_M_S = 0.05
ACCELERATION_M_S2 = 0.5
STROKE_M = 0.04  # to either side of where the arm starts
RUNWAY_M = 0.022  # left before the turn where a fault is thrown in: 0.44 s at full speed
DIRECTION = np.array([0.0, 0.6, 0.8])
CRUISE_LIMIT_S = 8.0
CRUISES = "cruising"
OUTPUT = 3  # the digital output of the process


class StoppedUnasked(WeldcalError):
    """The link stopped the arm although no fault had been injected."""


class Stroke:
    """The velocity of a tool that goes to and fro on a straight line at SPEED_M_S, given where the arm is."""

    def __init__(self, arm: ArmModel, home: Array) -> None:
        self._arm = arm
        self._p_home = kinematics_and_jacobian(arm, home)[1]
        self._sign = 1.0
        self.speed = 0.0
        self.place = 0.0

    def next(self, q: Array, dt: float) -> Array:
        """Joint velocity (6,) rad/s for the next dt; ramps between the directions."""
        _, p, J = kinematics_and_jacobian(self._arm, q)
        self.place = float(DIRECTION @ (p - self._p_home))
        if self.place * self._sign > STROKE_M:
            self._sign = -self._sign
        step = ACCELERATION_M_S2 * dt
        self.speed += float(np.clip(self._sign * SPEED_M_S - self.speed, -step, step))
        return np.asarray(np.linalg.solve(J, np.concatenate([np.zeros(3), self.speed * DIRECTION])), dtype=np.float64)

    @property
    def cruising(self) -> bool:
        """At full speed, with the runway ahead."""
        return abs(self.speed) > SPEED_M_S - 1e-9 and self.place * self._sign < STROKE_M - RUNWAY_M


class CommandThread(threading.Thread):
    """Commands at 125 Hz regardless of the link's state: no command after a fault may move the arm.

    `twist` changes what is sent: it takes the velocity that is due and gives another, or None to be silent.
    """

    def __init__(self, link: UrLink, arm: ArmModel, home: Array) -> None:
        super().__init__(daemon=True)
        self._link = link
        self._stroke = Stroke(arm, home)
        self._done = threading.Event()
        self.twist: Callable[[Array], Array | None] = lambda qd: qd
        self.process = False
        self.state: LinkState = link.state()
        self.worst_gap_s = 0.0
        self.gap_s = 0.0  # the longest since this was last set to zero

    def run(self) -> None:
        with real_time_priority():  # as a cell
            self._run()

    def _run(self) -> None:
        deadline = last = time.monotonic()
        while not self._done.is_set():
            time.sleep(max(0.0, deadline - time.monotonic()))
            now = time.monotonic()
            self.worst_gap_s, self.gap_s = max(self.worst_gap_s, now - last), max(self.gap_s, now - last)
            last, deadline = now, max(deadline + 1.0 / RATE_HZ, now)
            self.state = self._link.state()
            qd = self.twist(self._stroke.next(self.state.q, 1.0 / RATE_HZ))
            if qd is not None:
                self._link.command(qd, self.process)

    def stop(self) -> None:
        """End the thread."""
        self._done.set()
        self.join()

    @property
    def cruising(self) -> bool:
        """The arm goes at full speed and will for a while."""
        going = self.state.fault is Fault.NONE and self.state.number > 25 and self.state.process_on == self.process
        return going and self._stroke.cruising and float(np.abs(self.state.qd).max()) > 0.05


class Bench:
    """One emulated controller and, between `start` and `end`, an arm that moves over a link to it."""

    def __init__(
        self,
        emulator: Emulator,
        output: int | None = None,
        torch: Mapping[str, Any] | None = None,
        transport: str = NATIVE,
    ) -> None:
        """`torch`: what else of it is wired, as UrLink.start takes it."""
        self.transport = transport
        self.emulator = emulator
        self.output, self._torch = output, torch or {}
        self.host = emulator.host
        self.arm = load_arm()
        self.home = np.array(HOME)
        self.link: UrLink | None = None
        self._stream: CommandThread | None = None
        self._child: subprocess.Popen[str] | None = None
        self._workers: list[int] = []
        self.worst_gap_s = 0.0

    @property
    def stream(self) -> CommandThread:
        """The running one."""
        assert self._stream is not None, "start it first"
        return self._stream

    def start(self, *, look: bool = False, wired: bool = False, process: bool = False) -> None:
        """Acknowledge faults, then start a new link (`look`: with pre-flight checks) and the command stream.

        `wired`: with a process output, also where the bench has none; `process`: it is asked for.

        Raises:
            RobotRefused: the controller is not ready.
        """
        if look:
            require_ready(preflight(self.host))
        self.emulator.do("reset_checker")
        config = UrRtde(host=self.host)
        limits = config.limits(self.arm)
        output = OUTPUT if wired or process else self.output
        x, y, z = config.payload_cog_m
        self.link = UrLink.start(
            self.host,
            self.arm,
            limits,
            payload_kg=config.payload_kg,
            payload_cog_m=(x, y, z),
            process_output=output,
            transport=self.transport,
            **self._torch,
        )
        self._stream = CommandThread(self.link, self.arm, self.home)
        self._stream.process = process
        self._stream.start()

    def start_elsewhere(self) -> list[int]:
        """As `start`, with link and commands in a process of their own, which can be killed.

        That process's children.
        """
        self.emulator.do("reset_checker")
        command = [sys.executable, "-m", "tests.worlds.robot.bench", self.host, self.transport]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        self._child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        self.cruise()
        self._workers = worker_of(self._child.pid)
        return self._workers

    def cruise(self) -> None:
        """Wait until the arm moves at full speed with the runway ahead, here or in the process of `start_elsewhere`.

        Raises:
            StoppedUnasked: the link has stopped it.
            InputError: it does not move.
        """
        if self._child is not None:
            assert self._child.stdin is not None
            assert self._child.stdout is not None
            self._child.stdin.write("tell me when it cruises\n")
            self._child.stdin.flush()
            answer = self._child.stdout.readline().strip()
            if answer != CRUISES:
                raise StoppedUnasked(f"Before anything was done: {answer or 'the process that was to be killed ended'}")
            return
        until = time.monotonic() + CRUISE_LIMIT_S
        while not self.stream.cruising:
            if self.stream.state.fault is not Fault.NONE:
                said = self.stream.state.status.fault
                raise StoppedUnasked(f"Before anything was done (longest gap {self.stream.worst_gap_s:.3f} s): {said}")
            if time.monotonic() > until:
                raise InputError("The arm does not move though it is commanded to.")
            time.sleep(0.002)

    def signal_worker(self, number: signal.Signals) -> float:
        """To the link's worker, if it lives; when the signal was sent (s, monotonic)."""
        assert self.link is not None
        if number is signal.SIGSTOP:
            self.emulator.do("expect_silence")  # lockstep would wait for it
        now = time.monotonic()
        self.link._process.send_signal(number)
        return now

    def kill_child(self) -> float:
        """SIGKILL to the process that owns the link; when."""
        assert self._child is not None
        now = time.monotonic()
        self._child.kill()
        return now

    def computer_dies(self) -> float:
        """SIGKILL to the process that owns the link and to its worker: nothing is sent or stopped any more; when."""
        assert self._child is not None
        now = time.monotonic()
        for number in (self._child.pid, *self._workers):
            with contextlib.suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        return now

    def send(self, twist: Callable[[Array], Array | None], seconds: float) -> float:
        """Change what is sent for a while, from now; when that was."""
        stream, until = self.stream, time.monotonic() + seconds
        before = stream.twist

        def changed(qd: Array) -> Array | None:
            return twist(qd) if time.monotonic() < until else before(qd)

        now = time.monotonic()
        stream.twist = changed
        return now

    def tool_speed(self) -> float:
        """Of the emulator's arm (m/s)."""
        return float(np.linalg.norm(self.emulator.state()["tcp_speed"][:3]))

    def at_rest_after(self, fault_time: float, within_s: float) -> dict[str, float | bool | None]:
        """Return the checker's answer."""
        return self.emulator.ask(check="at_rest_after", fault_time=fault_time, within=within_s)

    def press_play(self) -> str:
        """Press Play on the dashboard; its answer."""
        try:
            return ask(self.host, "play")
        except WeldcalError as error:
            return str(error)

    def end(self, *, kill: bool = False) -> None:
        """End stream and link: in order, or by killing the worker, which is quicker after a fault."""
        if self._stream is not None:
            self._stream.stop()
            self.worst_gap_s = max(self.worst_gap_s, self._stream.worst_gap_s)
        if self.link is not None:
            if kill:
                self.signal_worker(signal.SIGKILL)
            self.link.close()
        if self._child is not None:
            self._child.kill()
            self._child.wait()
        self._stream = self.link = self._child = None


def main() -> None:
    """Moves the arm at argv[1] over the transport argv[2] until stdin closes or the process is killed.

    Answers each line when it cruises, or why it does not.
    """
    host, transport = sys.argv[1:]
    arm, config = load_arm(), UrRtde(host=host)
    load = tuple(config.payload_cog_m)
    link = UrLink.start(
        host, arm, config.limits(arm), payload_kg=config.payload_kg, payload_cog_m=load, transport=transport
    )
    stream = CommandThread(link, arm, np.array(HOME))
    stream.start()
    for _ in sys.stdin:
        until = time.monotonic() + CRUISE_LIMIT_S
        while not stream.cruising and stream.state.fault is Fault.NONE and time.monotonic() < until:
            time.sleep(0.002)
        answer = (
            CRUISES
            if stream.cruising
            else stream.state.status.fault or "The arm does not move though it is commanded to."
        )
        sys.stdout.write(f"{answer}\n")
        sys.stdout.flush()
    stream.stop()
    link.close()


def worker_of(process: int) -> list[int]:
    """Process numbers of the children of a process."""
    found = Path(f"/proc/{process}/task").glob("*/children")
    return [int(number) for file in found for number in file.read_text().split()]


if __name__ == "__main__":
    main()
