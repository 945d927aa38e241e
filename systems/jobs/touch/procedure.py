"""Scan the part, then lower the soft tip onto each place until the finger camera measures its deflection."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import Context

from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.arrays import Array
from weldcal.models.tool import WeldingTool
from weldcal.systems.jobs.procedure import Inputs, Procedure, ProcedureState
from weldcal.systems.jobs.touch.planner import PlannedTouches, TouchPlace
from weldcal.systems.jobs.weld.aruco_deformation_estimator import Deformation
from weldcal.systems.messages import JobCommand, Message

DWELL_S = 0.3  # at rest before a scan and before frames count
# a choice: scan and plan take seconds; twice as much only delays the report of a scanner that hangs
SCAN_TIMEOUT_S = 30.0
FRAMES = 10  # of the free tip, and of the pressed one
FREE_M = 0.3e-3  # that a free tip may read
_FRAMES_TIMEOUT_S = 4.0  # a choice: FRAMES take 0.3 s at 30 Hz; ten times that is a tag out of sight
_LONGEST_DESCENT_S = 120.0  # also on a computer that is late, which slows the arm
_SLOWEST_FRAME_S = 0.3  # a descent without a newer frame stops
_NO_TAG = "The finger camera does not see the tip's tag: check its light and focus."
_TIMEOUTS = {
    "scan": (SCAN_TIMEOUT_S, f"No plan arrived within {SCAN_TIMEOUT_S:.0f} s of the scan's trigger."),
    "zero": (_FRAMES_TIMEOUT_S, _NO_TAG),
    "press": (_FRAMES_TIMEOUT_S, _NO_TAG),
    "descend": (_LONGEST_DESCENT_S, f"A descent took longer than {_LONGEST_DESCENT_S:.0f} s."),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchMotion:
    """Numbers of the motion: home (6,) rad, m, m/s, s."""

    q_home: Array
    descent_m_s: float
    press_m: float
    deepest_m: float  # of the tip at rest below the scanned face, where a descent is given up
    move_timeout_s: float
    maximum_time_s: float


@dataclass(frozen=True, eq=False)
class Felt(Message):
    """One touch: the place, joints (6,) rad at rest, and the tip's deflection (3,) m in T against its free reading."""

    place: TouchPlace
    q: Array
    deflection_T: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchState(ProcedureState):
    """State of the procedure; `frames` are readings since the phase began, `zero` the free tip's mean."""

    index: int = 0
    seen: int = 0  # sequence of the newest frame
    seen_at: float = 0.0
    frames: tuple[Array, ...] = ()
    zero: Array | None = None
    places: tuple[TouchPlace, ...] = ()
    felt: tuple[Felt, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchInputs(Inputs):
    """Inputs of the procedure at one tick."""

    planned_touches: PlannedTouches
    deformation: Deformation
    height: float = np.inf  # of the ball, free, over the scanned face at the present place, m


class TouchProcedure(Procedure[TouchState, TouchInputs]):
    """Runs the procedure; a robot fault, the operator, a lost tag or a descent without contact holds it with a reason.

    .. pydrake_system::

        name: TouchProcedure
        input_ports:
        - settled_goal
        - robot_status
        - hold
        - position_measured
        - planned_touches
        - deformation
        output_ports:
        - job
        - state
        - trigger
        - descent
        - streaming

    `job` drives the FlangeMover between goals and selects `descent` in the CommandArbiter while the tip descends.
    `descent` (6) rad/s moves the tip against the face's normal, zero otherwise. `trigger` (1) and `streaming` (1) go to
    the station. `hold` (1) is the operator's stop request.
    """

    inputs = TouchInputs
    moves = ("to_home", "to_above", "lift", "go_home")
    driven = ("descend",)
    flags: ClassVar = {"streaming": ("to_above", "zero", "descend", "press")}
    velocity_port = "descent"

    def __init__(self, arm: ArmModel, tool: WeldingTool, motion: TouchMotion, period_s: float = 0.004) -> None:
        super().__init__(
            TouchState(),
            move_timeout_s=motion.move_timeout_s,
            maximum_time_s=motion.maximum_time_s,
            timeouts=_TIMEOUTS,
            period_s=period_s,
        )
        self._arm, self._p_FT, self._motion = arm, np.asarray(tool.X_FT.translation()), motion
        self._radius_m = tool.tip_radius_m
        self.read(planned_touches=PlannedTouches(), deformation=Deformation())

    def look(self, context: Context, s: TouchState) -> TouchInputs:
        """See Procedure; with the height of the free ball over the face at the present place."""
        now = super().look(context, s)
        if s.index >= len(s.places):
            return now
        place = s.places[s.index]
        p_BT = forward_kinematics(self._arm, now.q).multiply(self._p_FT)
        return replace(now, height=float((p_BT - place.p_B) @ place.n_B) - self._radius_m)

    def command(self, s: TouchState, arm: int = 0) -> JobCommand:
        """See Procedure."""
        return replace(super().command(s), scan_purpose="workpiece", scan_label="workpiece")

    def drive(self, s: TouchState, now: TouchInputs) -> tuple[TouchState, Array]:
        """See Procedure: the tip moves against the face's normal."""
        twist = np.concatenate([np.zeros(3), -self._motion.descent_m_s * s.places[s.index].n_B])
        return self.guarded(s, now, self._arm, self._p_FT, twist)

    def _start(self, s: TouchState, now: TouchInputs) -> TouchState:
        return self.go(s, now, "to_home", self._motion.q_home)

    def _at_home(self, s: TouchState, now: TouchInputs) -> TouchState:
        return self.enter(s, now, "rest")

    def _rest(self, s: TouchState, now: TouchInputs) -> TouchState:
        return self.request(s, now, "scan") if now.time - s.since >= DWELL_S else s

    def _scanned(self, s: TouchState, now: TouchInputs) -> TouchState:
        plan = now.planned_touches
        if plan.sequence != s.trigger:
            return s
        if plan.reason is not None:
            return self.held(s, now, plan.reason)
        return self.go(s, now, "to_above", plan.places[0].q_above, places=plan.places)

    def _above(self, s: TouchState, now: TouchInputs) -> TouchState:
        return self.enter(s, now, "zero", frames=(), seen=now.deformation.sequence, seen_at=now.time)

    def _zero(self, s: TouchState, now: TouchInputs) -> TouchState:
        s = self._framed(s, now)
        if len(s.frames) < FRAMES:
            return s
        zero = np.mean(s.frames, axis=0)
        if max(float(np.abs(zero).max()), float(np.ptp(s.frames, axis=0).max())) > FREE_M:
            return self._give_up(s, now, "The tip is not free above the part: raise touch.clearance_mm.")
        return self.enter(s, now, "descend", frames=(), zero=zero)

    def _descend(self, s: TouchState, now: TouchInputs) -> TouchState:
        if now.time - s.seen_at > _SLOWEST_FRAME_S:
            return self.held(s, now, "The finger camera lost the tip's tag during a descent.")
        s = self._framed(s, now)
        assert s.zero is not None
        if s.frames and float((s.frames[-1] - s.zero)[2]) >= self._motion.press_m:
            return self.enter(s, now, "press", frames=())
        if now.height < -self._motion.deepest_m:
            reason = f"The tip met nothing at place {s.index + 1}: it is not where the scanner has it, or not rigid."
            return self._give_up(s, now, reason)
        return s

    def _press(self, s: TouchState, now: TouchInputs) -> TouchState:
        s = self._framed(s, now)
        assert s.zero is not None
        if now.time - s.since < DWELL_S:
            return replace(s, frames=()) if s.frames else s
        if len(s.frames) < FRAMES:
            return s
        felt = Felt(s.places[s.index], now.q, np.asarray(np.mean(s.frames, axis=0) - s.zero))
        return self.go(s, now, "lift", s.places[s.index].q_above, felt=(*s.felt, felt))

    def _lifted(self, s: TouchState, now: TouchInputs) -> TouchState:
        if not s.reason and s.index + 1 < len(s.places):
            return self.go(s, now, "to_above", s.places[s.index + 1].q_above, index=s.index + 1)
        return self.go(s, now, "go_home", self._motion.q_home)

    def _framed(self, s: TouchState, now: TouchInputs) -> TouchState:
        """Return the state with a new valid frame of the finger camera."""
        sequence, sample = now.deformation.sequence, now.deformation.sample
        if sequence <= s.seen or sample is None or not sample.valid:
            return s
        return replace(s, seen=sequence, seen_at=now.time, frames=(*s.frames, np.asarray(sample.deflection_T)))

    def _give_up(self, s: TouchState, now: TouchInputs, reason: str) -> TouchState:
        """Lift along the descent, go home and hold there with the reason."""
        return self.go(s, now, "lift", s.places[s.index].q_above, reason=self.because(s, reason))

    steps: ClassVar = {
        "start": _start,
        "to_home": _at_home,
        "rest": _rest,
        "scan": _scanned,
        "to_above": _above,
        "zero": _zero,
        "descend": _descend,
        "press": _press,
        "lift": _lifted,
        "go_home": Procedure.end,
    }
