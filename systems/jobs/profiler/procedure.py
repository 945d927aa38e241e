"""Scan the edge, scan and touch the sphere, scan along the groove, then move the torch along it."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.arrays import Array
from weldcal.systems.background import Answer, Background, Inline, import_module
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler
from weldcal.systems.jobs.procedure import Inputs, Procedure, ProcedureState
from weldcal.systems.jobs.profiler.estimates import (
    EdgeFound,
    SeamFound,
    SphereFound,
    TakenProfile,
    feature_sigmas,
    find_edge,
    find_seam,
    find_sphere,
    sphere_sigmas,
)
from weldcal.systems.jobs.profiler.plan import (
    Goal,
    PlanningContext,
    plan_edge,
    plan_pass,
    plan_sphere,
    plan_torch,
    plan_touches,
)
from weldcal.systems.messages import JobCommand, ProfileScan, TorchTouch
from weldcal.systems.motion.buffers import PoseHistory
from weldcal.systems.motion.spine import MOVE_TIMEOUT_S
from weldcal.welding.seam.curve import SeamCurve

TOUCHING = ("descend", "lift")  # the phases in which the torch may touch
DWELL_S = 0.1  # at rest before a profile is taken
FEEDBACK_PER_S = 8.0  # feedback gain towards the path
PLANS = {"edge": ("edge",), "sphere": ("sphere", "touch"), "seam": ("pass", "torch")}  # steps of each stage, in order


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfilerState(ProcedureState):
    """State and data of the procedure; `step` is the present one: edge, sphere, touch, pass, torch."""

    step: str = ""
    steps_left: tuple[str, ...] = ()
    goals: tuple[Goal, ...] = ()  # the first is the present goal
    seen: int = 0  # number of the newest received profile
    before: int = 0  # number of profiles at the start of the pass
    felt: int = 0  # number of touches at the start of the descent
    taken: tuple[TakenProfile, ...] = ()
    touches: tuple[Array, ...] = ()
    edge: EdgeFound | None = None
    sphere: SphereFound | None = None
    seam: SeamFound | None = None
    edge_scans: tuple[TakenProfile, ...] = ()
    sphere_scans: tuple[TakenProfile, ...] = ()
    seam_scans: tuple[TakenProfile, ...] = ()
    torch_from_s: float = np.inf
    torch_until_s: float = np.inf
    planning: PlanningContext | None = None
    asked: Answer["ProfilerState"] | None = None  # in the phase compute: the state with the next step


def next_step(s: ProfilerState, q: Array, profiler: RenderedProfiler, seed: int) -> ProfilerState:
    """The state with the present step evaluated, and the goals of the next one; after the last step, home, then none.

    Args:
        s: the state at the end of a step, or before the first.
        q: the arm's joints (6,) rad, at rest.
        profiler: the sensor's data sheet.
        seed: of the random numbers of the plans.

    Raises:
        WeldcalError: the profiles do not show the target, or no plan exists; the message says what to change.
    """
    s = _evaluated(s, profiler)
    planning = _planning(s)
    if not s.steps_left:
        if s.step == "home":
            return replace(s, goals=())
        goals, step = [Goal("via", planning.q_home)], "home"
        left: tuple[str, ...] = ()
        if s.step == "torch":
            goals = [Goal("via", _raised(planning, q)), *goals]
    else:
        step, *rest = s.steps_left
        left = tuple(rest)
        goals = _planned(s, step, q, profiler, seed)
    return replace(s, step=step, steps_left=left, goals=tuple(goals), taken=())


def _planning(s: ProfilerState) -> PlanningContext:
    assert s.planning is not None
    return s.planning


def _planned(s: ProfilerState, step: str, q: Array, profiler: RenderedProfiler, seed: int) -> list[Goal]:
    planning = _planning(s)
    if step == "edge":
        return plan_edge(planning, q, seed, feature_sigmas(profiler, 0.085))
    if step == "sphere":
        return plan_sphere(planning, q, seed, sphere_sigmas(profiler, planning.job))
    if step == "touch":
        return plan_touches(planning, q, seed)
    if step == "pass":
        return plan_pass(planning, q)
    assert s.seam is not None
    return plan_torch(planning, q, s.seam.curve)


def _raised(planning: PlanningContext, q: Array) -> Array:
    up = nearest_solution(planning.arm, RigidTransform([0.0, 0.0, 0.05]) @ forward_kinematics(planning.arm, q), q)
    return planning.q_home if up is None else up


def _evaluated(s: ProfilerState, p: RenderedProfiler) -> ProfilerState:
    """Evaluate the completed step and update the planning data."""
    planning = _planning(s)
    if s.step == "edge":
        found = find_edge(planning.arm, p, planning.job, s.taken)
        return replace(s, edge=found, edge_scans=s.taken, planning=replace(planning, X_FS=found.estimate.X_FS))
    if s.step == "sphere":
        first = find_sphere(planning.arm, p, planning.job, s.taken)
        known = replace(planning, X_FS=first.estimate.X_FS, center=first.estimate.center)
        return replace(s, sphere_scans=s.taken, sphere=first, planning=known)
    if s.step == "touch":
        assert s.sphere is not None
        before = s.sphere.estimate
        sphere = find_sphere(planning.arm, p, planning.job, s.sphere_scans, s.touches, planning.p_FTip, before)
        e = sphere.estimate
        assert e.tip is not None
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(e.rotation), e.translation)
        return replace(s, sphere=sphere, planning=replace(planning, X_FS=X, center=e.center, p_FTip=e.tip))
    if s.step == "pass":
        assert s.sphere is not None
        assert planning.X_BP is not None
        assert planning.cad is not None
        drawn = SeamCurve.from_points(np.asarray(planning.cad.seam_P)[::4]).transformed(planning.X_BP)
        seam = find_seam(planning.arm, s.sphere.estimate, drawn, s.taken, 1e-3 * planning.job.seam.every_mm)
        return replace(s, seam=seam, seam_scans=s.taken)
    return s


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfilerInputs(Inputs):
    """Inputs of the procedure at one tick."""

    history: PoseHistory
    profile: ProfileScan
    touch: TorchTouch


class ProfilerProcedure(Procedure[ProfilerState, ProfilerInputs]):
    """Runs the stages of the job; a fault, a missed sphere or profiles without the target hold it with a reason.

    .. pydrake_system::

        name: ProfilerProcedure
        input_ports:
        - settled_goal
        - robot_status
        - hold
        - position
        - history
        - profile
        - touch
        output_ports:
        - job
        - state
        - trigger
        - creep

    `job` selects the FlangeMover between goals (mode move), or `creep` (6) rad/s (mode weld): the descent to a touch,
    the profiler's pass and the torch's. `trigger` (1) is the number of the newest requested profile; `hold` (1) is the
    operator's stop request.
    """

    inputs = ProfilerInputs
    moves = ("move", "lift")
    driven = ("descend", "run")
    position_port, velocity_port = "position", "creep"
    maximum_time_key = "profiler_job.maximum_time_s"

    def __init__(
        self,
        planning: PlanningContext,
        profiler: RenderedProfiler,
        seed: int,
        background: Background | None = None,
        *,
        move_timeout_s: float = MOVE_TIMEOUT_S,
        period_s: float = 0.008,
    ) -> None:
        super().__init__(
            ProfilerState(planning=planning),
            move_timeout_s=move_timeout_s,
            maximum_time_s=planning.job.maximum_time_s,
            period_s=period_s,
        )
        self._background = background or Inline()
        self._background.prepare(import_module, next_step.__module__)
        self._planning, self._profiler, self._seed = planning, profiler, seed
        self.read("touch", history=PoseHistory(), profile=ProfileScan(), touch=TorchTouch())

    def where(self, s: ProfilerState) -> str:
        """See Procedure: the step."""
        return s.step or s.phase

    def command(self, s: ProfilerState, arm: int = 0) -> JobCommand:
        """See Procedure."""
        return replace(super().command(s), scan_purpose=s.step)

    def attend(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        """See Procedure: a torch that touches where it should be free."""
        if s.phase in TOUCHING or not now.touch.down:
            return s
        return self.held(
            s,
            now,
            f"The torch touches something in the step '{self.where(s)}', while it should be free: look for what is in "
            "the way, and at the touch probe, its cable and input.",
        )

    def drive(self, s: ProfilerState, now: ProfilerInputs) -> tuple[ProfilerState, Array]:
        """See Procedure: along a touch's line, or along a path with feedback towards it."""
        planning, goal = s.planning or self._planning, s.goals[0]
        if s.phase == "descend":
            assert goal.way is not None
            twist = np.concatenate([np.zeros(3), 1e-3 * planning.job.sphere.descent_mm_s * goal.way])
            return self.guarded(s, now, planning.arm, planning.p_FTip, twist)
        assert goal.path is not None
        q_path, v_path, _ = goal.path.at(now.time - s.since)
        q_dot = np.asarray(v_path + FEEDBACK_PER_S * (q_path - now.q))
        return self.watched(s, now, planning.arm, planning.p_FTip, q_dot)

    def _start(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        steps = tuple(step for stage in self._planning.job.stages for step in PLANS[stage])
        return self._next_step(replace(s, steps_left=steps), now)

    def _arrived(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        kind = s.goals[0].kind
        if kind in ("scan", "held_out"):
            return self.enter(s, now, "dwell")
        if kind == "touch":
            return self.enter(s, now, "descend", felt=now.touch.sequence)
        if kind in ("pass", "torch"):
            torch = now.time if kind == "torch" else s.torch_from_s
            return self.enter(s, now, "run", before=s.trigger, torch_from_s=torch)
        return self._go_on(s, now)

    def _dwell(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        return self.request(s, now, "await") if now.time - s.since >= DWELL_S else s

    def _await(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        s = self._collected(s, now)
        return self._go_on(s, now) if s.seen == s.trigger else s

    def _collected(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        """Return the state with the newest profile added, as soon as the joints at its capture time are known."""
        scan = now.profile
        q = now.history.joints_at(scan.capture_time) if scan.sequence > s.seen else None
        if q is None:
            return s
        return replace(s, seen=scan.sequence, taken=(*s.taken, TakenProfile(s.goals[0].kind, q, scan.points)))

    def _descend(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        touch, stage = now.touch, self._planning.job.sphere
        if touch.sequence > s.felt:
            q = now.history.joints_at(touch.time) if touch.q is None else touch.q
            return s if q is None else self.go(s, now, "lift", s.goals[0].q, touches=(*s.touches, q))
        if now.time - s.since > (stage.gap_mm + stage.deepest_mm) / stage.descent_mm_s:
            number = len(s.touches) + 1
            reason = (
                f"The torch did not touch the sphere at touch {number}, and stopped {stage.deepest_mm:g} mm below the"
                " surface expected: check the sphere's position and radius, and the touch probe's cable and input. Jog"
                " the torch away from the sphere before the next start."
            )
            return self.held(s, now, reason)
        return s

    def _run(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        path, elapsed = s.goals[0].path, now.time - s.since
        assert path is not None
        if s.goals[0].kind == "pass":
            s = self._collected(s, now)
            every = self._planning.job.seam.every_mm / self._planning.job.seam.pass_mm_s
            due = s.before + int(elapsed / every) + 1
            if s.seen == s.trigger and s.trigger < due and elapsed < path.duration:
                s = replace(s, trigger=s.trigger + 1)
        if elapsed > path.duration + 0.2 and s.seen == s.trigger:
            if s.goals[0].kind == "torch":
                s = replace(s, torch_until_s=now.time)
            return self._go_on(s, now)
        return s

    def _go_on(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        if len(s.goals) > 1:
            return self.go(s, now, "move", s.goals[1].q, goals=s.goals[1:])
        return self._next_step(s, now)

    def _next_step(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        """Evaluate the completed step and plan the next one, beside the control loop, while the arm is at rest."""
        asked = self._background.ask(next_step, s, now.q, self._profiler, self._seed)
        return self._compute(self.enter(s, now, "compute", asked=asked), now)

    def _compute(self, s: ProfilerState, now: ProfilerInputs) -> ProfilerState:
        assert s.asked is not None
        if not s.asked.ready:
            return s
        found = s.asked.value
        return self.go(found, now, "move", found.goals[0].q) if found.goals else self.enter(found, now, "done")

    steps: ClassVar = {
        "start": _start,
        "compute": _compute,
        "move": _arrived,
        "dwell": _dwell,
        "await": _await,
        "descend": _descend,
        "lift": _go_on,
        "run": _run,
    }
