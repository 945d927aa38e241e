"""ProfilerProcedure: scans the edge, scans and touches the sphere, scans along the groove, then moves the torch along it."""

from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.models.arms.kinematics import jacobian
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.systems.background import Background, Inline, import_module
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler
from weldcal.systems.jobs.profiler.estimates import Taken
from weldcal.systems.jobs.profiler.planning_context import PlanningContext
from weldcal.systems.jobs.profiler.state import ProfilerState
from weldcal.systems.jobs.profiler.steps import next_step
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, ProfileScan, TorchTouch, UrStatus
from weldcal.systems.motion.pose_recorder import PoseHistory

ENDS = ("done", "held")
TOUCHING = ("descend", "lift")  # the phases in which the torch may touch
DWELL_S = 0.1  # at rest before a profile is taken
FEEDBACK_PER_S = 8.0  # feedback gain towards the path
PLANS = {"edge": ("edge",), "sphere": ("sphere", "touch"), "seam": ("pass", "torch")}  # steps of each stage, in order


class ProfilerProcedure(LeafSystem):
    """Runs the stages of the job; a fault, a missed sphere or profiles without the target hold it with a reason.

    .. pydrake_system::

        name: ProfilerProcedure
        input_ports:
        - position
        - history
        - settled_goal
        - robot_status
        - profile
        - touch
        - hold
        output_ports:
        - job
        - creep
        - trigger
        - state

    `job` selects the FlangeMover between goals (mode move), or `creep` (6) rad/s (mode weld): the descent to a touch, the
    profiler's pass and the torch's. `trigger` (1) is the number of the newest requested profile; `hold` (1) is the
    operator's stop request.
    """

    def __init__(
        self,
        planning: PlanningContext,
        profiler: RenderedProfiler,
        seed: int,
        background: Background | None = None,
        period_s: float = 0.008,
    ) -> None:
        super().__init__()
        self._background = background or Inline()
        self._background.prepare(import_module, next_step.__module__)
        self._planning, self._profiler, self._seed = planning, profiler, seed
        self._position = self.DeclareVectorInputPort("position", 6)
        self._history = self.DeclareAbstractInputPort("history", AbstractValue.Make(PoseHistory()))
        self._settled = self.DeclareVectorInputPort("settled_goal", 1)
        self._status = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._profile = self.DeclareAbstractInputPort("profile", AbstractValue.Make(ProfileScan()))
        self._touch = self.DeclareAbstractInputPort("touch", AbstractValue.Make(TorchTouch()))
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._state = self.DeclareAbstractState(AbstractValue.Make(ProfilerState(planning=planning)))
        out = self.DeclareDiscreteState(np.zeros(6))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort("job", lambda: AbstractValue.Make(JobCommand()), self._job, ticket)
        self.DeclareStateOutputPort("creep", out)
        self.DeclareVectorOutputPort("trigger", 1, self._trigger, ticket)
        self.DeclareStateOutputPort("state", self._state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        old: ProfilerState = context.get_abstract_state(self._state).get_value()
        q = np.array(self._position.Eval(context))
        try:
            new = self._next(old, q, context)
        except WeldcalError as error:  # planning or estimation failed: the message says what to change
            new = replace(old, phase="held", reason=str(error), since=context.get_time())
        if new is not old:
            state.get_mutable_abstract_state(self._state).set_value(new)
        state.get_mutable_discrete_state().set_value(self._velocity(new, q, context.get_time()))

    def _velocity(self, s: ProfilerState, q: Array, now: float) -> Array:
        """Joint velocity (6,) rad/s: along a touch's line, or along a path with feedback towards it."""
        planning = s.planning or self._planning
        if s.phase == "descend" and s.goals[0].way is not None:
            v = np.concatenate([np.zeros(3), 1e-3 * planning.job.sphere.descent_mm_s * s.goals[0].way])
            return np.asarray(np.linalg.solve(jacobian(planning.arm, q, planning.p_FTip), v))
        if s.phase == "run" and s.goals[0].path is not None:
            q_path, v_path, _ = s.goals[0].path.at(now - s.since)
            return np.asarray(v_path + FEEDBACK_PER_S * (q_path - q))
        return np.zeros(6)

    def _next(self, s: ProfilerState, q: Array, context: Context) -> ProfilerState:
        now = context.get_time()
        if s.phase in ENDS:
            return s
        status: UrStatus = self._status.Eval(context)
        if not status.ready:
            reason = status.fault or "The robot does not obey velocity commands."
            return replace(s, phase="held", since=now, reason=reason)
        if self._hold.Eval(context)[0] > 0.5:
            reason = f"A person ended the job, in the step '{s.step or 'start'}'."
            return replace(s, phase="held", since=now, reason=reason)
        if s.phase not in TOUCHING and self._touch.HasValue(context) and self._touch.Eval(context).down:
            reason = (
                f"The torch touches something in the step '{s.step or 'start'}', while it should be free: look for what is in the way, and "
                "at the touch probe, its cable and input."
            )
            return replace(s, phase="held", since=now, reason=reason)
        if now > self._planning.job.maximum_time_s:
            reason = f"The job took longer than its {self._planning.job.maximum_time_s:.0f} s; allow more with maximum_time_s."
            return replace(s, phase="held", since=now, reason=reason)
        if s.phase == "start":
            steps = tuple(step for stage in self._planning.job.stages for step in PLANS[stage])
            return self._next_step(replace(s, steps_left=steps), q, now)
        if s.phase == "compute":
            return self._stepped(s, now)
        if s.phase == "move" and s.goal_id == int(self._settled.Eval(context)[0]):
            return self._arrived(s, q, now, context)
        if s.phase == "dwell" and now - s.since >= DWELL_S:
            return replace(s, phase="await", since=now, sequence=s.sequence + 1)
        if s.phase == "await":
            s = self._collected(s, context)
            return self._go_on(s, q, now) if s.seen == s.sequence else s
        if s.phase == "descend":
            return self._descending(s, now, context)
        if s.phase == "lift" and s.goal_id == int(self._settled.Eval(context)[0]):
            return self._go_on(s, q, now)
        if s.phase == "run":
            return self._running(s, q, now, context)
        return s

    def _arrived(self, s: ProfilerState, q: Array, now: float, context: Context) -> ProfilerState:
        kind = s.goals[0].kind
        if kind in ("scan", "held_out"):
            return replace(s, phase="dwell", since=now)
        if kind == "touch":
            touch: TorchTouch = self._touch.Eval(context)
            return replace(s, phase="descend", since=now, felt=touch.sequence)
        if kind in ("pass", "torch"):
            torch = now if kind == "torch" else s.torch_from_s
            return replace(s, phase="run", since=now, before=s.sequence, torch_from_s=torch)
        return self._go_on(s, q, now)

    def _collected(self, s: ProfilerState, context: Context) -> ProfilerState:
        """The state with the newest profile added, as soon as the joints at its capture time are known."""
        scan: ProfileScan = self._profile.Eval(context)
        if scan.sequence <= s.seen:
            return s
        history: PoseHistory = self._history.Eval(context)
        q = history.joints_at(scan.capture_time)
        if q is None:
            return s
        return replace(s, seen=scan.sequence, taken=(*s.taken, Taken(s.goals[0].kind, q, scan.points)))

    def _descending(self, s: ProfilerState, now: float, context: Context) -> ProfilerState:
        touch: TorchTouch = self._touch.Eval(context)
        stage = self._planning.job.sphere
        if touch.sequence > s.felt:
            history: PoseHistory = self._history.Eval(context)
            q = history.joints_at(touch.time) if touch.q is None else touch.q
            if q is None:
                return s
            return replace(s, phase="lift", since=now, goal_id=s.goal_id + 1, touches=(*s.touches, q))
        if now - s.since > (stage.gap_mm + stage.deepest_mm) / stage.descent_mm_s:
            number = len(s.touches) + 1
            reason = (
                f"The torch did not touch the sphere at touch {number}, and stopped {stage.deepest_mm:g} mm below the surface expected: check "
                "the sphere's position and radius, and the touch probe's cable and input. Jog the torch away from the sphere before the next start."
            )
            return replace(s, phase="held", since=now, reason=reason)
        return s

    def _running(self, s: ProfilerState, q: Array, now: float, context: Context) -> ProfilerState:
        path = s.goals[0].path
        assert path is not None
        if s.goals[0].kind == "pass":
            s = self._collected(s, context)
            every = self._planning.job.seam.every_mm / self._planning.job.seam.pass_mm_s
            due = s.before + int((now - s.since) / every) + 1
            if s.seen == s.sequence and s.sequence < due and now - s.since < path.duration:
                s = replace(s, sequence=s.sequence + 1)
        if now - s.since > path.duration + 0.2 and s.seen == s.sequence:
            if s.goals[0].kind == "torch":
                s = replace(s, torch_until_s=now)
            return self._go_on(s, q, now)
        return s

    def _go_on(self, s: ProfilerState, q: Array, now: float) -> ProfilerState:
        if len(s.goals) > 1:
            return replace(s, phase="move", since=now, goal_id=s.goal_id + 1, goals=s.goals[1:])
        return self._next_step(s, q, now)

    def _next_step(self, s: ProfilerState, q: Array, now: float) -> ProfilerState:
        """Evaluate the completed step and plan the next one, beside the control loop, while the arm is at rest."""
        asked = self._background.ask(next_step, s, q, self._profiler, self._seed)
        return self._stepped(replace(s, phase="compute", since=now, asked=asked), now)

    @staticmethod
    def _stepped(s: ProfilerState, now: float) -> ProfilerState:
        assert s.asked is not None
        return replace(s.asked.value, since=now) if s.asked.ready else s

    def _job(self, context: Context, output: Any) -> None:
        s: ProfilerState = context.get_abstract_state(self._state).get_value()
        mode = {"move": "move", "lift": "move", "descend": "weld", "run": "weld"}.get(s.phase, "hold")
        q_goal = s.goals[0].q if s.goals else None
        output.set_value(
            JobCommand(
                phase=s.phase,
                mode=mode,
                goal_id=s.goal_id,
                q_goal=q_goal,
                scan_sequence=s.sequence,
                scan_purpose=s.step,
                finished=s.phase in ENDS,
                held=s.phase == "held",
                reason=s.reason or None,
            )
        )

    def _trigger(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(context.get_abstract_state(self._state).get_value().sequence))
