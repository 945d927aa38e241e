"""Procedure: base of the jobs' state machines: phases, moves, timeouts, the operator's hold, guarded motion."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, InputPort, State

from weldcal.models.arms.kinematics import ArmModel, jacobian
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, Message, UrStatus
from weldcal.systems.motion.spine import JobPorts
from weldcal.welding.servo.guards import GUARD, SPEED_SHARE, guarded_joint_velocity

ENDS = ("done", "held")
SLOWED = (
    "The arm was slowed near a singular position or at a joint's speed limit: choose another home_deg, or move the "
    "target."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class ProcedureState(Message):
    """State of a procedure; a job adds fields of its own.

    Attributes:
        phase: the present phase; `start` at first, `done` or `held` at the end.
        since: its start time, s.
        goal_id: number of the newest move.
        q_goal: (6,) rad, goal of that move.
        settled_since: time since which the arm is at rest at that goal, s.
        trigger: number of the newest requested scan, picture or profile.
        reason: why the job is held, or will be once the arm is home.
        slowed: a sentence, where the guard slowed the arm in this phase.
    """

    phase: str = "start"
    since: float = 0.0
    goal_id: int = 0
    q_goal: Array | None = None
    settled_since: float | None = None
    trigger: int = 0
    reason: str = ""
    slowed: str = ""

    @property
    def held(self) -> bool:
        """Whether the procedure ended without its result."""
        return self.phase == "held"

    @property
    def finished(self) -> bool:
        """Whether the procedure commands no more motion."""
        return self.phase in ENDS


@dataclass(frozen=True, eq=False, kw_only=True)
class Inputs:
    """Inputs of a procedure at one tick; a job adds a field for each port that it reads.

    Attributes:
        time: s.
        settled_goal: number of the move at whose goal the arm is at rest.
        robot: status of the controller.
        hold: the operator ends the job.
        q: (6,) rad, joints of the first arm; zeros in a procedure that does not read them.
    """

    time: float
    settled_goal: int
    robot: UrStatus
    hold: bool = False
    q: Array


StateOf = TypeVar("StateOf", bound=ProcedureState)
InputsOf = TypeVar("InputsOf", bound=Inputs)


class Procedure(LeafSystem, Generic[StateOf, InputsOf]):
    """Runs the phases of a job. A fault, the operator or a timeout holds the procedure with a reason, for good.

    Input ports are `settled_goal`, `robot_status`, `hold` (1: the operator ends the job), the arm's position and what
    `read` declares. Output ports are `job`, the state, and those that the class attributes name.

    A job derives its state from ProcedureState and its inputs from Inputs, and sets these class attributes:

    Attributes:
        inputs: the class of its inputs.
        steps: for each phase the method that computes the next state. In a phase of `moves` it is called once the
            arm is at rest at the goal, in another phase at each tick.
        moves: phases in which the FlangeMover drives the arm to the goal.
        driven: phases in which `drive`, or the welding servo, drives the arm.
        flags: for each further output port the phases in which it is 1.
        position_port: name of the input port of the arm's joints; empty: none.
        state_port: name of the output port of the state.
        trigger_port: name of the output port of the trigger's number; empty: none.
        velocity_port: name of the output port of the velocity (6) rad/s of `drive`; empty: none.
        maximum_time_key: the scenario's key of the job's time limit.
    """

    inputs: type[Any] = Inputs
    steps: ClassVar[Mapping[str, Callable[[Any, Any, Any], Any]]] = {}
    moves: tuple[str, ...] = ()
    driven: tuple[str, ...] = ()
    flags: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    commands: tuple[str, ...] = ("job",)
    position_port = "position_measured"
    state_port = "state"
    trigger_port = "trigger"
    velocity_port = ""
    maximum_time_key = "job.maximum_time_s"

    def __init__(
        self,
        first: StateOf,
        *,
        move_timeout_s: float,
        maximum_time_s: float,
        timeouts: Mapping[str, tuple[float, str]] | None = None,
        dwell_s: float = 0.0,
        period_s: float = 0.004,
    ) -> None:
        """Declare the ports and the update.

        Args:
            first: the state at the start.
            move_timeout_s: longest time of a move, s.
            maximum_time_s: longest time of the job, s.
            timeouts: for other phases the longest time, s, and the reason of the hold.
            dwell_s: time that the arm is at rest at a goal before it counts as reached, s.
            period_s: of the update, s.
        """
        super().__init__()
        late = f"The arm did not come to rest at its goal within {move_timeout_s:.0f} s."
        self._timeouts = {**dict.fromkeys(self.moves, (move_timeout_s, late)), **(timeouts or {})}
        self._maximum_time_s, self._dwell_s = maximum_time_s, dwell_s
        self._ports: dict[str, tuple[InputPort, Any]] = {}
        self._settled = self.DeclareVectorInputPort("settled_goal", 1)
        self._robot = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._position = self.DeclareVectorInputPort(self.position_port, 6) if self.position_port else None
        self._state = self.DeclareAbstractState(AbstractValue.Make(first))
        ticket = {self.abstract_state_ticket(self._state)}
        for arm, name in enumerate(self.commands):
            self.DeclareAbstractOutputPort(
                name, lambda: AbstractValue.Make(JobCommand()), partial(self._job, arm=arm), ticket
            )
        self.DeclareStateOutputPort(self.state_port, self._state)
        if self.trigger_port:
            self.DeclareVectorOutputPort(self.trigger_port, 1, self._trigger, ticket)
        if self.velocity_port:
            self.DeclareStateOutputPort(self.velocity_port, self.DeclareDiscreteState(np.zeros(6)))
            # the first call loads machine code, which no tick has time for
            guarded_joint_velocity(np.eye(6), np.zeros(6), np.ones(6), GUARD)
        for name in self.flags:
            self.DeclareVectorOutputPort(name, 1, partial(self._flag, name=name), ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def read(self, *optional: str, **ports: Any) -> None:
        """Declare further input ports under the inputs' names, each with a value of its type (number: one-vector).

        A port among `optional` may stay open: then its value is the one given here.
        """
        for name, value in ports.items():
            port = (
                self.DeclareVectorInputPort(name, 1)
                if isinstance(value, float)
                else self.DeclareAbstractInputPort(name, AbstractValue.Make(value))
            )
            self._ports[name] = (port, value if name in optional else None)

    def ports(self, arms: int = 1, **more: Any) -> JobPorts:
        """Return the ports that the spine connects, of a job with so many arms; `more` as in JobPorts."""
        return JobPorts(
            commands=tuple(self.GetOutputPort(name) for name in self.commands[:arms]),
            state=self.GetOutputPort(self.state_port),
            velocity=self.GetOutputPort(self.velocity_port) if self.velocity_port else None,
            **more,
        )

    def state_in(self, context: Context) -> StateOf:
        """State of the procedure in this system's context."""
        state: StateOf = context.get_abstract_state(self._state).get_value()
        return state

    def look(self, context: Context, s: StateOf) -> InputsOf:
        """Return the inputs at this tick; a job may add to them."""
        further: dict[str, Any] = {}
        for name, (port, otherwise) in self._ports.items():
            if otherwise is not None and not port.HasValue(context):
                further[name] = otherwise
            else:
                value = port.Eval(context)
                further[name] = float(value[0]) if isinstance(value, np.ndarray) else value
        found: InputsOf = self.inputs(
            time=context.get_time(),
            settled_goal=int(self._settled.Eval(context)[0]),
            robot=self._robot.Eval(context),
            hold=bool(self._hold.Eval(context)[0] > 0.5),
            q=np.zeros(6) if self._position is None else np.array(self._position.Eval(context)),
            **further,
        )
        return found

    def next_state(self, s: StateOf, now: InputsOf) -> StateOf:
        """Return the state after one tick; the same object where nothing changed. `done` and `held` are final."""
        if s.finished:
            return s
        if reason := self._why_stop(s, now):
            return self.held(s, now, reason)
        try:
            new = self.attend(s, now)
            if not new.finished:
                new = self._step(new, now)
        except WeldcalError as error:  # planning or estimation failed: the message says what to change
            return self.held(s, now, str(error))
        if new.phase == s.phase and new.since == s.since and s.phase in self._timeouts:
            timeout_s, reason = self._timeouts[s.phase]
            if now.time - s.since > timeout_s:
                return self.held(new, now, reason)
        return new

    def attend(self, s: StateOf, now: InputsOf) -> StateOf:
        """What the job looks after in every phase, before the phase's step; it may hold the procedure."""
        return s

    def drive(self, s: StateOf, now: InputsOf) -> tuple[StateOf, Array]:
        """Return the state, and the arm's joint velocity (6,) rad/s, in a phase of `driven`; see `guarded`."""
        raise NotImplementedError

    def where(self, s: StateOf) -> str:
        """Return the phase as a reason names it."""
        return s.phase

    def command(self, s: StateOf, arm: int = 0) -> JobCommand:
        """Return the command to an arm, by its number."""
        return JobCommand(
            phase=s.phase,
            mode="move" if s.phase in self.moves else "weld" if s.phase in self.driven else "hold",
            goal_id=s.goal_id,
            q_goal=s.q_goal,
            scan_sequence=s.trigger,
            finished=s.finished,
            held=s.held,
            reason=s.reason or None,
        )

    def flag(self, name: str, s: StateOf) -> bool:
        """Value of an output port of `flags`."""
        return s.phase in self.flags[name]

    def enter(self, s: StateOf, now: InputsOf, phase: str, **changes: Any) -> StateOf:
        """Return the state at the start of a phase."""
        return replace(s, phase=phase, since=now.time, settled_since=None, slowed="", **changes)

    def go(self, s: StateOf, now: InputsOf, phase: str, q_goal: Array | None, **changes: Any) -> StateOf:
        """Return the state at the start of a move."""
        return self.enter(s, now, phase, goal_id=s.goal_id + 1, q_goal=q_goal, **changes)

    def request(self, s: StateOf, now: InputsOf, phase: str, **changes: Any) -> StateOf:
        """Return the state at the start of a phase that waits for a scan or a picture."""
        return self.enter(s, now, phase, trigger=s.trigger + 1, **changes)

    def end(self, s: StateOf, now: InputsOf) -> StateOf:
        """Return the state at the end: held where a reason was found during the procedure, else done."""
        return self.enter(s, now, "held" if s.reason else "done")

    def held(self, s: StateOf, now: InputsOf, reason: str) -> StateOf:
        """Return the state in which the arm stays at rest and the process off; only a new job leaves it."""
        return self.enter(s, now, "held", reason=self.because(s, reason))

    def because(self, s: StateOf, reason: str) -> str:
        """Return a reason, with the guard's sentence where the arm was slowed in this phase."""
        return f"{reason} {s.slowed}" if s.slowed else reason

    def guarded(self, s: StateOf, now: InputsOf, arm: ArmModel, p_FP: Array, V: Array) -> tuple[StateOf, Array]:
        """Joint velocity (6,) rad/s for a spatial velocity of a point of the flange, as the SingularityGuard allows it.

        Away from singularities it is the solution of the Jacobian's equations. Near one the arm is slowed along the
        same line, and at one the procedure is held with a reason.

        Args:
            s: the state.
            now: the inputs.
            arm: the arm.
            p_FP: (3,) m, the point in the flange frame.
            V: (6,) [omega rad/s; v m/s] of that point in B.
        """
        J = jacobian(arm, now.q, p_FP)
        found = guarded_joint_velocity(J, V, SPEED_SHARE * arm.velocity_limit, GUARD)
        if found.scale == 1.0:
            return s, np.asarray(np.linalg.solve(J, V))
        if found.stopped:
            return self._singular(s, now, found.sigma_min), np.zeros(6)
        return (s if s.slowed else replace(s, slowed=SLOWED)), found.q_dot

    def watched(self, s: StateOf, now: InputsOf, arm: ArmModel, p_FP: Array, q_dot: Array) -> tuple[StateOf, Array]:
        """Return a joint velocity (6,) rad/s along a planned path.

        Its time is fixed: the guard holds it and does not slow it.
        """
        limit = SPEED_SHARE * arm.velocity_limit
        J = jacobian(arm, now.q, p_FP)
        found = guarded_joint_velocity(J, J @ q_dot, limit, GUARD)
        if found.sigma_min <= GUARD.sigma_stop or bool(np.any(np.abs(q_dot) > limit)):
            return self._singular(s, now, found.sigma_min), np.zeros(6)
        return s, q_dot

    def _singular(self, s: StateOf, now: InputsOf, sigma_min: float) -> StateOf:
        return self.held(
            s,
            now,
            f"The arm came too near to a singular position in the phase '{self.where(s)}' (least singular value "
            f"{sigma_min:.3f}): choose another home_deg, or move the target.",
        )

    def _why_stop(self, s: StateOf, now: InputsOf) -> str:
        """Why the procedure must be held at once; empty where it need not."""
        if not now.robot.ready:
            if now.robot.fault is None and now.robot.safety_mode in ("NORMAL", "REDUCED"):
                return "The robot does not obey velocity commands."
            return now.robot.fault or f"The robot stopped: {now.robot.safety_mode}."
        if now.hold:
            return f"The operator ended the job in phase '{self.where(s)}'."
        if now.time > self._maximum_time_s:
            return (
                f"The job took longer than its {self._maximum_time_s:.0f} s, in the phase '{self.where(s)}': allow more"
                f" with {self.maximum_time_key}."
            )
        return ""

    def _step(self, s: StateOf, now: InputsOf) -> StateOf:
        if s.phase in self.moves:
            if now.settled_goal != s.goal_id:
                return s if s.settled_since is None else replace(s, settled_since=None)
            since = now.time if s.settled_since is None else s.settled_since
            if now.time - since < self._dwell_s:
                return s if s.settled_since == since else replace(s, settled_since=since)
        new: StateOf = self.steps[s.phase](self, s, now)
        return new

    def _update(self, context: Context, state: State) -> None:
        old = self.state_in(context)
        now = self.look(context, old)
        new = self.next_state(old, now)
        if self.velocity_port:
            velocity = np.zeros(6)
            if new.phase in self.driven:
                new, velocity = self.drive(new, now)
            state.get_mutable_discrete_state().set_value(velocity)
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)

    def _job(self, context: Context, output: Any, arm: int) -> None:
        output.set_value(self.command(self.state_in(context), arm))

    def _trigger(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self.state_in(context).trigger))

    def _flag(self, context: Context, output: BasicVector, name: str) -> None:
        output.SetAtIndex(0, float(self.flag(name, self.state_in(context))))
