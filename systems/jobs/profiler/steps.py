"""Evaluates the completed step of the profiler job and plans the next one."""

from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.arrays import Array
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler
from weldcal.systems.jobs.profiler.estimates import feature_sigmas, find_edge, find_seam, find_sphere, sphere_sigmas
from weldcal.systems.jobs.profiler.plan import Goal, plan_edge, plan_pass, plan_sphere, plan_torch, plan_touches
from weldcal.systems.jobs.profiler.planning_context import PlanningContext
from weldcal.systems.jobs.profiler.state import ProfilerState
from weldcal.welding.seam.curve import SeamCurve


def next_step(s: ProfilerState, q: Array, profiler: RenderedProfiler, seed: int) -> ProfilerState:
    """The state with the present step evaluated, and the goals of the next one; after the last step, home.

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
            return replace(s, phase="done")
        goals, step = [Goal("via", planning.q_home)], "home"
        left: tuple[str, ...] = ()
        if s.step == "torch":
            goals = [Goal("via", _raised(planning, q)), *goals]
    else:
        step, *rest = s.steps_left
        left = tuple(rest)
        goals = _planned(s, step, q, profiler, seed)
    return replace(s, phase="move", goal_id=s.goal_id + 1, step=step, steps_left=left, goals=tuple(goals), taken=())


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
    up = planning.joints(RigidTransform([0.0, 0.0, 0.05]) @ forward_kinematics(planning.arm, q), q)
    return planning.q_home if up is None else up


def _evaluated(s: ProfilerState, p: RenderedProfiler) -> ProfilerState:
    """Evaluate the completed step and update the planning data."""
    planning = _planning(s)
    if s.step == "edge":
        found = find_edge(planning.arm, p, planning.job, s.taken)
        return replace(s, edge=found, edge_scans=s.taken, planning=planning.known(X_FS=found.estimate.X_FS))
    if s.step == "sphere":
        first = find_sphere(planning.arm, p, planning.job, s.taken)
        known = planning.known(X_FS=first.estimate.X_FS, center=first.estimate.center)
        return replace(s, sphere_scans=s.taken, sphere=first, planning=known)
    if s.step == "touch":
        assert s.sphere is not None
        before = s.sphere.estimate
        sphere = find_sphere(planning.arm, p, planning.job, s.sphere_scans, s.touches, planning.p_FTip, before)
        e = sphere.estimate
        assert e.tip is not None
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(e.rotation), e.translation)
        return replace(s, sphere=sphere, planning=planning.known(X_FS=X, center=e.center, p_FTip=e.tip))
    if s.step == "pass":
        assert s.sphere is not None
        assert planning.X_BP is not None
        assert planning.cad is not None
        drawn = SeamCurve.from_points(np.asarray(planning.cad.seam_P)[::4]).transformed(planning.X_BP)
        seam = find_seam(planning.arm, s.sphere.estimate, drawn, s.taken, 1e-3 * planning.job.seam.every_mm)
        return replace(s, seam=seam, seam_scans=s.taken)
    return s
