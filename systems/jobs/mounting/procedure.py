"""MountingProcedure: visits the planned poses with one arm or two, scans at each, holds out some scans, returns home."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.calibration.planning.mounting_poses import MountingPose
from weldcal.models.arrays import Array
from weldcal.systems.jobs.mounting.messages import MountingState, MountingStatus
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, UrStatus
from weldcal.systems.motion.clear_moves import stands_at

ENDS = ("done", "held")


class MountingProcedure(LeafSystem):
    """Runs the procedure; a robot fault, or a goal that is not reached, holds it with a reason.

    .. pydrake_system::

        name: MountingProcedure
        input_ports:
        - settled_goal
        - settled_goal_2
        - robot_status
        - robot_status_2
        - status
        - hold
        - position_measured
        output_ports:
        - job
        - job_2
        - trigger
        - state

    One arm moves at a time: towards a pose the second arm first, towards home the first arm first, so that the move home is
    the reversed move from home. An arm that is not at home moves there first. `hold` (1) is the operator's stop request. The
    first `scans` poses of the plan are for the calibration (fewer where the required error is reached earlier), the next
    `held_out` poses for its verification.
    """

    def __init__(
        self,
        plan: Sequence[MountingPose],
        scans: int,
        held_out: int,
        home: tuple[Array, Array | None],
        timeout_s: float = 60.0,
        maximum_time_s: float = np.inf,
        period_s: float = 0.008,
    ) -> None:
        super().__init__()
        self._plan, self._scans, self._held_out = tuple(plan), scans, held_out
        self.home, self._timeout_s, self._maximum_time_s = home, timeout_s, maximum_time_s
        self._settled = [self.DeclareVectorInputPort(n, 1) for n in ("settled_goal", "settled_goal_2")]
        self._robots = [
            self.DeclareAbstractInputPort(n, AbstractValue.Make(UrStatus())) for n in ("robot_status", "robot_status_2")
        ]
        self._status = self.DeclareAbstractInputPort("status", AbstractValue.Make(MountingStatus()))
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._state = self.DeclareAbstractState(AbstractValue.Make(MountingState()))
        ticket = {self.abstract_state_ticket(self._state)}
        for arm, name in enumerate(("job", "job_2")):
            self.DeclareAbstractOutputPort(
                name, lambda: AbstractValue.Make(JobCommand()), partial(self._job, arm=arm), ticket
            )
        self.DeclareVectorOutputPort("trigger", 1, self._trigger, ticket)
        self.DeclareStateOutputPort("state", self._state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        old: MountingState = context.get_abstract_state(self._state).get_value()
        new = self._next(old, context)
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)

    def _next(self, s: MountingState, context: Context) -> MountingState:
        now = context.get_time()
        if s.phase in ENDS:
            return s
        for port in self._robots[: 1 if self.home[1] is None else 2]:
            robot: UrStatus = port.Eval(context)
            if not robot.ready:
                reason = robot.fault or "The robot does not obey velocity commands."
                return replace(s, phase="held", since=now, reason=reason)
        if self._hold.Eval(context)[0] > 0.5:
            return replace(
                s, phase="held", since=now, reason=f"A person ended the job, on the way to {s.label or 'home'}."
            )
        if now > self._maximum_time_s:
            reason = f"The job took longer than its {self._maximum_time_s:.0f} s; allow more with job.maximum_time_s."
            return replace(s, phase="held", since=now, reason=reason)
        if s.phase == "start":
            if not stands_at(self._position.Eval(context), self.home[0]):
                return _go(s, self._homeward(), "", now)
            return self._visit(s, 0, now)
        if s.phase == "move":
            if int(self._settled[s.moving].Eval(context)[0]) == s.goal_id:
                return self._arrived(s, now)
            if now - s.since > self._timeout_s:
                return replace(s, phase="held", since=now, reason=f"An arm did not reach {s.label or 'home'} in time.")
            return s
        status: MountingStatus = self._status.Eval(context)
        if status.sequence != s.trigger:
            return s
        if s.purpose == "calibrate" and (status.done or s.visit + 1 >= self._scans):
            # the held-out poses are approached from home, wherever the calibration ended
            return _go(replace(s, visit=self._scans - 1), self._homeward(), "", now)
        if s.visit + 1 >= self._scans + self._held_out:
            return _go(s, self._homeward(), "", now)
        return self._visit(s, s.visit + 1, now)

    def _arrived(self, s: MountingState, now: float) -> MountingState:
        if s.route:
            return _go(s, s.route, s.label, now)
        if s.label:
            return replace(s, phase="scan", since=now, trigger=s.trigger + 1)
        if s.visit + 1 < self._scans + self._held_out:
            return self._visit(s, s.visit + 1, now)
        return replace(s, phase="done", since=now)

    def _visit(self, s: MountingState, k: int, now: float) -> MountingState:
        pose, aside = self._plan[k], k >= self._scans
        label = f"aside{k - self._scans + 1:02d}" if aside else f"pose{k + 1:02d}"
        route: tuple[tuple[int, Array], ...] = ((0, pose.q),)
        if pose.q_2 is not None:
            route = ((1, pose.q_2), *route)
        if pose.via_home:
            route = (*self._homeward(), *route)
        return _go(replace(s, visit=k, purpose="verify" if aside else "calibrate"), route, label, now)

    def _homeward(self) -> tuple[tuple[int, Array], ...]:
        first = ((0, self.home[0]),)
        return first if self.home[1] is None else (*first, (1, self.home[1]))

    def _job(self, context: Context, output: Any, arm: int) -> None:
        s: MountingState = context.get_abstract_state(self._state).get_value()
        moving = s.phase == "move" and s.moving == arm
        output.set_value(
            JobCommand(
                phase=s.phase,
                mode="move" if moving else "hold",
                goal_id=s.goal_id,
                q_goal=s.q_goal if moving else None,
                finished=s.phase in ENDS,
                held=s.phase == "held",
                reason=s.reason or None,
            )
        )

    def _trigger(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(context.get_abstract_state(self._state).get_value().trigger))


def _go(s: MountingState, route: tuple[tuple[int, Array], ...], label: str, now: float) -> MountingState:
    """Start a route; `label` of the pose at its end, empty for home."""
    (arm, q), rest = route[0], route[1:]
    moving = replace(s, phase="move", since=now, goal_id=s.goal_id + 1, moving=arm, q_goal=np.array(q))
    return replace(moving, route=rest, label=label)
