"""MotionProcedure: moves the flange between the corners of a cube until enough frames are collected, then asks for the result."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.models.arrays import Array
from weldcal.systems.jobs.motion.messages import MotionCalibration, MotionRecord, MotionState
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, UrStatus

ENDS = ("done", "held")
_BLIND_S = 10.0  # without a single frame that shows the flange


class MotionProcedure(LeafSystem):
    """Runs the procedure; a robot fault, a goal that is not reached, or a scanner that shows nothing holds it with a reason.

    .. pydrake_system::

        name: MotionProcedure
        input_ports:
        - settled_goal
        - robot_status
        - record
        - calibration
        - hold
        output_ports:
        - job
        - streaming
        - state

    A procedure that does not calibrate ends at home, and its port `calibration` stays open. `hold` (1) is the operator's stop
    request. `streaming` (1) turns the scanner on from the first corner to the last.
    """

    def __init__(
        self,
        corners: Sequence[Array],
        q_home: Array,
        frames: int,
        speed_share: float = 1.0,
        timeout_s: float = 60.0,
        maximum_time_s: float = np.inf,
        period_s: float = 0.008,
        calibrates: bool = True,
    ) -> None:
        super().__init__()
        self._corners, self._home, self._frames, self._speed_share = tuple(corners), q_home, frames, speed_share
        self._timeout_s, self._maximum_time_s, self._calibrates = timeout_s, maximum_time_s, calibrates
        self._settled = self.DeclareVectorInputPort("settled_goal", 1)
        self._robot = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._record = self.DeclareAbstractInputPort("record", AbstractValue.Make(MotionRecord()))
        self._calibration = self.DeclareAbstractInputPort("calibration", AbstractValue.Make(MotionCalibration()))
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._state = self.DeclareAbstractState(AbstractValue.Make(MotionState()))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort("job", lambda: AbstractValue.Make(JobCommand()), self._job, ticket)
        self.DeclareVectorOutputPort("streaming", 1, self._streaming, ticket)
        self.DeclareStateOutputPort("state", self._state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        old: MotionState = context.get_abstract_state(self._state).get_value()
        new = self._next(old, context)
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)

    def _next(self, s: MotionState, context: Context) -> MotionState:
        now = context.get_time()
        if s.phase in ENDS:
            return s
        if reason := self._trouble(s, context, now):
            return replace(s, phase="held", since=now, reason=reason)
        if s.phase == "start":
            return _go(s, "approach", self._corners[0], now, corner=0)
        if s.phase == "calibrate":
            found: MotionCalibration = self._calibration.Eval(context)
            if not found.asked:
                return s
            if found.estimate is None:
                return replace(s, phase="held", since=now, reason=found.reason)
            return replace(s, phase="done", since=now)
        if int(self._settled.Eval(context)[0]) != s.goal_id:
            return s
        if s.phase == "home":
            return replace(s, phase="calibrate" if self._calibrates else "done", since=now)
        record: MotionRecord = self._record.Eval(context)
        if s.phase == "collect" and len(record.seen) >= self._frames:
            return _go(s, "home", self._home, now, corner=-1)
        corner = (s.corner + 1) % len(self._corners)
        return _go(s, "collect", self._corners[corner], now, corner=corner)

    def _trouble(self, s: MotionState, context: Context, now: float) -> str:
        """Why the job cannot go on; empty where it can."""
        robot: UrStatus = self._robot.Eval(context)
        if not robot.ready:
            return robot.fault or "The robot does not obey velocity commands."
        if self._hold.Eval(context)[0] > 0.5:
            return f"A person ended the job, in the phase '{s.phase}'."
        if now > self._maximum_time_s:
            return f"The job took longer than its {self._maximum_time_s:.0f} s; allow more with job.maximum_time_s."
        if s.phase in ("approach", "collect", "home") and now - s.since > self._timeout_s:
            return "The arm did not reach its goal in time."
        record: MotionRecord = self._record.Eval(context)
        if s.phase == "collect" and not record.seen and s.legs > 2 and len(record.waits_s) * 0.05 > _BLIND_S:
            last = record.refused[-1][1] if record.refused else "no frame arrived"
            return f"The scanner does not see the flange: {last}"
        return ""

    def _job(self, context: Context, output: Any) -> None:
        s: MotionState = context.get_abstract_state(self._state).get_value()
        moving = s.phase in ("approach", "collect", "home")
        output.set_value(
            JobCommand(
                phase=s.phase,
                mode="move" if moving else "hold",
                goal_id=s.goal_id,
                q_goal=s.q_goal if moving else None,
                speed_share=self._speed_share if s.phase == "collect" else 1.0,
                finished=s.phase in ENDS,
                held=s.phase == "held",
                reason=s.reason or None,
            )
        )

    def _streaming(self, context: Context, output: BasicVector) -> None:
        s: MotionState = context.get_abstract_state(self._state).get_value()
        output.SetAtIndex(0, float(s.phase == "collect"))


def _go(s: MotionState, phase: str, q: Array, now: float, *, corner: int) -> MotionState:
    """Start a move; a leg between corners is counted."""
    legs = s.legs + (phase == "collect")
    return replace(s, phase=phase, since=now, goal_id=s.goal_id + 1, q_goal=np.array(q), corner=corner, legs=legs)
