"""The worker process: reads the robot, calls the supervisor, sends commands, and exits when the link fails.

The cell may compute for longer than a tick, or end: this process still supervises the arm. The two share only memory.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys
import time
from dataclasses import replace
from enum import IntEnum

import numpy as np

from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.robot import ControllerStream, Refused, WorkerConfig
from weldcal.systems.drivers.ur.set_points import Gas, SetPoints, apart
from weldcal.systems.drivers.ur.shared import Calling, Given, Memory, Published, TornRead
from weldcal.systems.drivers.ur.supervisor import (
    PLAYING,
    STOPPING,
    Action,
    Decision,
    RobotSample,
    Supervisor,
    VelocityCommand,
)
from weldcal.systems.pacing import take_priority

FRESH_S = 0.012  # of robot time; three periods of the commands
ZERO_S = 0.050  # as Limits.late_s: the arm is at rest before the silence is a fault
RISE_PER_S = 10.0  # full speed again in 0.1 s: 10 rad/s^2 at 1 rad/s, a quarter of ACCELERATION


class TimeScale:
    """The factor of the newest velocity: 1 while it is fresh, falling to 0 at ZERO_S, rising again by RISE_PER_S.

    The direction is kept, so that the arm stays on its path; the cell reads where the arm is and goes on from there.
    """

    def __init__(self, pace: float) -> None:
        self._pace = pace
        self._last = 0.0
        self.factor = 1.0

    def step(self, now: float, age_s: float) -> float:
        """Return the factor for a velocity that was given `age_s` (host time) before `now` (s, monotonic)."""
        age, passed = self._pace * age_s, self._pace * max(now - self._last, 0.0)
        fresh = min(max((ZERO_S - age) / (ZERO_S - FRESH_S), 0.0), 1.0)
        self.factor = min(fresh, self.factor + RISE_PER_S * passed)
        self._last = now
        return self.factor


ACCELERATION = 40.0  # rad/s^2 of speedj: the cell ramps the stream, the controller only follows
# a choice: five passes of 4 ms, half of Limits.stale_process_s; a shorter delay is an ordinary scheduler's
LATE_PASS_S = 0.020
REST_RAD_S = 1e-3  # as flange_mover.SETTLED_RAD_S
STOP_LIMIT_S = 2.0  # ten times what Limits.braking needs from 1 rad/s: an arm that has not stopped by then will not
ENDS_S = 0.5  # for which the program's end is waited for
RESTS_S = 5.0  # for which an arm at rest waits for a cell that computes
LEFT = 3  # exit code of a worker that exited because of the link


class WorkerPhase(IntEnum):
    """The phase of the worker process."""

    STARTING = 0
    OBEYING = 1
    STOPPED = 2  # nothing is sent any more; the state is still read
    ENDED = 3


class Worker:
    """The worker's loop and its counters."""

    def __init__(self, config: WorkerConfig, memory: Memory) -> None:
        self._config, self._memory = config, memory
        self._supervisor = Supervisor(config.limits)
        self._scale = TimeScale(config.limits.pace)
        self._phase = WorkerPhase.STARTING
        self._fault_time = 0.0
        self._worst = 0.0
        self._late = 0
        self._put_out = False
        self._driven = 0  # number of the newest command that was sent
        self._gas = Gas(config.gas_before_s, config.gas_after_s)
        self._gas_on = False
        self._points = SetPoints()
        self._ringed = -1.0
        self._newest: Given | None = None
        self._rest_since: float | None = None
        self._braking_since: float | None = None

    def run(self, robot: ControllerStream) -> int:
        """Run until the cell requests a stop or the link fails; returns the process's exit code."""
        period = 1.0 / self._config.rate_hz
        self._phase = WorkerPhase.OBEYING
        deadline = last = time.monotonic()
        while True:
            now = time.monotonic()
            if now < deadline:
                time.sleep(deadline - now)
                now = time.monotonic()
            self._worst = max(self._worst, now - last)
            self._late += now - last > period + LATE_PASS_S
            if now - last > LATE_PASS_S:
                # this process was suspended: the time in which it could not read the data is not the robot's silence
                robot.excuse(now - last)
                self._supervisor.excuse()
            last, deadline = now, max(deadline + period, now)
            sample = robot.sample(now)
            command = self._with_torch(self._scaled(self._command(), now, sample), robot, sample)
            decision = self._supervisor.step(now, sample, command)
            if decision.fault is not Fault.NONE and self._fault_time == 0.0:
                self._fault_time = now
            if decision.action is not Action.SEND and (robot.powered or not self._put_out):
                robot.torch_off()
                self._put_out = True
                self._valve(robot, False)
            if decision.action is Action.LEAVE:
                self._publish(now, robot, sample, decision)
                return LEFT
            if self._phase is WorkerPhase.OBEYING:
                self._memory.calling.write(Calling(inside=True))
                self._drive(now, robot, sample, command, decision)
                self._memory.calling.write(Calling(inside=False))
            self._publish(now, robot, sample, decision)
            if (command.stop or command.orphaned) and self._phase is not WorkerPhase.OBEYING:
                self._valve(robot, False)
                self._await_the_end(robot, period)
                self._phase = WorkerPhase.ENDED
                self._publish(now, robot, sample, decision)
                return 0

    def _command(self) -> VelocityCommand:
        orphaned = os.getppid() != self._config.parent
        with contextlib.suppress(TornRead):
            self._newest = self._memory.command.read() or self._newest
        found = self._newest
        if found is None:
            return VelocityCommand(orphaned=orphaned)
        return VelocityCommand(
            number=found.number,
            given_at=found.host_time,
            qd=found.qd,
            stop=found.stop,
            orphaned=orphaned,
            process=found.process,
            shares=found.shares,
        )

    def _with_torch(self, command: VelocityCommand, robot: ControllerStream, sample: RobotSample) -> VelocityCommand:
        """Return the command whose torch waits for the gas and then for the set points, where they are wired."""
        torch, armed = command.process, False
        if self._config.gas_output is not None:
            flows, torch = self._gas.step(sample.robot_time, torch)
            self._valve(robot, flows and not self._put_out)
        if self._config.levels:
            shown = zip(self._config.levels, sample.set_points, strict=True)
            right = not any(apart(level.wanted(command.shares), share) for level, (_, share) in shown)
            armed, torch = self._points.step(sample.robot_time, torch, right)
        return replace(command, process=torch, armed=armed)

    def _valve(self, robot: ControllerStream, on: bool) -> None:
        if on != self._gas_on:
            robot.gas(on)
            self._gas_on = on

    def _scaled(self, command: VelocityCommand, now: float, sample: RobotSample) -> VelocityCommand:
        """Return the command with the factor that slows the arm while command or state is late.

        Not under a burning torch, which goes out first.
        """
        factor = self._scale.step(now, now - min(command.given_at, sample.fresh_at))
        kept = command.process or self._config.limits.waits
        return command if kept else replace(command, scale=factor)

    def _drive(
        self, now: float, robot: ControllerStream, sample: RobotSample, command: VelocityCommand, decision: Decision
    ) -> None:
        if decision.action is Action.SEND:
            old = command.number == self._driven and now - command.given_at > self._config.limits.hold_s
            # a cell that follows the controller is waited for at rest too, so that its devices' time is its own
            waited_for = self._config.limits.follows and now - command.given_at < RESTS_S
            if old and (command.qd.any() or waited_for):
                return  # the controller waits for the cell's next command
            self._driven = command.number
            # The supervisor ends a late command with the torch on. Set points that wait for the torch are no fault:
            # they go to zero.
            armed = command.armed and now - command.given_at <= self._config.limits.late_s
            if not robot.send(command.scaled_qd, ACCELERATION, command.process, armed, command.shares):
                self._phase = WorkerPhase.STOPPED  # the next sample shows the cause
        elif decision.action is Action.STOP:
            robot.forget()
            self._phase = WorkerPhase.STOPPED
        else:
            self._brake(now, robot, sample)

    def _brake(self, now: float, robot: ControllerStream, sample: RobotSample) -> None:
        """Send zero velocity until the arm is at rest, then end the program."""
        self._braking_since = now if self._braking_since is None else self._braking_since
        robot.send(np.zeros(6), self._config.limits.braking)
        resting = np.abs(sample.qd).max() < REST_RAD_S
        self._rest_since = (self._rest_since or now) if resting else None
        rested = self._rest_since is not None and now - self._rest_since > 0.05 / self._config.limits.pace
        if rested or now - self._braking_since > STOP_LIMIT_S / self._config.limits.pace:
            robot.end_program()
            self._phase = WorkerPhase.STOPPED

    def _await_the_end(self, robot: ControllerStream, period: float) -> None:
        """Wait until the controller's program has ended, so that nothing of it runs on after this process."""
        until = time.monotonic() + ENDS_S / self._config.limits.pace
        while (now := time.monotonic()) < until and robot.sample(now).runtime_state in (PLAYING, STOPPING):
            time.sleep(period)

    def _publish(self, now: float, robot: ControllerStream, sample: RobotSample, decision: Decision) -> None:
        host_time = robot.clock.to_host(sample.robot_time)
        if sample.robot_time != self._ringed:
            self._memory.ring.append(host_time, sample.q.tolist())
            self._ringed = sample.robot_time
        number, sent_at, echo = robot.numbers
        self._memory.state.write(
            Published(
                heartbeat=time.monotonic(),
                phase=self._phase,
                host_time=host_time,
                robot_time=sample.robot_time,
                q=sample.q,
                qd=sample.qd,
                robot_mode=sample.robot_mode,
                safety_mode=sample.safety_mode,
                runtime_state=sample.runtime_state,
                speed_scaling=sample.speed_scaling,
                fault=decision.fault,
                detail=decision.detail,
                fault_time=self._fault_time,
                number=number,
                sent_time=sent_at,
                echo=echo,
                echo_latency=robot.echo_latency,
                worst_period=self._worst,
                late_periods=self._late,
                process_on=robot.process_on,
                clock_residual=robot.clock.residual_s,
                clock_drift=robot.clock.drift,
                arc=-1 if sample.arc is None else sample.arc,
            )
        )

    def refuse(self, refused: Refused) -> None:
        """Publish the fault that made the start fail."""
        fault, detail = refused.fault, refused.detail
        self._memory.state.write(
            Published(heartbeat=time.monotonic(), phase=WorkerPhase.ENDED, fault=fault, detail=detail)
        )


def main() -> None:
    """Entry point of `python -m weldcal.systems.drivers.ur.worker FD`, with a pickled WorkerConfig on stdin."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupted cell requests a regular stop of its worker
    memory = Memory(int(sys.argv[1]))
    config: WorkerConfig = pickle.load(sys.stdin.buffer)
    take_priority()
    worker = Worker(config, memory)
    try:
        robot = ControllerStream(config)
        robot.start_guard()
        robot.set_load(config.payload_kg, list(config.payload_cog_m))
    except Refused as refused:
        worker.refuse(refused)
        os._exit(1)
    os._exit(worker.run(robot))


if __name__ == "__main__":
    main()
