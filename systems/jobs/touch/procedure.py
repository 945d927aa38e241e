"""TouchProcedure: scans the part, then lowers the soft tip onto each place until the finger camera sees it give way."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, jacobian
from weldcal.models.tool import WeldingTool
from weldcal.systems.jobs.touch.planner import Place, PlannedTouches
from weldcal.systems.jobs.weld.aruco_deformation_estimator import Deformation
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, Message, UrStatus

MOVES = ("to_home", "to_above", "lift", "go_home")
ENDS = ("done", "held")
DWELL_S = 0.3  # at rest before a scan and before frames count
SCAN_TIMEOUT_S = 30.0
FRAMES = 10  # of the free tip, and of the pressed one
FREE_M = 0.3e-3  # that a free tip may read
_FRAMES_TIMEOUT_S = 4.0
_MODES = {**dict.fromkeys(MOVES, "move"), "descend": "weld"}
_LONGEST_DESCENT_S = 120.0  # also on a computer that is late, which slows the arm
_SLOWEST_FRAME_S = 0.3  # a descent without a newer frame stops

Vector = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TouchMotion:
    """Numbers of the motion: home (6,) rad, m, m/s, s."""

    q_home: Vector
    descent_m_s: float
    press_m: float
    deepest_m: float  # of the tip at rest below the scanned face, where a descent is given up
    move_timeout_s: float
    maximum_time_s: float


@dataclass(frozen=True, eq=False)
class Felt(Message):
    """One touch: the place, joints (6,) rad at rest, and the tip's deflection (3,) m in T against its free reading."""

    place: Place
    q: Vector
    deflection_T: Vector


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchState(Message):
    """State of the procedure; `frames` are readings since the phase began, `zero` the free tip's mean."""

    phase: str = "start"
    since: float = 0.0
    goal_id: int = 0
    q_goal: Vector | None = None
    scan: int = 0
    index: int = 0
    seen: int = 0  # sequence of the newest frame
    seen_at: float = 0.0
    frames: tuple[Vector, ...] = ()
    zero: Vector | None = None
    places: tuple[Place, ...] = ()
    felt: tuple[Felt, ...] = ()
    reason: str = ""

    @property
    def finished(self) -> bool:
        """Whether the procedure commands no more motion."""
        return self.phase in ENDS


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchSeen:
    """Inputs of the procedure at one tick."""

    time: float
    q: Vector
    settled_goal: int
    robot: UrStatus
    hold: bool
    plan: PlannedTouches
    finger: Deformation
    height: float = np.inf  # of the ball, free, over the scanned face at the present place, m


def next_touch_state(s: TouchState, seen: TouchSeen, motion: TouchMotion) -> TouchState:
    """The state after this tick; the same object where nothing changed."""
    if s.finished:
        return s
    stop = _why_stop(s, seen, motion)
    if stop:
        return replace(s, phase="held", since=seen.time, reason=stop)
    if s.phase == "start":
        return _go(s, "to_home", motion.q_home, seen.time)
    if s.phase in MOVES:
        return _after_move(s, seen, motion) if s.goal_id > 0 and seen.settled_goal == s.goal_id else s
    if s.phase == "rest":
        return replace(s, phase="scan", since=seen.time, scan=s.scan + 1) if seen.time - s.since >= DWELL_S else s
    if s.phase == "scan":
        if seen.plan.sequence != s.scan:
            return s
        if seen.plan.reason is not None:
            return replace(s, phase="held", since=seen.time, reason=seen.plan.reason)
        return _go(replace(s, places=seen.plan.places), "to_above", seen.plan.places[0].q_above, seen.time)
    s = _read(s, seen)
    if s.phase == "zero":
        if len(s.frames) < FRAMES:
            return s
        zero = np.mean(s.frames, axis=0)
        if max(float(np.abs(zero).max()), float(np.ptp(s.frames, axis=0).max())) > FREE_M:
            return _give_up(s, seen, "The tip is not free above the part: raise touch.clearance_mm.")
        return replace(s, phase="descend", since=seen.time, frames=(), zero=zero)
    assert s.zero is not None
    if s.phase == "descend":
        if s.frames and float((s.frames[-1] - s.zero)[2]) >= motion.press_m:
            return replace(s, phase="press", since=seen.time, frames=())
        if seen.height < -motion.deepest_m:
            return _give_up(
                s,
                seen,
                f"The tip met nothing at place {s.index + 1}: it is not where the scanner has it, or not rigid.",
            )
        return s
    if seen.time - s.since < DWELL_S:
        return replace(s, frames=()) if s.frames else s
    if len(s.frames) < FRAMES:
        return s
    felt = Felt(s.places[s.index], seen.q, np.asarray(np.mean(s.frames, axis=0) - s.zero))
    return _go(replace(s, felt=(*s.felt, felt)), "lift", s.places[s.index].q_above, seen.time)


def _read(s: TouchState, seen: TouchSeen) -> TouchState:
    """The state with a new valid frame of the finger camera."""
    sample = seen.finger.sample
    if seen.finger.sequence <= s.seen or sample is None or not sample.valid:
        return s
    return replace(s, seen=seen.finger.sequence, seen_at=seen.time, frames=(*s.frames, np.asarray(sample.deflection_T)))


def _after_move(s: TouchState, seen: TouchSeen, motion: TouchMotion) -> TouchState:
    if s.phase == "to_home":
        return replace(s, phase="rest", since=seen.time)
    if s.phase == "to_above":
        return replace(s, phase="zero", since=seen.time, frames=(), seen=seen.finger.sequence, seen_at=seen.time)
    if s.phase == "lift" and not s.reason and s.index + 1 < len(s.places):
        return _go(replace(s, index=s.index + 1), "to_above", s.places[s.index + 1].q_above, seen.time)
    if s.phase == "lift":
        return _go(s, "go_home", motion.q_home, seen.time)
    return replace(s, phase="held" if s.reason else "done", since=seen.time)


def _give_up(s: TouchState, seen: TouchSeen, reason: str) -> TouchState:
    """Lift along the descent, go home and hold there with the reason."""
    return _go(replace(s, reason=reason), "lift", s.places[s.index].q_above, seen.time)


def _why_stop(s: TouchState, seen: TouchSeen, motion: TouchMotion) -> str:
    """The reason why the procedure must be held at once; empty where there is none."""
    elapsed = seen.time - s.since
    if not seen.robot.ready:
        return seen.robot.fault or f"The robot stopped: {seen.robot.safety_mode}."
    if seen.hold:
        return f"A person ended the job, in the phase '{s.phase}'."
    if seen.time > motion.maximum_time_s:
        return f"The job took longer than {motion.maximum_time_s:.0f} s; allow more with job.maximum_time_s."
    if s.phase in MOVES and elapsed > motion.move_timeout_s:
        return f"The arm did not come to rest at its goal within {motion.move_timeout_s:.0f} s."
    if s.phase == "scan" and elapsed > SCAN_TIMEOUT_S:
        return f"No plan arrived within {SCAN_TIMEOUT_S:.0f} s of the scan's trigger."
    if s.phase in ("zero", "press") and elapsed > _FRAMES_TIMEOUT_S:
        return "The finger camera does not see the tip's tag: check its light and focus."
    if s.phase == "descend" and elapsed > _LONGEST_DESCENT_S:
        return f"A descent took longer than {_LONGEST_DESCENT_S:.0f} s."
    if s.phase == "descend" and seen.time - s.seen_at > _SLOWEST_FRAME_S:
        return "The finger camera lost the tip's tag during a descent."
    return ""


class TouchProcedure(LeafSystem):
    """Runs the procedure; a robot fault, the operator, a lost tag or a descent without contact holds it with a reason.

    .. pydrake_system::

        name: TouchProcedure
        input_ports:
        - position_measured
        - settled_goal
        - robot_status
        - planned_touches
        - deformation
        - hold
        output_ports:
        - job
        - descent
        - trigger
        - streaming
        - state

    `job` drives the FlangeMover between goals and selects `descent` in the CommandArbiter while the tip descends; `descent` (6) rad/s moves
    the tip against the face's normal, zero otherwise; `trigger` (1) and `streaming` (1) go to the station; `hold` (1) is the
    operator's stop request.
    """

    def __init__(self, arm: ArmModel, tool: WeldingTool, motion: TouchMotion, period_s: float = 0.004) -> None:
        super().__init__()
        self._arm, self._p_FT, self._motion = arm, np.asarray(tool.X_FT.translation()), motion
        self._radius_m = tool.tip_radius_m
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._settled = self.DeclareVectorInputPort("settled_goal", 1)
        self._status = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._plan = self.DeclareAbstractInputPort("planned_touches", AbstractValue.Make(PlannedTouches()))
        self._finger = self.DeclareAbstractInputPort("deformation", AbstractValue.Make(Deformation()))
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._state = self.DeclareAbstractState(AbstractValue.Make(TouchState()))
        out = self.DeclareDiscreteState(np.zeros(6))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort("job", lambda: AbstractValue.Make(JobCommand()), self._job, ticket)
        self.DeclareStateOutputPort("descent", out)
        self.DeclareVectorOutputPort("trigger", 1, self._trigger, ticket)
        self.DeclareVectorOutputPort("streaming", 1, self._streaming, ticket)
        self.DeclareAbstractOutputPort("state", lambda: AbstractValue.Make(TouchState()), self._show, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def touch_state(self, context: Context) -> TouchState:
        """State of the procedure in this system's context."""
        state: TouchState = context.get_abstract_state(self._state).get_value()
        return state

    def _update(self, context: Context, state: State) -> None:
        old = self.touch_state(context)
        seen = TouchSeen(
            time=context.get_time(),
            q=np.array(self._position.Eval(context)),
            settled_goal=int(self._settled.Eval(context)[0]),
            robot=self._status.Eval(context),
            hold=bool(self._hold.Eval(context)[0] > 0.5),
            plan=self._plan.Eval(context),
            finger=self._finger.Eval(context),
            height=self._height(old, np.array(self._position.Eval(context))),
        )
        new = next_touch_state(old, seen, self._motion)
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)
        velocity = np.zeros(6)
        if new.phase == "descend":
            twist = np.concatenate([np.zeros(3), -self._motion.descent_m_s * new.places[new.index].n_B])
            velocity = np.linalg.solve(jacobian(self._arm, seen.q, self._p_FT), twist)
        state.get_mutable_discrete_state().set_value(velocity)

    def _height(self, s: TouchState, q: Vector) -> float:
        """Height (m) of the free ball over the face at the present place; infinite where there is none."""
        if s.index >= len(s.places):
            return np.inf
        place = s.places[s.index]
        p_BT = forward_kinematics(self._arm, q).multiply(self._p_FT)
        return float((p_BT - place.p_B) @ place.n_B) - self._radius_m

    def _job(self, context: Context, output: Any) -> None:
        s = self.touch_state(context)
        output.set_value(
            JobCommand(
                phase=s.phase,
                mode=_MODES.get(s.phase, "hold"),
                goal_id=s.goal_id,
                q_goal=s.q_goal,
                scan_sequence=s.scan,
                scan_purpose="workpiece",
                scan_label="workpiece",
                finished=s.finished,
                held=s.phase == "held",
                reason=s.reason or None,
            )
        )

    def _trigger(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self.touch_state(context).scan))

    def _streaming(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self.touch_state(context).phase in ("to_above", "zero", "descend", "press")))

    def _show(self, context: Context, output: Any) -> None:
        output.set_value(self.touch_state(context))


def _go(s: TouchState, phase: str, q_goal: Vector, now: float) -> TouchState:
    return replace(s, phase=phase, since=now, goal_id=s.goal_id + 1, q_goal=np.array(q_goal))
