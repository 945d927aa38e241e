"""JobSequencer: the state machine of the weld job: home, calibrate, verify, scan, plan, approach, weld, retract, hold."""

import dataclasses as dc
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.systems.jobs.weld.calibration_pose_planner import NextPose
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import CalibrationStatus, JobCommand, Message, PlannedSeam, UrStatus
from weldcal.systems.motion.clear_moves import stands_at
from weldcal.systems.motion.drift_monitor import DriftStatus

SCAN_TIMEOUT_S = 8.0


@dc.dataclass(frozen=True, kw_only=True)
class JobPlan:
    """Parameters of the job (mm where a reason text shows them)."""

    calibrate: bool
    weld: bool
    q_home: NDArray[np.float64]
    maximum_scans: int
    verification_scans: int
    verification_limit_m: float
    required_error_m: float
    minimum_scans: int = 0
    dwell_s: float = 0.3
    scan_timeout_s: float = SCAN_TIMEOUT_S
    move_timeout_s: float = 20.0
    maximum_time_s: float = 240.0
    seams: int = 1


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Seen(Message):
    """Inputs of the sequencer at one tick."""

    time: float
    robot: UrStatus
    settled_goal: int
    q: NDArray[np.float64]
    next_pose: NextPose
    calibration: CalibrationStatus
    seam: PlannedSeam
    servo: ServoReport
    hold_requested: bool = False
    arm_stopped: bool = False
    drift: DriftStatus = dc.field(default_factory=DriftStatus)


@dc.dataclass(frozen=True, eq=False)
class JobState(Message):
    """The present command, the start time of its phase, the log of all phases, and warnings: sentences that hold nothing."""

    command: JobCommand = dc.field(default_factory=JobCommand)
    since: float = 0.0
    settled_since: float | None = None
    log: tuple[tuple[float, str], ...] = ((0.0, "start"),)
    warnings: tuple[str, ...] = ()


def _enter(state: JobState, seen: Seen, phase: str, **changes: Any) -> JobState:
    command = dc.replace(state.command, phase=phase, **changes)
    return JobState(command, seen.time, None, (*state.log, (seen.time, phase)), state.warnings)


def _move(state: JobState, seen: Seen, phase: str, q_goal: NDArray[np.float64]) -> JobState:
    return _enter(state, seen, phase, mode="move", goal_id=state.command.goal_id + 1, q_goal=q_goal)


def _scan(state: JobState, seen: Seen, phase: str, purpose: str, label: str) -> JobState:
    return _enter(
        state,
        seen,
        phase,
        mode="hold",
        scan_sequence=state.command.scan_sequence + 1,
        scan_purpose=purpose,
        scan_label=label,
    )


def hold(state: JobState, seen: Seen, reason: str) -> JobState:
    """Turn the process off and stop the arm, latched; only a reset by a person ends this state."""
    return _enter(
        state, seen, "held", mode="hold", process_on=False, streaming=False, held=True, finished=True, reason=reason
    )


def _arrived(state: JobState, seen: Seen, plan: JobPlan) -> tuple[JobState, bool]:
    """Whether the arm has settled at the goal for the dwell time; holds the job on a timeout."""
    if seen.time - state.since > plan.move_timeout_s:
        return hold(state, seen, f"The arm did not come to rest at its goal within {plan.move_timeout_s:.0f} s."), False
    if seen.settled_goal != state.command.goal_id:
        return dc.replace(state, settled_since=None), False
    since = seen.time if state.settled_since is None else state.settled_since
    return dc.replace(state, settled_since=since), seen.time - since >= plan.dwell_s


def _start(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    if not stands_at(seen.q, plan.q_home):
        return _move(state, seen, "move_home", plan.q_home)
    return _begin(state, seen, plan)


def _at_home(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    state, there = _arrived(state, seen, plan)
    return _begin(state, seen, plan) if there else state


def _begin(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    if plan.calibrate:
        return _to_next_pose(state, seen, "move_to_verification_cloud")
    return _move(state, seen, "park", plan.q_home)


def _to_next_pose(state: JobState, seen: Seen, phase: str) -> JobState:
    if seen.next_pose.after_sequence < seen.calibration.sequence:
        return state  # the planner has not processed the newest status yet
    if seen.next_pose.q is None:
        refused = seen.calibration.refused
        why = f" Scans that could not be used: {len(refused)}. The last one: {refused[-1][1]}" if refused else ""
        return hold(
            state,
            seen,
            f"The planned calibration poses are used up: plan more of them or free more of the workspace.{why}",
        )
    return _move(state, seen, phase, seen.next_pose.q)


def _arrive_and_scan(purpose: str, phase: str) -> Callable[[JobState, Seen, JobPlan], JobState]:
    def step(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
        state, there = _arrived(state, seen, plan)
        if there:
            return _scan(state, seen, phase, purpose, seen.next_pose.label)
        return state

    return step


def _digested(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    """Continue after each calibration scan: more poses, verification, or hold where the required error is not reached."""
    status = seen.calibration
    if status.sequence < state.command.scan_sequence:
        if seen.time - state.since > plan.scan_timeout_s:
            return hold(
                state, seen, f"No scan arrived within {plan.scan_timeout_s:.0f} s of its trigger. Look at the scanner."
            )
        return state
    if status.done:
        return _to_next_pose(state, seen, "move_to_verify")
    if status.calibration_scans >= plan.maximum_scans:
        return hold(state, seen, unreached_reason(status, plan))
    return _to_next_pose(state, seen, "move_to_pose")


def unreached_reason(status: CalibrationStatus, plan: JobPlan) -> str:
    """Why the calibration ended without the required error."""
    required = plan.required_error_m * 1e3
    if status.estimate is None:
        why = status.refused[-1][1] if status.refused else status.message
        return f"No calibration after {status.calibration_scans} scans: {why}"
    if status.predicted_error_m <= plan.required_error_m:  # so that the scans are too few
        return (
            f"Only {len(status.observations)} of {status.calibration_scans} scans could be used, and the calibration needs "
            f"{plan.minimum_scans} (it expects {status.predicted_error_m * 1e3:.3f} mm at the work point, within the required "
            f"{required:.3f} mm); allow more scans, or a pose from which the scanner sees the feature."
        )
    return (
        f"The calibration did not reach the required {required:.3f} mm: after {status.calibration_scans} scans it expects "
        f"{status.predicted_error_m * 1e3:.3f} mm at the work point; allow more scans, a wider workspace or a better scanner."
    )


def _verified(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    status = seen.calibration
    if status.sequence < state.command.scan_sequence:
        if seen.time - state.since > plan.scan_timeout_s:
            return hold(
                state, seen, f"No scan arrived within {plan.scan_timeout_s:.0f} s of its trigger. Look at the scanner."
            )
        return state
    if len(status.verifications) < plan.verification_scans:
        return _to_next_pose(state, seen, "move_to_verify")
    worst = max(status.verifications, key=lambda v: v.error_m)
    if worst.error_m > plan.verification_limit_m:
        limit = plan.verification_limit_m * 1e3
        return hold(
            state,
            seen,
            f"The calibration is {worst.error_m * 1e3:.2f} mm off at the held-out pose '{worst.label}' (limit {limit:.2f} mm).",
        )
    return _move(state, seen, "park", plan.q_home)


def _parked(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    state, there = _arrived(state, seen, plan)
    if not there:
        return state
    if not plan.weld:
        return _enter(state, seen, "done", mode="hold", finished=True)
    return _scan(state, seen, "scan_workpiece", "workpiece", "workpiece")


def _planned(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    if seen.seam.sequence < state.command.scan_sequence:
        if seen.time - state.since > plan.scan_timeout_s:
            return hold(
                state,
                seen,
                f"No workpiece scan arrived within {plan.scan_timeout_s:.0f} s of its trigger. Look at the scanner.",
            )
        return state
    if seen.seam.seam is None or seen.seam.q_above is None or seen.seam.q_start is None:
        return hold(state, seen, seen.seam.reason or "No seam could be planned.")
    return _move(state, seen, "approach_above", seen.seam.q_above)


def _above(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    state, there = _arrived(state, seen, plan)
    if there and seen.seam.q_start is not None:
        return dc.replace(_move(state, seen, "approach", seen.seam.q_start))
    return state


def _approached(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    if not state.command.streaming:
        state = dc.replace(state, command=dc.replace(state.command, streaming=True))
    state, there = _arrived(state, seen, plan)
    return _enter(state, seen, "weld", mode="weld", process_on=True) if there else state


def _welding(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    if seen.servo.phase == "FAULT":
        return hold(state, seen, seen.servo.reason or "The welding servo stopped.")
    if seen.arm_stopped:
        return hold(
            state, seen, "The arm came too near to a singular position during the weld; move the workpiece or the seam."
        )
    if seen.servo.phase == "DONE" and seen.seam.q_retract is not None:
        return _move(
            dc.replace(state, command=dc.replace(state.command, process_on=False, streaming=False)),
            seen,
            "retract",
            seen.seam.q_retract,
        )
    return state


def _retracted(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    state, there = _arrived(state, seen, plan)
    if not there:
        return state
    number = state.command.seam + 1
    if number < plan.seams:
        # The part is scanned again, for the seam that was welded may have moved it.
        return _move(dc.replace(state, command=dc.replace(state.command, seam=number)), seen, "park", plan.q_home)
    return _move(state, seen, "home", plan.q_home)


def _home(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    state, there = _arrived(state, seen, plan)
    return _enter(state, seen, "done", mode="hold", finished=True) if there else state


PHASES: dict[str, Callable[[JobState, Seen, JobPlan], JobState]] = {
    "start": _start,
    "move_home": _at_home,
    "move_to_verification_cloud": _arrive_and_scan("verification_cloud", "scan_verification_cloud"),
    "scan_verification_cloud": _digested,
    "move_to_pose": _arrive_and_scan("calibrate", "scan_pose"),
    "scan_pose": _digested,
    "move_to_verify": _arrive_and_scan("verify", "scan_verify"),
    "scan_verify": _verified,
    "park": _parked,
    "scan_workpiece": _planned,
    "approach_above": _above,
    "approach": _approached,
    "weld": _welding,
    "retract": _retracted,
    "home": _home,
}


WATCHED = ("move_to_verify", "park", "approach_above", "approach", "weld", "retract", "home")
"""Phases in which the scanner streams, if it can: its calibration is done, and no scan is wanted."""
WELDED = ("weld", "retract", "home")
"""Phases in which a scanner that has moved is a warning: nothing that follows depends on its pose."""


def next_job_state(state: JobState, seen: Seen, plan: JobPlan) -> JobState:
    """Compute the state after one tick; `held` and `done` are final."""
    if state.command.finished:
        return state
    if not seen.robot.ready:
        return hold(state, seen, seen.robot.fault or f"The robot stopped: {seen.robot.safety_mode}.")
    if seen.hold_requested:
        return hold(state, seen, f"A person ended the job, in the phase '{state.command.phase}'.")
    if seen.time > plan.maximum_time_s:
        return hold(
            state,
            seen,
            f"The job took longer than its {plan.maximum_time_s:.0f} s, in the phase '{state.command.phase}'.",
        )
    if seen.drift.moved:
        if state.command.phase not in WELDED:
            return hold(state, seen, seen.drift.summary)
        state = _warned(state, seen.drift)
    return PHASES[state.command.phase](state, seen, plan)


def _warned(state: JobState, drift: DriftStatus) -> JobState:
    """The state with the drift among its warnings: once as an alarm, once measured. A seam is finished: the tip feels it."""
    known = drift.summary
    return state if not known or known in state.warnings else dc.replace(state, warnings=(*state.warnings, known))


class JobSequencer(LeafSystem):
    """The state machine of the cell.

    .. pydrake_system::

        name: JobSequencer
        input_ports:
        - robot_status
        - settled_goal
        - position_measured
        - next_pose
        - calibration_status
        - planned_seam
        - servo_report
        - hold
        - arm_stopped
        - drift
        output_ports:
        - job
        - job_state
        - scan_trigger
        - streaming
        - scanner_streaming

    `drift` (may stay open) carries the DriftMonitor's status: a scanner that has moved holds the job before the weld and is a
    warning from then on. `hold` (1) is the operator's stop request; `arm_stopped` (1) of the ProcessSwitch is 1 after the guard stopped a weld.
    `job` carries the `JobCommand`, `job_state` the whole
    `JobState` with its log; `scan_trigger` and `streaming` (1) go to the station, and so does `scanner_streaming` (1) where
    the scanner streams: after the calibration it does, except while it scans.
    """

    def __init__(self, plan: JobPlan, period_s: float = 0.02) -> None:
        super().__init__()
        self._plan = plan
        self._robot = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._settled = self.DeclareVectorInputPort("settled_goal", 1)
        self._q = self.DeclareVectorInputPort("position_measured", 6)
        self._next = self.DeclareAbstractInputPort("next_pose", AbstractValue.Make(NextPose()))
        self._calibration = self.DeclareAbstractInputPort("calibration_status", AbstractValue.Make(CalibrationStatus()))
        self._seam = self.DeclareAbstractInputPort("planned_seam", AbstractValue.Make(PlannedSeam()))
        self._servo = self.DeclareAbstractInputPort("servo_report", AbstractValue.Make(ServoReport()))
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._arm_stopped = self.DeclareVectorInputPort("arm_stopped", 1)
        self._drift = self.DeclareAbstractInputPort("drift", AbstractValue.Make(DriftStatus()))
        self._state = self.DeclareAbstractState(AbstractValue.Make(JobState()))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort("job", lambda: AbstractValue.Make(JobCommand()), self._job_out, ticket)
        self.DeclareAbstractOutputPort("job_state", lambda: AbstractValue.Make(JobState()), self._state_out, ticket)
        self.DeclareVectorOutputPort("scan_trigger", 1, self._trigger_out, ticket)
        self.DeclareVectorOutputPort("streaming", 1, self._streaming_out, ticket)
        self.DeclareVectorOutputPort("scanner_streaming", 1, self._watching_out, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def job_state(self, context: Context) -> JobState:
        """The job's state in this system's context."""
        state: JobState = context.get_abstract_state(self._state).get_value()
        return state

    def _update(self, context: Context, state: State) -> None:
        seen = Seen(
            time=context.get_time(),
            robot=self._robot.Eval(context),
            settled_goal=int(self._settled.Eval(context)[0]),
            q=self._q.Eval(context),
            next_pose=self._next.Eval(context),
            calibration=self._calibration.Eval(context),
            seam=self._seam.Eval(context),
            servo=self._servo.Eval(context),
            hold_requested=bool(self._hold.Eval(context)[0] > 0.5),
            arm_stopped=bool(self._arm_stopped.Eval(context)[0] > 0.5),
            drift=self._drift.Eval(context) if self._drift.HasValue(context) else DriftStatus(),
        )
        old = self.job_state(context)
        new = next_job_state(old, seen, self._plan)
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)

    def _job_out(self, context: Context, output: Any) -> None:
        output.set_value(self.job_state(context).command)

    def _state_out(self, context: Context, output: Any) -> None:
        output.set_value(self.job_state(context))

    def _trigger_out(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self.job_state(context).command.scan_sequence))

    def _streaming_out(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self.job_state(context).command.streaming))

    def _watching_out(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self.job_state(context).command.phase in WATCHED))
