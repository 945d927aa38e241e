"""TabletProcedure: takes one picture of the tablet, then lowers the pen onto each landmark until the tablet detects it."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.models.arms.kinematics import ArmModel, jacobian
from weldcal.models.arrays import Array
from weldcal.systems.jobs.tablet.messages import TabletTouch, WristPicture
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, Message, UrStatus
from weldcal.systems.motion.pose_recorder import PoseHistory

MOVES = ("to_start", "to_look", "to_above", "lift", "to_home")
ENDS = ("done", "held")
PICTURE_TIMEOUT_S = 8.0
# added to a descent's longest time, so that a touch at its end can still be reported
LATE_TOUCH_S = 0.2
_MODES = {
    **dict.fromkeys(MOVES, "move"),
    "descend": "weld",
}  # the command mode in which the arbiter selects the servo velocity


@dataclass(frozen=True, eq=False, kw_only=True)
class TabletPlan:
    """Joint goals (rad): camera pose, above each landmark (n, 6), home; descent speed (m/s) and time limits (s)."""

    q_look: Array
    q_above: Array
    q_home: Array
    p_FP: Array  # nominal tip of the pen, which moves straight down
    descent_m_s: float
    longest_descent_s: float
    move_timeout_s: float = 20.0
    maximum_time_s: float = np.inf


@dataclass(frozen=True, eq=False)
class Touched(Message):
    """One landmark's touch: the tablet's record, and the joints (6,) rad at its time."""

    landmark: int
    position_px: Array
    q: Array
    time: float = np.nan


@dataclass(frozen=True, eq=False, kw_only=True)
class TabletState(Message):
    """State of the procedure."""

    phase: str = "start"  # start, to_start, to_look, look, to_above, descend, lift, to_home, done, held
    since: float = 0.0
    goal_id: int = 0
    q_goal: Array | None = None
    landmark: int = 0
    trigger: int = 0
    # number of touches at the start of this descent, so that a bounce during the lift does not count for the next one
    felt_before: int = 0
    touches: tuple[Touched, ...] = ()
    q_look: Array = field(default_factory=lambda: np.full(6, np.nan))
    reason: str = ""

    @property
    def finished(self) -> bool:
        """Whether the procedure commands no more motion."""
        return self.phase in ENDS


@dataclass(frozen=True, eq=False, kw_only=True)
class TabletSeen:
    """Inputs of the procedure at one tick."""

    time: float
    q: Array
    settled_goal: int
    robot: UrStatus
    hold: bool
    history: PoseHistory
    picture: WristPicture
    touch: TabletTouch


def next_state(s: TabletState, seen: TabletSeen, plan: TabletPlan) -> TabletState:
    """The state after this tick; the same object where nothing changed."""
    if s.finished:
        return s
    stop = _why_stop(s, seen, plan)
    if stop:
        return replace(s, phase="held", since=seen.time, reason=stop)
    arrived = s.goal_id > 0 and seen.settled_goal == s.goal_id
    if s.phase in MOVES:
        return _after_move(s, seen, plan) if arrived else s
    if s.phase == "start":
        return _go(s, "to_start", plan.q_home, seen.time)
    if s.phase == "look":
        q = seen.history.joints_at(seen.picture.capture_time) if seen.picture.sequence == s.trigger else None
        return s if q is None else _go(replace(s, q_look=q), "to_above", plan.q_above[0], seen.time)
    if seen.touch.sequence > s.felt_before:
        q = seen.history.joints_at(seen.touch.time)
        if q is None:
            return s
        touches = (*s.touches, Touched(s.landmark, seen.touch.position_px, q, seen.touch.time))
        return _go(replace(s, touches=touches), "lift", plan.q_above[s.landmark], seen.time)
    if seen.time - s.since > plan.longest_descent_s:
        reason = f"The pen did not touch the tablet at landmark {s.landmark + 1}: check the tablet's pose."
        # lift along the descent first: home is not straight above
        return _go(replace(s, reason=reason), "lift", plan.q_above[s.landmark], seen.time)
    return s


def _after_move(s: TabletState, seen: TabletSeen, plan: TabletPlan) -> TabletState:
    if s.phase == "to_start":
        return _go(s, "to_look", plan.q_look, seen.time)
    if s.phase == "to_look":
        return replace(s, phase="look", since=seen.time, trigger=s.trigger + 1)
    if s.phase == "to_above":
        return replace(s, phase="descend", since=seen.time, felt_before=seen.touch.sequence)
    if s.phase == "lift" and not s.reason and s.landmark + 1 < len(plan.q_above):
        return _go(replace(s, landmark=s.landmark + 1), "to_above", plan.q_above[s.landmark + 1], seen.time)
    if s.phase == "lift":
        return _go(s, "to_home", plan.q_home, seen.time)
    return replace(s, phase="held" if s.reason else "done", since=seen.time)


def _why_stop(s: TabletState, seen: TabletSeen, plan: TabletPlan) -> str:
    """The reason why the procedure must be held; empty where there is none."""
    if not seen.robot.ready:
        return seen.robot.fault or f"The robot stopped: {seen.robot.safety_mode}."
    if seen.hold:
        return f"A person ended the job, in the phase '{s.phase}'."
    if seen.time > plan.maximum_time_s:
        return f"The job took longer than {plan.maximum_time_s:.0f} s; allow more with job.maximum_time_s."
    if s.phase in MOVES and seen.time - s.since > plan.move_timeout_s:
        return f"The arm did not come to rest at its goal within {plan.move_timeout_s:.0f} s."
    if s.phase == "look" and seen.time - s.since > PICTURE_TIMEOUT_S:
        return f"No picture arrived within {PICTURE_TIMEOUT_S:.0f} s of its trigger."
    if s.phase == "descend" and seen.time - s.since > plan.longest_descent_s + LATE_TOUCH_S:
        return "The arm's pose at the time of a touch is not known: check the clocks."
    return ""


class TabletProcedure(LeafSystem):
    """Runs the procedure; a robot fault, the operator, or a descent without a touch holds it with a reason.

    .. pydrake_system::

        name: TabletProcedure
        input_ports:
        - position_measured
        - settled_goal
        - robot_status
        - history
        - picture
        - touch
        - hold
        output_ports:
        - job
        - descent
        - trigger
        - state

    `job` drives the FlangeMover between goals and selects `descent` in the CommandArbiter while the pen descends; `descent`
    (6) rad/s moves the pen straight down, zero otherwise; `hold` (1) is the operator's stop request.
    """

    def __init__(self, arm: ArmModel, plan: TabletPlan, period_s: float = 0.004) -> None:
        super().__init__()
        self._arm, self._plan = arm, plan
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._settled = self.DeclareVectorInputPort("settled_goal", 1)
        self._status = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._history = self.DeclareAbstractInputPort("history", AbstractValue.Make(PoseHistory()))
        self._picture = self.DeclareAbstractInputPort("picture", AbstractValue.Make(WristPicture()))
        self._touch = self.DeclareAbstractInputPort("touch", AbstractValue.Make(TabletTouch()))
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._state = self.DeclareAbstractState(AbstractValue.Make(TabletState()))
        out = self.DeclareDiscreteState(np.zeros(6))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort("job", lambda: AbstractValue.Make(JobCommand()), self._job, ticket)
        self.DeclareStateOutputPort("descent", out)
        self.DeclareVectorOutputPort("trigger", 1, self._trigger, ticket)
        self.DeclareAbstractOutputPort("state", lambda: AbstractValue.Make(TabletState()), self._show, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def stands(self, context: Context) -> TabletState:
        """State of the procedure in this system's context."""
        state: TabletState = context.get_abstract_state(self._state).get_value()
        return state

    def _update(self, context: Context, state: State) -> None:
        old = self.stands(context)
        seen = TabletSeen(
            time=context.get_time(),
            q=np.array(self._position.Eval(context)),
            settled_goal=int(self._settled.Eval(context)[0]),
            robot=self._status.Eval(context),
            hold=bool(self._hold.Eval(context)[0] > 0.5),
            history=self._history.Eval(context),
            picture=self._picture.Eval(context),
            touch=self._touch.Eval(context),
        )
        new = next_state(old, seen, self._plan)
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)
        velocity = np.zeros(6)
        if new.phase == "descend":
            twist = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -self._plan.descent_m_s])
            velocity = np.linalg.solve(jacobian(self._arm, seen.q, self._plan.p_FP), twist)
        state.get_mutable_discrete_state().set_value(velocity)

    def _job(self, context: Context, output: Any) -> None:
        s = self.stands(context)
        output.set_value(
            JobCommand(
                phase=s.phase,
                mode=_MODES.get(s.phase, "hold"),
                goal_id=s.goal_id,
                q_goal=s.q_goal,
                finished=s.finished,
                held=s.phase == "held",
                reason=s.reason or None,
            )
        )

    def _trigger(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self.stands(context).trigger))

    def _show(self, context: Context, output: Any) -> None:
        output.set_value(self.stands(context))


def _go(s: TabletState, phase: str, q_goal: Array, now: float) -> TabletState:
    return replace(s, phase=phase, since=now, goal_id=s.goal_id + 1, q_goal=np.array(q_goal))
