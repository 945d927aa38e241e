"""TabletProcedure: look at the tablet once, then lower the pen onto each landmark until the tablet feels it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from weldcal.models.arms.kinematics import ArmModel, jacobian
from weldcal.systems.drivers.wrist_devices import TabletTouch, WristPicture
from weldcal.systems.messages import JobCommand, Message, UrStatus

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TabletPlan:
    """Joint goals (rad): where to look from, above each landmark (n, 6), home; descent and when to give up (m/s, s)."""

    q_look: Array
    q_above: Array
    q_home: Array
    p_FP: Array  # of the pen as drawn: its tip is what goes straight down
    descent_m_s: float
    longest_descent_s: float


@dataclass(frozen=True, eq=False)
class Touched(Message):
    """One landmark's touch: what the tablet wrote, and the joints (6,) rad at which it did."""

    landmark: int
    position_px: Array
    q: Array


@dataclass(frozen=True, eq=False)
class TabletState(Message):
    """Where the procedure stands."""

    phase: str = "start"  # start, to_look, look, to_above, descend, lift, to_home, done, held
    since: float = 0.0
    goal_id: int = 0
    q_goal: Array | None = None
    landmark: int = 0
    trigger: int = 0
    felt_before: int = (
        0  # touches the tablet had felt when this descent began: a bounce on the way up is not the next one
    )
    touches: tuple[Touched, ...] = ()
    q_look: Array = field(default_factory=lambda: np.full(6, np.nan))
    reason: str = ""


class TabletProcedure(LeafSystem):
    """Runs the procedure; a robot fault, or a descent that meets no tablet, holds it with a sentence.

    .. pydrake_system::

        name: TabletProcedure
        input_ports:
        - position_measured
        - settled_goal
        - robot_status
        - picture
        - touch
        output_ports:
        - job
        - descent
        - trigger
        - state

    `job` drives the FlangeMover between goals; `descent` (6) rad/s is the pen's way straight down, zero otherwise.
    """

    def __init__(self, arm: ArmModel, plan: TabletPlan, period_s: float = 0.004) -> None:
        super().__init__()
        self._arm, self._plan = arm, plan
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._settled = self.DeclareVectorInputPort("settled_goal", 1)
        self._status = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._picture = self.DeclareAbstractInputPort("picture", AbstractValue.Make(WristPicture()))
        self._touch = self.DeclareAbstractInputPort("touch", AbstractValue.Make(TabletTouch()))
        self._state = self.DeclareAbstractState(AbstractValue.Make(TabletState()))
        out = self.DeclareDiscreteState(np.zeros(6))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort("job", lambda: AbstractValue.Make(JobCommand()), self._job, ticket)
        self.DeclareVectorOutputPort("descent", 6, self._descent, {self.discrete_state_ticket(out)})
        self.DeclareVectorOutputPort("trigger", 1, self._trigger, ticket)
        self.DeclareAbstractOutputPort("state", lambda: AbstractValue.Make(TabletState()), self._show, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        old: TabletState = context.get_abstract_state(self._state).get_value()
        q = np.array(self._position.Eval(context))
        new = self._next(old, q, context)
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)
        velocity = np.zeros(6)
        if new.phase == "descend":
            twist = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -self._plan.descent_m_s])
            velocity = np.linalg.solve(jacobian(self._arm, q, self._plan.p_FP), twist)
        state.get_mutable_discrete_state().set_value(velocity)

    def _next(self, s: TabletState, q: Array, context: Context) -> TabletState:
        now, plan = context.get_time(), self._plan
        if s.phase in ("done", "held"):
            return s
        status: UrStatus = self._status.Eval(context)
        if not status.ready:
            return replace(
                s, phase="held", since=now, reason=status.fault or "The robot does not obey velocity commands."
            )
        arrived = s.goal_id > 0 and int(self._settled.Eval(context)[0]) == s.goal_id
        if s.phase == "start":
            return _go(s, "to_look", plan.q_look, now)
        if s.phase == "to_look" and arrived:
            return replace(s, phase="look", since=now, trigger=s.trigger + 1)
        if s.phase == "look":
            picture: WristPicture = self._picture.Eval(context)
            return _go(replace(s, q_look=q), "to_above", plan.q_above[0], now) if picture.sequence == s.trigger else s
        if s.phase == "to_above" and arrived:
            before: TabletTouch = self._touch.Eval(context)
            return replace(s, phase="descend", since=now, felt_before=before.sequence)
        if s.phase == "descend":
            touch: TabletTouch = self._touch.Eval(context)
            if touch.sequence > s.felt_before:
                touches = (*s.touches, Touched(s.landmark, touch.position_px, q))
                return _go(replace(s, touches=touches), "lift", plan.q_above[s.landmark], now)
            if now - s.since > plan.longest_descent_s:
                reason = f"The pen met no tablet at landmark {s.landmark + 1}: check where the tablet lies."
                return _go(replace(s, reason=reason), "to_home", plan.q_home, now)
        if s.phase == "lift" and arrived:
            if s.landmark + 1 < len(plan.q_above):
                return _go(replace(s, landmark=s.landmark + 1), "to_above", plan.q_above[s.landmark + 1], now)
            return _go(s, "to_home", plan.q_home, now)
        if s.phase == "to_home" and arrived:
            return replace(s, phase="held" if s.reason else "done", since=now)
        return s

    def _job(self, context: Context, output: Any) -> None:
        s: TabletState = context.get_abstract_state(self._state).get_value()
        moving = s.phase in ("to_look", "to_above", "lift", "to_home")
        output.set_value(JobCommand(s.phase, "move" if moving else "hold", s.goal_id, s.q_goal))

    def _descent(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state_vector().value())

    def _trigger(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(context.get_abstract_state(self._state).get_value().trigger))

    def _show(self, context: Context, output: Any) -> None:
        output.set_value(context.get_abstract_state(self._state).get_value())


def _go(s: TabletState, phase: str, q_goal: Array, now: float) -> TabletState:
    return replace(s, phase=phase, since=now, goal_id=s.goal_id + 1, q_goal=np.array(q_goal))
