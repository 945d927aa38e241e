"""The cell's side of the robot link.

Starts the worker, shares memory with it without blocking, and ends the program.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arms.kinematics import ArmModel
from weldcal.systems.drivers.ur.faults import Fault, RobotRefused, sentence
from weldcal.systems.drivers.ur.readiness.operator_actions import ROBOT_MODES, SAFETY_MODES, as_on_x
from weldcal.systems.drivers.ur.robot import WorkerConfig
from weldcal.systems.drivers.ur.shared import Given, Memory, Published, TornRead
from weldcal.systems.drivers.ur.supervisor import ACTIONS, Action, Limits
from weldcal.systems.drivers.ur.wire.line import ask, stop_program
from weldcal.systems.drivers.ur.worker import WorkerPhase
from weldcal.systems.interrupts import started
from weldcal.systems.messages import UrStatus

START_LIMIT_S = 20.0  # twice FIRST_LIMIT_S and START_LIMIT_S of robot.py: the rest is for the worker's imports
CLOSE_LIMIT_S = 5.0  # twice what the worker takes at most, STOP_LIMIT_S and ENDS_S
HEARTBEAT_LIMIT_S = 0.15  # when it has elapsed, the guard's 150 ms have too, and the arm brakes without the worker
PLAYING, PAUSING, PAUSED = 2, 3, 4


class StartFailed(RobotRefused):
    """The worker process ended, or did not start in time; nothing has moved."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LinkState(Published):
    """The worker's newest state, with the fault as the cell judges it.

    Times in s of the host's monotonic clock, except `robot_time` (the controller's clock).
    """

    age_s: float = 0.0  # since the robot took the sample
    fault: Fault = Fault.NONE
    on_x: bool = False  # the controller has PolyScope X

    @property
    def program_running(self) -> bool:
        """The guard obeys the cell."""
        return self.runtime_state == PLAYING and self.fault is Fault.NONE

    @property
    def codes(self) -> tuple[float, ...]:
        """The numbers that `status_of` reads."""
        running = float(self.program_running)
        modes = float(self.robot_mode), float(self.safety_mode)
        return *modes, running, self.speed_scaling, self.fault, self.detail, float(self.on_x)

    @property
    def status(self) -> UrStatus:
        """The state of the controller in words."""
        return status_of(self.codes)


@lru_cache(maxsize=64)
def status_of(codes: tuple[float, ...]) -> UrStatus:
    """Return the controller's state in words.

    The numbers are robot mode, safety mode, running (0 or 1), speed scaling, fault and its detail, and whether the
    controller has PolyScope X (0 or 1).
    """
    robot_mode, safety_mode, running, scaling, code, detail, on_x = codes
    fault = Fault(int(code))
    said = sentence(fault, detail) if fault is not Fault.NONE else ""
    return UrStatus(
        robot_mode=ROBOT_MODES.get(int(robot_mode), "UNKNOWN"),
        safety_mode=SAFETY_MODES.get(int(safety_mode), "UNKNOWN"),
        program_running=running > 0.5,
        speed_scaling=scaling,
        fault=(as_on_x(said) if on_x else said) or None,
    )


class UrLink:
    """A running worker. `start` creates it; `close` ends the program, then the worker."""

    def __init__(self, config: WorkerConfig) -> None:
        self._config = config
        descriptor = os.memfd_create("weldcal-ur")
        os.ftruncate(descriptor, Memory.size())
        self._memory = Memory(descriptor)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the link)
        command = [sys.executable, "-m", "weldcal.systems.drivers.ur.worker", str(descriptor)]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        self._process = started(
            command,
            stdin=subprocess.PIPE,
            stdout=self._errors,
            stderr=self._errors,
            pass_fds=(descriptor,),
            env=environment,
        )
        os.close(descriptor)
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(pickle.dumps(config))
            self._process.stdin.close()
        self._number = 0
        self._died: tuple[Fault, float, float] | None = None
        self._last: Published | None = None
        self._stopper: threading.Thread | None = None
        self._finalizer = weakref.finalize(self, _kill, self._process)

    @classmethod
    def start(cls, host: str, arm: ArmModel, limits: Limits, **options: Any) -> UrLink:
        """Start the worker, upload the guard, and wait until it is active.

        The arm does not move, the process output is off.

        `options` are the other fields of WorkerConfig.

        Raises:
            RobotRefused: the message gives the operator action; worker and program are ended.
        """
        config = WorkerConfig(host=host, arm=arm, limits=limits, parent=os.getpid(), **options)
        link = cls(config)
        until = time.monotonic() + START_LIMIT_S / limits.pace
        while time.monotonic() < until:
            found = link._memory.state.read()
            if found is not None:
                if found.phase == WorkerPhase.OBEYING:
                    return link
                if found.fault:
                    fault = Fault(found.fault)
                    link._end()
                    kind = StartFailed if fault == Fault.START_FAILED else RobotRefused
                    said = sentence(fault, found.detail)
                    raise kind(as_on_x(said) if link._on_x else said)
            if link._process.poll() is not None:
                break
            time.sleep(0.01)
        code = link._process.poll()
        ended = f"It did not answer in {START_LIMIT_S:.0f} s." if code is None else f"It ended with exit code {code}."
        said = link._said()
        link._end()
        raise StartFailed(f"{sentence(Fault.START_FAILED)} {ended}" + (f" Its output: {said}" if said else ""))

    def command(self, qd: NDArray[np.float64], process: bool = False, shares: NDArray[np.float64] | None = None) -> int:
        """Pass a joint velocity (6,) rad/s, the process enable, and shares as in Given; returns the command's number.

        Never blocks.
        """
        more: dict[str, Any] = {} if shares is None else {"shares": shares}
        self._give(qd, process=process, **more)
        return self._number

    def _give(self, qd: NDArray[np.float64], *, stop: bool = False, process: bool = False, **more: Any) -> None:
        self._number += 1
        command = Given(number=self._number, host_time=time.monotonic(), stop=stop, process=process, qd=qd, **more)
        self._memory.command.write(command)

    def rest(self) -> None:
        """Command zero velocity, with the process off, until the next command."""
        self.command(np.zeros(6))

    def joints_at(self, host_time: float) -> NDArray[np.float64] | None:
        """Joint positions (6,) rad at a host time (s, monotonic) of the last two seconds.

        None where there is no sample.
        """
        return self._memory.ring.at(host_time)

    def robot_time(self) -> float:
        """Return the controller's time (s) of the newest sample; 0 before the first. Never blocks."""
        with contextlib.suppress(TornRead):
            self._last = self._memory.state.read() or self._last
        return 0.0 if self._last is None else self._last.robot_time

    def state(self) -> LinkState:
        """Return the newest state. Never blocks.

        Raises:
            RuntimeError: the worker is not active yet.
        """
        with contextlib.suppress(TornRead):
            self._last = self._memory.state.read() or self._last
        found = self._last
        if found is None:
            raise RuntimeError("the link has not started")
        now = time.monotonic()
        fault, fault_time, detail = Fault(found.fault), found.fault_time, found.detail
        if fault is Fault.NONE and self._died is None and found.phase != WorkerPhase.ENDED:
            limits = self._config.limits
            quiet = now - found.heartbeat > max(HEARTBEAT_LIMIT_S / limits.pace, limits.stale_s)
            ended = self._process.poll() is not None
            if quiet or ended:
                self._died = (self._cause(ended), now, 1e3 * (now - found.host_time))
                _kill(self._process)
        if fault is Fault.NONE and self._died is not None:
            fault, fault_time, detail = self._died
        paused = found.runtime_state in (PAUSING, PAUSED)
        if fault is not Fault.NONE and (paused or ACTIONS.get(fault, Action.LEAVE) in (Action.STOP, Action.LEAVE)):
            self._see_to_the_stop()
        judged = vars(found) | {"fault": fault, "fault_time": fault_time, "detail": detail}
        return LinkState(**judged, age_s=now - found.host_time, on_x=self._on_x)

    @property
    def _on_x(self) -> bool:
        return self._config.version[:1] >= (10,)

    def close(self) -> None:
        """Brake, end the program, end the worker, then confirm the stop at its operator's port. May be called twice."""
        if not self._finalizer.alive:
            return
        if self._process.poll() is None:
            self._give(np.zeros(6), stop=True)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(CLOSE_LIMIT_S / self._config.limits.pace)
        last = self._memory.state.read() or self._last
        paused = last is not None and last.runtime_state in (PAUSING, PAUSED)
        if self._process.returncode != 0 or paused:
            self._stop_program()
        if self._stopper is not None:
            self._stopper.join()
        self._end()

    def _see_to_the_stop(self) -> None:
        """Stop the program after a stop that the driver did not command: a paused program could be resumed."""
        if self._stopper is None:
            self._stopper = threading.Thread(target=self._stop_program, daemon=True)
            self._stopper.start()

    def _stop_program(self) -> None:
        from weldcal.systems.drivers.ur.wire.robot_api import asker  # only after a stop

        # where nothing answers (no network) the guard's watchdog has stopped the arm
        with contextlib.suppress(RobotRefused):
            stop_program(self._config.host, asks=asker(self._config.version) or ask)

    def _cause(self, ended: bool) -> Fault:
        """Return the fault of a worker that gives no state.

        After a lost connection ur_rtde may crash, or connect again inside a call for as long as it takes.
        """
        if ended:
            return Fault.LINK_CLOSED if "reconnecting" in self._output().lower() else Fault.WORKER_DIED
        calling = self._memory.calling.read()
        return Fault.LINK_STALE if calling is not None and calling.inside else Fault.WORKER_DIED

    def _output(self) -> str:
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace")

    def _said(self) -> str:
        lines = self._output().strip().splitlines()
        return lines[-1] if lines else ""

    def _end(self) -> None:
        self._finalizer()
        self._errors.close()


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait()
