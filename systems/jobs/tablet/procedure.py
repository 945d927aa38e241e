"""Take one picture of the tablet, then lower the pen onto each landmark until the tablet detects it."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.systems.jobs.procedure import Inputs, Procedure, ProcedureState
from weldcal.systems.jobs.tablet.config import TabletTouch, WristPicture
from weldcal.systems.messages import Message
from weldcal.systems.motion.buffers import PoseHistory

PICTURE_TIMEOUT_S = 8.0  # a choice: a busy computer renders a picture in seconds; twice as much only delays the report
# added to a descent's longest time, so that a touch at its end can still be reported
LATE_TOUCH_S = 0.2


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
class TabletState(ProcedureState):
    """State of the procedure; `trigger` is the number of the requested picture."""

    landmark: int = 0
    # number of touches at the start of this descent, so that a bounce during the lift does not count for the next one
    felt_before: int = 0
    touches: tuple[Touched, ...] = ()
    q_look: Array = field(default_factory=lambda: np.full(6, np.nan))


@dataclass(frozen=True, eq=False, kw_only=True)
class TabletInputs(Inputs):
    """Inputs of the procedure at one tick."""

    history: PoseHistory
    picture: WristPicture
    touch: TabletTouch


class TabletProcedure(Procedure[TabletState, TabletInputs]):
    """Runs the procedure; a robot fault, the operator, or a descent without a touch holds it with a reason.

    .. pydrake_system::

        name: TabletProcedure
        input_ports:
        - settled_goal
        - robot_status
        - hold
        - position_measured
        - history
        - picture
        - touch
        output_ports:
        - job
        - state
        - trigger
        - descent

    `job` drives the FlangeMover between goals and selects `descent` in the CommandArbiter while the pen descends.
    `descent` (6) rad/s moves the pen straight down, zero otherwise. `hold` (1) is the operator's stop request.
    """

    inputs = TabletInputs
    moves = ("to_start", "to_look", "to_above", "lift", "to_home")
    driven = ("descend",)
    velocity_port = "descent"

    def __init__(self, arm: ArmModel, plan: TabletPlan, period_s: float = 0.004) -> None:
        timeouts = {
            "look": (PICTURE_TIMEOUT_S, f"No picture arrived within {PICTURE_TIMEOUT_S:.0f} s of its trigger."),
            "descend": (
                plan.longest_descent_s + LATE_TOUCH_S,
                "The arm's pose at the time of a touch is not known: check the clocks.",
            ),
        }
        super().__init__(
            TabletState(),
            move_timeout_s=plan.move_timeout_s,
            maximum_time_s=plan.maximum_time_s,
            timeouts=timeouts,
            period_s=period_s,
        )
        self._arm, self._plan = arm, plan
        self.read(history=PoseHistory(), picture=WristPicture(), touch=TabletTouch())

    def drive(self, s: TabletState, now: TabletInputs) -> tuple[TabletState, Array]:
        """See Procedure: the pen moves straight down."""
        twist = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -self._plan.descent_m_s])
        return self.guarded(s, now, self._arm, self._plan.p_FP, twist)

    def _start(self, s: TabletState, now: TabletInputs) -> TabletState:
        return self.go(s, now, "to_start", self._plan.q_home)

    def _started(self, s: TabletState, now: TabletInputs) -> TabletState:
        return self.go(s, now, "to_look", self._plan.q_look)

    def _arrived(self, s: TabletState, now: TabletInputs) -> TabletState:
        return self.request(s, now, "look")

    def _look(self, s: TabletState, now: TabletInputs) -> TabletState:
        q = now.history.joints_at(now.picture.capture_time) if now.picture.sequence == s.trigger else None
        return s if q is None else self.go(s, now, "to_above", self._plan.q_above[0], q_look=q)

    def _above(self, s: TabletState, now: TabletInputs) -> TabletState:
        return self.enter(s, now, "descend", felt_before=now.touch.sequence)

    def _descend(self, s: TabletState, now: TabletInputs) -> TabletState:
        q_above = self._plan.q_above[s.landmark]
        if now.touch.sequence > s.felt_before:
            q = now.history.joints_at(now.touch.time)
            if q is None:
                return s
            touches = (*s.touches, Touched(s.landmark, now.touch.position_px, q, now.touch.time))
            return self.go(s, now, "lift", q_above, touches=touches)
        if now.time - s.since > self._plan.longest_descent_s:
            reason = f"The pen did not touch the tablet at landmark {s.landmark + 1}: check the tablet's pose."
            # lift along the descent first: home is not straight above
            return self.go(s, now, "lift", q_above, reason=self.because(s, reason))
        return s

    def _lifted(self, s: TabletState, now: TabletInputs) -> TabletState:
        following = s.landmark + 1
        if not s.reason and following < len(self._plan.q_above):
            return self.go(s, now, "to_above", self._plan.q_above[following], landmark=following)
        return self.go(s, now, "to_home", self._plan.q_home)

    steps: ClassVar = {
        "start": _start,
        "to_start": _started,
        "to_look": _arrived,
        "look": _look,
        "to_above": _above,
        "descend": _descend,
        "lift": _lifted,
        "to_home": Procedure.end,
    }
