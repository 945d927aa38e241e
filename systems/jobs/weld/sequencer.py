"""JobSequencer: the state machine of the weld job.

Home, calibrate, verify, scan, plan, approach, weld, retract, hold.
"""

import dataclasses as dc
from collections.abc import Callable
from typing import Any, ClassVar

from weldcal.models.arrays import Array
from weldcal.systems.jobs.procedure import Inputs, Procedure, ProcedureState
from weldcal.systems.jobs.weld.iterative_calibrator import PoseRequest
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import CalibrationStatus, JobCommand, PlannedSeam
from weldcal.systems.motion.clear_moves import stands_at
from weldcal.systems.motion.drift_monitor import DriftStatus

NOT_HOME = (
    "The arm may still be at the broken seam, and its way home past the part is not checked: move it to home_deg with"
    " the pendant, then resume the weld again."
)
SCAN_TIMEOUT_S = 8.0  # above a scanner driver's own limit of 6 s (scan_timeout_s), which names the device's fault first
WELDED = ("weld", "retract", "interpass", "plan_pass", "plan_seam", "home")
"""Phases in which a scanner that has moved is a warning: nothing that follows depends on its pose."""
WATCHED = ("move_to_verify", "park", "approach_above", "approach", *WELDED)
"""Phases in which the scanner streams, if it can: its calibration is done, and no scan is wanted."""


@dc.dataclass(frozen=True, kw_only=True)
class JobPlan:
    """Parameters of the job (mm where a reason text shows them)."""

    calibrate: bool
    weld: bool
    q_home: Array
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
    order: tuple[int, ...] = ()  # their numbers, from 0, in the order of welding; empty: as listed
    direct: bool = False  # to the next seam without a new scan, and without home where the way is free
    unfelt: tuple[int, ...] = ()  # seams that only the scan locates: each is scanned again
    interpass_s: tuple[float, ...] = ()  # of each pass after the root
    scan_poses: tuple[Array, ...] = ()  # (6,) rad, from which the workpiece is scanned; empty: from home
    first: tuple[int, int] | None = None  # seam and piece with which a broken weld goes on; None: a new weld


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class JobState(ProcedureState):
    """State of the sequencer.

    Attributes:
        purpose: of the newest scan: calibrate, verify or workpiece.
        label: of the newest scan.
        streaming: the finger camera streams.
        process_on: the process is enabled.
        view: number of the newest scan of the workpiece, from 0.
        seam: number of the seam that is planned and welded, from 0; piece: of that seam's pieces.
        weld_pass: number of its pass, 0: the root; arc_out_s: when the arc of the last one went out.
        log: start time, s, and name of every phase.
        warnings: sentences that hold nothing.
        question: what the operator must answer now.
    """

    purpose: str = ""
    label: str = ""
    streaming: bool = False
    process_on: bool = False
    seam: int = 0
    view: int = 0
    piece: int = 0
    weld_pass: int = 0
    arc_out_s: float = 0.0
    log: tuple[tuple[float, str], ...] = ((0.0, "start"),)
    warnings: tuple[str, ...] = ()
    question: str = ""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class JobInputs(Inputs):
    """Inputs of the sequencer at one tick."""

    next_pose: PoseRequest
    calibration_status: CalibrationStatus
    planned_seam: PlannedSeam
    servo_report: ServoReport
    arm_stopped: float = 0.0
    drift: DriftStatus = dc.field(default_factory=DriftStatus)
    answered: float = 0.0


def unreached_reason(status: CalibrationStatus, plan: JobPlan) -> str:
    """Why the calibration ended without the required error."""
    required = plan.required_error_m * 1e3
    if status.estimate is None:
        why = status.refused[-1][1] if status.refused else status.message
        return f"No calibration after {status.calibration_scans} scans: {why}"
    if status.predicted_error_m <= plan.required_error_m:  # so that the scans are too few
        return (
            f"Only {len(status.observations)} of {status.calibration_scans} scans could be used, and the calibration"
            f" needs {plan.minimum_scans} (it expects {status.predicted_error_m * 1e3:.3f} mm at the work point, within"
            f" the required {required:.3f} mm); allow more scans, or a pose from which the scanner sees the feature."
        )
    return (
        f"The calibration did not reach the required {required:.3f} mm: after {status.calibration_scans} scans it"
        f" expects {status.predicted_error_m * 1e3:.3f} mm at the work point; allow more scans"
        " (calibration.maximum_scans), a larger error (calibration.required_error_mm), or use a better scanner."
    )


def _arrive_and_scan(purpose: str, phase: str) -> "Callable[[JobSequencer, JobState, JobInputs], JobState]":
    def step(sequencer: "JobSequencer", s: JobState, now: JobInputs) -> JobState:
        return sequencer.request(s, now, phase, purpose=purpose, label=now.next_pose.label)

    return step


class JobSequencer(Procedure[JobState, JobInputs]):
    """The state machine of the cell.

    .. pydrake_system::

        name: JobSequencer
        input_ports:
        - settled_goal
        - robot_status
        - hold
        - position_measured
        - next_pose
        - calibration_status
        - planned_seam
        - servo_report
        - arm_stopped
        - drift
        - answered
        output_ports:
        - job
        - job_state
        - scan_trigger
        - streaming
        - scanner_streaming

    `drift` (may stay open) carries the DriftMonitor's status: a scanner that has moved holds the job before the weld
    and is a warning from then on. `answered` (1; open: never) is 1 once an operator has answered the plan's question.
    `hold` (1) is the operator's stop request; `arm_stopped` (1) of the ProcessSwitch is
    1 after the guard stopped a weld. `job` carries the `JobCommand`, `job_state` the whole `JobState` with its log;
    `scan_trigger` and `streaming` (1) go to the station, and so does `scanner_streaming` (1) where the scanner streams:
    after the calibration it does, except while it scans.
    """

    inputs = JobInputs
    moves = (
        *("move_home", "move_to_pose", "move_to_verify", "park"),
        *("move_to_scan", "leave_scan", "interpass"),
        *("approach_above", "approach", "retract", "home"),
    )
    driven = ("weld",)
    flags: ClassVar = {"streaming": (), "scanner_streaming": WATCHED}
    state_port, trigger_port = "job_state", "scan_trigger"

    def __init__(self, plan: JobPlan, period_s: float = 0.02) -> None:
        late = "{} arrived within {:.0f} s of its trigger. Look at the scanner."
        no_scan = (plan.scan_timeout_s, late.format("No scan", plan.scan_timeout_s))
        super().__init__(
            JobState(seam=(*plan.order, 0)[0])
            if plan.first is None
            else JobState(seam=plan.first[0], piece=plan.first[1]),
            move_timeout_s=plan.move_timeout_s,
            maximum_time_s=plan.maximum_time_s,
            timeouts={
                **dict.fromkeys(("scan_pose", "scan_verify"), no_scan),
                "scan_workpiece": (
                    plan.scan_timeout_s * max(1, len(plan.scan_poses)),  # the plan from all of them is made in it
                    late.format("No workpiece scan", plan.scan_timeout_s),
                ),
            },
            dwell_s=plan.dwell_s,
            period_s=period_s,
        )
        self._plan = plan
        self.read(
            "drift",
            "answered",
            next_pose=PoseRequest(),
            calibration_status=CalibrationStatus(),
            planned_seam=PlannedSeam(),
            servo_report=ServoReport(),
            arm_stopped=0.0,
            drift=DriftStatus(),
            answered=0.0,
        )

    def begun_at(self, seam: int, piece: int) -> "JobSequencer":
        """Return a sequencer of the same job that begins with a later seam, or piece of one."""
        return JobSequencer(dc.replace(self._plan, first=(seam, piece)))

    def attend(self, s: JobState, now: JobInputs) -> JobState:
        """See Procedure: a scanner that has moved, and the finger camera before the tip touches."""
        if now.drift.moved:
            if s.phase not in WELDED:
                return self.held(s, now, now.drift.summary)
            # once as an alarm, once measured; a seam is finished, for the tip feels it
            if now.drift.summary and now.drift.summary not in s.warnings:
                s = dc.replace(s, warnings=(*s.warnings, now.drift.summary))
        return dc.replace(s, streaming=True) if s.phase == "approach" and not s.streaming else s

    def enter(self, s: JobState, now: JobInputs, phase: str, **changes: Any) -> JobState:
        """See Procedure; with the phase in the log."""
        return super().enter(s, now, phase, log=(*s.log, (now.time, phase)), **changes)

    def command(self, s: JobState, arm: int = 0) -> JobCommand:
        """See Procedure."""
        return dc.replace(
            super().command(s),
            scan_purpose=s.purpose,
            scan_label=s.label,
            streaming=s.streaming and not s.held,
            process_on=s.process_on and not s.held,
            seam=s.seam,
            view=s.view,
            views=max(1, len(self._plan.scan_poses)),
            piece=s.piece,
            question=s.question,
            weld_pass=s.weld_pass,
        )

    def flag(self, name: str, s: JobState) -> bool:
        """See Procedure."""
        return s.streaming and not s.held if name == "streaming" else super().flag(name, s)

    def _start(self, s: JobState, now: JobInputs) -> JobState:
        if not stands_at(now.q, self._plan.q_home):
            if self._plan.first is not None:
                return self.held(s, now, NOT_HOME)
            return self._homeward(s, now, "move_home")
        return self._begin(s, now)

    def _begin(self, s: JobState, now: JobInputs) -> JobState:
        if self._plan.calibrate:
            return self._to_next_pose(s, now, "move_to_pose")
        return self._homeward(s, now, "park")

    def _homeward(self, s: JobState, now: JobInputs, phase: str, **changes: Any) -> JobState:
        return self.go(s, now, phase, self._plan.q_home, **changes)

    def _to_next_pose(self, s: JobState, now: JobInputs, phase: str) -> JobState:
        if now.next_pose.after_sequence < now.calibration_status.sequence:
            return s  # the planner has not processed the newest status yet
        if now.next_pose.q is None:
            refused = now.calibration_status.refused
            why = f" Scans that could not be used: {len(refused)}. The last one: {refused[-1][1]}" if refused else ""
            return self.held(
                s,
                now,
                f"The planned calibration poses are used up: plan more of them or free more of the workspace.{why}",
            )
        return self.go(s, now, phase, now.next_pose.q)

    def _digested(self, s: JobState, now: JobInputs) -> JobState:
        """Continue after each calibration scan.

        More poses, verification, or hold where the required error is not reached.
        """
        status = now.calibration_status
        if status.sequence < s.trigger:
            return s
        if status.done:
            return self._to_next_pose(s, now, "move_to_verify")
        if status.calibration_scans >= self._plan.maximum_scans:
            return self.held(s, now, unreached_reason(status, self._plan))
        return self._to_next_pose(s, now, "move_to_pose")

    def _verified(self, s: JobState, now: JobInputs) -> JobState:
        status, plan = now.calibration_status, self._plan
        if status.sequence < s.trigger:
            return s
        if len(status.verifications) < plan.verification_scans:
            return self._to_next_pose(s, now, "move_to_verify")
        worst = max(status.verifications, key=lambda v: v.error_m)
        if worst.error_m > plan.verification_limit_m:
            limit = plan.verification_limit_m * 1e3
            return self.held(
                s,
                now,
                f"The calibration is {worst.error_m * 1e3:.2f} mm off at the held-out pose '{worst.label}' (limit"
                f" {limit:.2f} mm).",
            )
        return self._homeward(s, now, "park")

    def _parked(self, s: JobState, now: JobInputs) -> JobState:
        if not self._plan.weld:
            return self.enter(s, now, "done")
        return self._scan(s, now) if not self._plan.scan_poses else self._to_view(s, now, 0)

    def _to_view(self, s: JobState, now: JobInputs, view: int) -> JobState:
        return self.go(s, now, "move_to_scan", self._plan.scan_poses[view], view=view)

    def _scan(self, s: JobState, now: JobInputs) -> JobState:
        return self.request(s, now, "scan_workpiece", purpose="workpiece", label="workpiece")

    def _planned(self, s: JobState, now: JobInputs) -> JobState:
        planned = now.planned_seam
        if planned.sequence < s.trigger:
            return s
        if planned.views and s.view + 1 < len(self._plan.scan_poses):
            return self._to_view(s, now, s.view + 1)
        if planned.seam is None or planned.q_above is None or planned.q_start is None:
            return self.held(s, now, planned.reason or "No seam could be planned.")
        if self._plan.scan_poses:
            return self._homeward(s, now, "leave_scan")  # from where the way to the seam is planned
        return self._approach(s, now)

    def _approach(self, s: JobState, now: JobInputs) -> JobState:
        if now.planned_seam.question and now.answered < 0.5:
            return self.enter(s, now, "confirm", question=now.planned_seam.question)
        return self.go(s, now, "approach_above", now.planned_seam.q_above, question="")

    def _confirmed(self, s: JobState, now: JobInputs) -> JobState:
        return s if now.answered < 0.5 else self._approach(s, now)

    def _above(self, s: JobState, now: JobInputs) -> JobState:
        return self.go(s, now, "approach", now.planned_seam.q_start)

    def _approached(self, s: JobState, now: JobInputs) -> JobState:
        return self.enter(s, now, "weld", process_on=True)

    def _welding(self, s: JobState, now: JobInputs) -> JobState:
        if now.servo_report.phase == "FAULT":
            return self.held(s, now, now.servo_report.reason or "The welding servo stopped.")
        if now.arm_stopped > 0.5:
            return self.held(
                s, now, "The arm came too near to a singular position during the weld; move the workpiece or the seam."
            )
        if now.servo_report.phase == "DONE" and now.planned_seam.q_retract is not None:
            return self.go(
                s, now, "retract", now.planned_seam.q_retract, process_on=False, streaming=False, arc_out_s=now.time
            )
        return s

    def _retracted(self, s: JobState, now: JobInputs) -> JobState:
        if now.planned_seam.more:
            return self._onward(s, now, piece=s.piece + 1)
        if s.weld_pass < len(self._plan.interpass_s):
            return self._homeward(s, now, "interpass", weld_pass=s.weld_pass + 1)
        order = self._plan.order or tuple(range(self._plan.seams))
        later = order[order.index(s.seam) + 1 :]
        if not later:
            return self._homeward(s, now, "home")
        return self._onward(s, now, seam=later[0], piece=0, weld_pass=0)

    def _onward(self, s: JobState, now: JobInputs, **changes: int) -> JobState:
        if self._plan.direct and changes.get("seam", s.seam) not in self._plan.unfelt:
            return self.enter(s, now, "plan_seam", **changes)
        # The part is scanned again, for the seam that was welded may have moved it.
        return self._homeward(s, now, "park", **changes)

    def _next_planned(self, s: JobState, now: JobInputs) -> JobState:
        planned = now.planned_seam
        if (planned.number, planned.piece) != (s.seam, s.piece):
            return s
        if planned.seam is None:
            return self.held(s, now, planned.reason or "The next seam could not be planned.")
        return self._approach(s, now) if planned.direct else self._homeward(s, now, "leave_scan")

    def _at_home(self, s: JobState, now: JobInputs) -> JobState:
        return self.enter(s, now, "plan_pass")

    def _pass_planned(self, s: JobState, now: JobInputs) -> JobState:
        planned = now.planned_seam
        if planned.weld_pass != s.weld_pass:
            return s
        if planned.seam is None:
            return self.held(s, now, planned.reason or "The next pass could not be planned.")
        return self._approach(s, now) if now.time - s.arc_out_s >= self._plan.interpass_s[s.weld_pass - 1] else s

    steps: ClassVar = {
        "start": _start,
        "move_home": _begin,
        "move_to_pose": _arrive_and_scan("calibrate", "scan_pose"),
        "scan_pose": _digested,
        "move_to_verify": _arrive_and_scan("verify", "scan_verify"),
        "scan_verify": _verified,
        "park": _parked,
        "move_to_scan": _scan,
        "scan_workpiece": _planned,
        "leave_scan": _approach,
        "confirm": _confirmed,
        "approach_above": _above,
        "approach": _approached,
        "weld": _welding,
        "retract": _retracted,
        "interpass": _at_home,
        "plan_pass": _pass_planned,
        "plan_seam": _next_planned,
        "home": Procedure.end,
    }


PHASES = tuple(JobSequencer.steps)
