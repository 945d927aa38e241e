"""Decides in each pass of the worker whether to send, brake, stop or leave; a pure function of sample and command."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np

from weldcal.models.arrays import Array
from weldcal.systems.drivers.ur.faults import Fault, reported_as
from weldcal.systems.drivers.ur.set_points import apart

NORMAL, REDUCED, PROTECTIVE, RECOVERY, SAFEGUARD = 1, 2, 3, 4, 5
SYSTEM_EMERGENCY, ROBOT_EMERGENCY = 6, 7
RUNNING = 7
STOPPING, STOPPED, PLAYING, PAUSING, PAUSED = range(5)
MODES = range(-1, 100)  # of robot, safety and program; PolyScope has some fifteen of each, from -1 on
POSE_M = 5e-5  # what the pre-flight demands at rest (docs/hardware.md, flange pose)
# states that the guard script writes into its output register
OBEYING, STALE_REGISTER = 1, 2
MADE_UP_FOR_S = 0.03  # of the cell's time
# of the controller's time: the guard shows a pass in every frame
GUARD_SILENT_S = 0.08
# The guard writes its number and the output in the same frame. A terminal may follow 5 frames later, and number and
# output may be of two packages, 2 frames apart: after 10 frames an output that is on without being asked for is
# somebody else's.
OUTPUT_ON_S = 0.020
# The guard itself turns the output off where it waits for a number, and after 20 frames says so: somebody else's after
# 25.
OUTPUT_OFF_S = 0.050
# The guard writes the analog outputs in every frame, too.
SET_POINT_S = 0.050
# An arc that is reported while nothing asks for the torch: its input may follow the torch's end by ARC_ENDS_S.
ARC_ENDS_S, ARC_ON_S = 1.0, 0.010
PATIENCE_S, HELD_S = 5.0, 0.010  # in lockstep: of the host's time, of the controller's
FOLLOWING_PATIENCE_S = 30.0  # where the cell waits for the controller too: no time of the host decides
COMMAND_S, BLIND_COMMANDS = 0.004, 25  # period of the cell's commands, of its time; 0.1 s without a state


_SILENCES = ("stale_s", "stale_process_s", "late_s", "lost_s", "deaf_s", "behind_s")
"""The limits of how long host or controller may be silent."""


class Action(IntEnum):
    """The action of a worker pass."""

    SEND = 0  # send the commanded velocity
    BRAKE = 1  # send zero velocity with the braking acceleration through the same stream
    STOP = 2  # send nothing more; the program is stopped through the dashboard
    LEAVE = 3  # the link is unreliable: leave at once; the controller's watchdogs stop the arm


ACTIONS = {
    **dict.fromkeys((Fault.LINK_STALE, Fault.LINK_CLOSED, Fault.CONTROLLER_DEAF, Fault.CLOCK_JUMPED), Action.LEAVE),
    Fault.STATE_IMPLAUSIBLE: Action.LEAVE,
    Fault.STATE_DAMAGED: Action.LEAVE,
    Fault.STATE_NOT_FINITE: Action.LEAVE,
    **{fault: Action.BRAKE for fault in Fault if Fault.COMMAND_LATE <= fault < Fault.PROTECTIVE_STOP},
    **{fault: Action.STOP for fault in Fault if fault >= Fault.PROTECTIVE_STOP},
    Fault.ARC_FAULT: Action.BRAKE,
    Fault.ARC_INPUT: Action.BRAKE,
    Fault.SET_POINT: Action.BRAKE,
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Limits:
    """The limits for commands and state. (6,) in rad, rad/s, rad/s^2; times in s of the host."""

    position_lower: Array
    position_upper: Array
    speed: Array
    acceleration: Array
    stale_s: float = 0.080  # the arm has been slowed to rest since 0.05 s
    stale_process_s: float = 0.040
    late_s: float = 0.050
    lost_s: float = 0.5  # the arm is at rest since late_s
    deaf_s: float = 0.200  # later than the guard, which latches after 150 ms without a number
    # States that come so long after the commands that they answer, for so long: no gap shows that a connection has
    # become slow. The guard waits 150 ms for a number, and one that reaches it 120 ms late is no fault: that is 40 ms
    # above behind_s.
    behind_s: float = 0.080
    behind_for_s: float = 0.100
    jump_s: float = 0.5
    braking: float = 5.0
    tracking_rad: float = 0.01
    pace: float = 1.0
    position_margin: float = 0.02
    # a moving command that is older is not sent again; in lockstep the controller waits for the next
    hold_s: float = np.inf
    # commands that may be given while the robot's time stands still, where the cell follows it
    blind_commands: float = np.inf

    @property
    def waits(self) -> bool:
        """Whether the controller waits for this computer."""
        return bool(np.isfinite(self.hold_s))

    def slowed(self, pace: float) -> Limits:
        """Return the same limits where the controller runs at `pace` seconds per host second."""
        times: dict[str, Any] = {name: getattr(self, name) / pace for name in (*_SILENCES, "behind_for_s")}
        return replace(self, pace=pace, **times)

    def in_lockstep(self, patience_s: float = PATIENCE_S, held_s: float = HELD_S) -> Limits:
        """Return the limits for an emulated controller in lockstep: the arm waits while this computer is late."""
        times: dict[str, Any] = {name: max(getattr(self, name), patience_s) for name in (*_SILENCES, "jump_s")}
        return replace(self, hold_s=held_s / self.pace, **times)

    def following(self) -> Limits:
        """The limits for an emulated controller in lockstep that the cell follows: no time of the host decides."""
        return replace(self.in_lockstep(FOLLOWING_PATIENCE_S, held_s=0.0), blind_commands=BLIND_COMMANDS)

    @property
    def follows(self) -> bool:
        """Whether the cell follows the controller's time."""
        return bool(np.isfinite(self.blind_commands))


@dataclass(frozen=True, eq=False, kw_only=True)
class RobotSample:
    """The newest package; `fresh_at` is the host time at which its timestamp was first received."""

    robot_time: float
    fresh_at: float
    q: Array
    qd: Array
    robot_mode: int
    safety_mode: int
    runtime_state: int
    speed_scaling: float  # the product of the slider's and the limiter's
    guard: int
    connected: bool
    not_finite: str = ""  # an output of a package that arrived since the last sample, which was dropped
    pose_error_m: float = 0.0
    unheard_s: float = 0.0  # time for which the guard script has read no newer command
    lost_s: float = 0.0  # time for which the guard script has kept the arm from moving, since its start
    guard_silent_s: float = 0.0  # of the controller's time, since the newest pass of the guard script
    process_on: bool | None = None  # the process output; None where none is wired
    process_asked: bool = False  # whether the newest number that the guard script has read asks for it
    arc: bool | None = None  # established; None where the input is not wired
    arc_fault: bool = False  # the power source reports a fault
    # of each set point: what the guard script gives its analog output, and what the output shows
    set_points: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class VelocityCommand:
    """The newest velocity command of the cell; `given_at` is host time."""

    number: int = 0
    given_at: float = -np.inf
    qd: Array = field(default_factory=lambda: np.zeros(6))
    stop: bool = False
    orphaned: bool = False  # the cell's process has ended
    process: bool = False  # the process output is enabled
    armed: bool = False  # the set points of the power source are given
    shares: Array = field(default_factory=lambda: np.full(2, np.nan))  # of analog outputs 0 and 1, see Given
    scale: float = 1.0  # of the velocity while the command is late

    @property
    def scaled_qd(self) -> Array:
        """The velocity (6,) rad/s that is sent."""
        return np.asarray(self.scale * self.qd)


@dataclass(frozen=True)
class Decision:
    """The action, and the fault that caused it."""

    action: Action
    fault: Fault = Fault.NONE
    detail: float = 0.0


class Supervisor:
    """Checks every pass; the first fault is latched."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._last: RobotSample | None = None
        self._command = VelocityCommand()
        self._stepped_at = 0.0
        self._reference: Array | None = None
        self._referred_at = 0.0
        self._lost_s = 0.0
        self._slow_since: float | None = None
        self._behind_since: float | None = None
        self._asked, self._asked_at = False, -np.inf
        self._off_since: float | None = None
        self._apart_since: float | None = None
        self._posed_off_at: float | None = None
        self._arc_ends_at, self._arc_since = -np.inf, np.inf
        self._seen_time, self._seen_number = -np.inf, 0
        self.latched = Decision(Action.SEND)

    def step(self, now: float, robot: RobotSample, command: VelocityCommand) -> Decision:
        """Compute the decision of this pass. `now` is host time, s."""
        if robot.robot_time != self._seen_time:
            self._seen_time, self._seen_number = robot.robot_time, command.number
        if self.latched.fault is Fault.NONE:
            fault, detail = self._look(now, robot, command)
            if fault is not Fault.NONE:
                self.latched = Decision(ACTIONS[fault], fault, detail)
        elif self.latched.action is not Action.LEAVE:
            # a link failure during braking overrides the latched fault
            fault, detail = self._link(now, robot, command)
            if fault is not Fault.NONE:
                self.latched = Decision(Action.LEAVE, self.latched.fault, self.latched.detail)
        self._last, self._command, self._stepped_at = robot, command, now
        if self.latched.fault is Fault.NONE and (command.stop or command.orphaned):
            return Decision(Action.BRAKE)
        return self.latched

    def excuse(self) -> None:
        """Forget where the commands lead: for some time none was sent, and the guard has slowed the arm."""
        self._reference = None

    def _look(self, now: float, robot: RobotSample, command: VelocityCommand) -> tuple[Fault, float]:
        for look in (self._link(now, robot, command), self._safety(robot), self._program(robot), self._output(robot)):
            if look[0] is not Fault.NONE:
                return look
        if (found := self._set_points(robot)) is not None:
            return Fault.SET_POINT, found
        if robot.arc_fault and (command.process or robot.process_asked):
            return Fault.ARC_FAULT, 0.0
        if self._arc_unasked(robot):
            return Fault.ARC_INPUT, 0.0
        return self._motion(now, robot, command)

    def _link(self, now: float, robot: RobotSample, command: VelocityCommand) -> tuple[Fault, float]:
        limits, last = self._limits, self._last
        if not robot.connected:
            return Fault.LINK_CLOSED, 0.0
        if robot.not_finite:
            return Fault.STATE_NOT_FINITE, reported_as(robot.not_finite)
        if now - robot.fresh_at > (limits.stale_process_s if self._command.process else limits.stale_s):
            return Fault.LINK_STALE, 1e3 * (now - robot.fresh_at)
        if (blind := command.number - self._seen_number) > limits.blind_commands:
            return Fault.LINK_STALE, 1e3 * COMMAND_S * blind
        for mode in (robot.robot_mode, robot.safety_mode, robot.runtime_state):
            if mode not in MODES:
                return Fault.STATE_DAMAGED, float(mode)
        if last is not None and robot.robot_time != last.robot_time:
            passed = robot.robot_time - last.robot_time
            expected = limits.pace * (robot.fresh_at - last.fresh_at)
            if passed < 0.0 or abs(passed - expected) > limits.jump_s:
                return Fault.CLOCK_JUMPED, passed - expected
            jump = float(np.abs(robot.q - last.q).max())
            if not np.isfinite(robot.q).all() or jump > 4.0 * max(passed, 0.004):
                return Fault.STATE_IMPLAUSIBLE, jump
        return Fault.NONE, 0.0

    @staticmethod
    def _safety(robot: RobotSample) -> tuple[Fault, float]:
        mode = robot.safety_mode
        if mode in (NORMAL, REDUCED):
            if robot.robot_mode != RUNNING:
                return Fault.ROBOT_NOT_RUNNING, float(robot.robot_mode)
            return Fault.NONE, 0.0
        named = {
            PROTECTIVE: Fault.PROTECTIVE_STOP,
            RECOVERY: Fault.RECOVERY_MODE,
            SAFEGUARD: Fault.SAFEGUARD_STOP,
            SYSTEM_EMERGENCY: Fault.EMERGENCY_STOP,
            ROBOT_EMERGENCY: Fault.EMERGENCY_STOP,
        }
        return named.get(mode, Fault.SAFETY_VIOLATION), float(mode)

    @staticmethod
    def _program(robot: RobotSample) -> tuple[Fault, float]:
        if robot.runtime_state in (PAUSING, PAUSED):
            return Fault.PROGRAM_PAUSED, 0.0
        if robot.runtime_state != PLAYING:
            return Fault.PROGRAM_STOPPED, float(robot.runtime_state)
        if robot.guard != OBEYING:
            return Fault.GUARD_LATCHED, float(robot.guard)
        return Fault.NONE, 0.0

    def _output(self, robot: RobotSample) -> tuple[Fault, float]:
        """Compare the process output with what the guard script was asked for; both are of one package."""
        if robot.process_on is None:
            return Fault.NONE, 0.0
        if robot.process_asked != self._asked or self._last is None:
            self._asked, self._asked_at = robot.process_asked, robot.robot_time
        if robot.process_on and not self._asked and robot.robot_time - self._asked_at > OUTPUT_ON_S:
            return Fault.PROCESS_OUTPUT, 1.0
        if robot.process_on or not self._asked:
            self._off_since = None
        else:
            self._off_since = robot.robot_time if self._off_since is None else self._off_since
            if robot.robot_time - self._off_since > OUTPUT_OFF_S:
                return Fault.PROCESS_OUTPUT, 0.0
        return Fault.NONE, 0.0

    def _set_points(self, robot: RobotSample) -> float | None:
        """Return the share (%) that an analog output shows in place of what the guard gives it, of one package.

        None: as it should.
        """
        wrong = [shown for asked, shown in robot.set_points if apart(asked, shown)]
        if not wrong:
            self._apart_since = None
            return None
        self._apart_since = robot.robot_time if self._apart_since is None else self._apart_since
        return 100.0 * wrong[0] if robot.robot_time - self._apart_since > SET_POINT_S else None

    def _arc_unasked(self, robot: RobotSample) -> bool:
        """Return whether an arc is reported that nothing asks for.

        The input sticks or is noisy, or somebody else burns the torch.
        """
        if robot.arc is None or robot.process_on is None:
            return False
        if robot.process_asked or robot.process_on:
            self._arc_since, self._arc_ends_at = np.inf, robot.robot_time + ARC_ENDS_S
            return False
        if not robot.arc:
            self._arc_since, self._arc_ends_at = np.inf, -np.inf  # it has ended, and does not come back by itself
            return False
        self._arc_since = min(self._arc_since, robot.robot_time)
        return robot.robot_time > self._arc_ends_at and robot.robot_time - self._arc_since >= ARC_ON_S

    def _motion(self, now: float, robot: RobotSample, command: VelocityCommand) -> tuple[Fault, float]:
        limits = self._limits
        if robot.unheard_s > limits.deaf_s:
            return Fault.CONTROLLER_DEAF, 1e3 * robot.unheard_s
        behind = robot.unheard_s > limits.behind_s
        self._behind_since = (self._behind_since or now) if behind else None
        if self._behind_since is not None and now - self._behind_since > limits.behind_for_s:
            return Fault.LINK_STALE, 1e3 * robot.unheard_s
        if robot.guard_silent_s > GUARD_SILENT_S:
            return Fault.CONTROLLER_DEAF, 1e3 * robot.guard_silent_s
        # only of an arm that is to move: the scaling may ramp up when a program starts
        slow = robot.speed_scaling < 0.99 and bool(command.qd.any())
        self._slow_since = (self._slow_since or now) if slow else None
        if self._slow_since is not None and now - self._slow_since > limits.late_s:
            return Fault.SPEED_SLIDER, 100.0 * robot.speed_scaling
        if robot.pose_error_m <= POSE_M:
            self._posed_off_at = None
        elif self._posed_off_at is None:  # one state alone may be a byte that was damaged on the way
            self._posed_off_at = robot.robot_time
        elif robot.robot_time != self._posed_off_at:
            return Fault.POSE_MISMATCH, 1e3 * robot.pose_error_m
        if not np.isfinite(command.qd).all():
            return Fault.COMMAND_NOT_FINITE, 0.0
        share = np.abs(command.qd) / limits.speed
        if share.max() > 1.0 + 1e-9:
            return Fault.COMMAND_TOO_FAST, float(np.abs(command.qd)[int(np.argmax(share))])
        late = now - command.given_at
        # a late command slows the arm to rest within late_s; a torch may not burn there, and may not come on again by
        # itself
        longest = limits.late_s if command.process else limits.lost_s
        if (command.process or command.qd.any()) and late > longest and not (command.stop or command.orphaned):
            return Fault.COMMAND_LATE, 1e3 * late
        if command.number != self._command.number:
            # a cell catches up after a delay of up to 20 ms and restarts its clock after a longer one; passes may skip
            # commands
            passed = limits.pace * max(command.given_at - self._command.given_at, 0.0)
            if passed > MADE_UP_FOR_S:
                passed = limits.pace * (now - self._stepped_at)
            jump = np.abs(command.scaled_qd - self._command.scaled_qd)
            if (jump > limits.acceleration * (passed + 0.02)).any():
                return Fault.COMMAND_JUMPED, float(jump.max())
        qd = command.scaled_qd
        ahead = robot.q + qd * np.abs(qd) / (2.0 * limits.braking) + 0.05 * qd
        outside = (ahead > limits.position_upper - limits.position_margin) & (qd > 0.0)
        outside |= (ahead < limits.position_lower + limits.position_margin) & (qd < 0.0)
        if outside.any():
            return Fault.JOINT_LIMIT, float(np.argmax(outside) + 1)
        return self._tracking(now, robot, command)

    def _tracking(self, now: float, robot: RobotSample, command: VelocityCommand) -> tuple[Fault, float]:
        """Check the arm's position against the integral of the recent commands, which decays in half a second."""
        limits = self._limits
        if self._reference is None:
            self._reference, self._referred_at = robot.q.copy(), robot.robot_time
        # of the robot's time: an arm moves in its controller's frames
        dt = min(max(robot.robot_time - self._referred_at, 0.0), 0.1)
        kept_s = min(max(robot.lost_s - self._lost_s, 0.0), 0.1)  # the guard slows the arm where numbers come late
        self._referred_at, self._lost_s = robot.robot_time, robot.lost_s
        led = (dt - kept_s) * self._command.scaled_qd
        self._reference = self._reference + led + (robot.q - self._reference) * min(dt / 0.5, 1.0)
        apart = float(np.abs(self._reference - robot.q).max())
        # commands and state together have up to 40 ms of delay; the arm may still have the speed of before the scaling
        allowed = limits.tracking_rad + 0.04 * float(np.abs(command.qd).max())
        return (Fault.TRACKING, apart) if apart > allowed else (Fault.NONE, 0.0)
