"""Measures the seam's start: draws the seated tip back over it, so that the torch starts on tactile points."""

import math
from dataclasses import replace

import numpy as np

from weldcal.welding.numerics import Array, changed, clip, dot
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.plan_fit import add_point
from weldcal.welding.seam.refinement import PendingPoint, RefinedSeam
from weldcal.welding.servo.contact import contact_lost
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import ServoSample, WeldingState

BACK_STEPS = ("back", "lift", "enter")  # steps of TOUCH handled here

_SETTLED_M = 0.15e-3  # three times the tag's noise of 0.05 mm, small against the tip's radius
_REENTRY_M = 12.0e-3  # a choice, two tip diameters and more: a groove that is not met by then does not begin here
_LEAST_STEP_M = 0.03e-3  # a choice, below the tag's noise of 0.05 mm: nearer points give the curve no direction


def begin_feeling_back(state: WeldingState, now: float) -> WeldingState:
    """The state of a seated tip that starts to move backwards."""
    return changed(state, proven=True, v_tip=0.0, touch=replace(state.touch, step="back", since=now))


def feel_start_step(
    before: WeldingState, state: WeldingState, sample: ServoSample, is_new: bool, config: ServoConfig
) -> tuple[WeldingState, tuple[float, float, float], str | None, bool]:
    """One tick: back until contact is lost or six millimetres past the plan's start.

    Then up, and into the groove again.

    Args:
        before: the state before this tick's frame, `is_new`: whether there is one.

    Returns:
        (state, wanted speeds along, to the left and up m/s, fault sentence or None, whether the tip is ready to track).
    """
    deflection = config.deflection
    assert state.plan_fit is not None
    assert state.measurement is not None
    curve, limits, t, last = state.plan_fit.curve, config.contact, state.touch, state.measurement
    p_BT = np.asarray(sample.X_BT.translation())
    here = last.point + (p_BT - last.p_BT) if t.step == "back" else p_BT
    s = curve.nearest(here, state.s_tip)
    state = changed(state, s_tip=s)
    if t.step == "back":
        if is_new and contact_lost(before, state, config):
            return _start_found(before, state, sample.time, config), (0.0, 0.0, 0.0), None, False
        if is_new:
            point = PendingPoint(last.point, curve.nearest(last.point, s) - curve.nearest(last.p_BT, s))
            state = changed(state, touch=replace(t, felt=(*t.felt, point)))
        if s < -config.gap.end_window_m:
            # Still in the groove: it starts before the plan does, and the weld starts where the plan does.
            return _ready(changed(state, proven=True), p_BT, config), (0.0, 0.0, 0.0), None, True
        lateral = deflection.k_p * (deflection.delta_d_m - state.delta_n)
        upward = deflection.k_z * (state.delta_axial - deflection.axial_d_m)
        return state, (-config.touch.search_m_s, lateral, upward), None, False
    # Out of the groove: centred and hanging free, so that the groove lifts the tip on re-entry, as after a gap.
    seam = curve.frame(s)
    gap = p_BT - seam.position
    side = state.residual_at_loss[0] - dot(gap, seam.normal)
    height = state.residual_at_loss[1] - config.gap.hover_m - dot(gap, seam.up)
    servo = (deflection.k_follow * side, deflection.k_follow * height)
    if t.step == "lift":
        settled = math.hypot(side, height) < _SETTLED_M and sample.time - t.since > limits.regain_after_s
        if settled:
            state = changed(state, touch=replace(t, step="enter", since=sample.time), lost_at=s, regained=0)
        return state, (0.0, *servo), None, False
    if is_new:
        state = changed(state, regained=state.regained + 1 if state.delta_axial > limits.regain_axial_m else 0)
    if state.regained >= limits.regain_frames:
        return _ready(changed(state, proven=False, regained=0), p_BT, config), (0.0, *servo), None, True
    if s - state.lost_at > _REENTRY_M:
        text = "The tip left the seam's start and did not find it again; check the groove there."
        return state, (0.0, 0.0, 0.0), text, False
    return state, (config.touch.search_m_s, *servo), None, False


def _start_found(before: WeldingState, state: WeldingState, now: float, config: ServoConfig) -> WeldingState:
    """The state after contact was lost.

    The last uncertain points are dropped, and the seam starts where contact ended.
    """
    assert before.measurement is not None
    assert state.plan_fit is not None
    felt = state.touch.felt[: max(0, len(state.touch.felt) - config.refinement.frames_to_commit)]
    residual = mean_residual(np.array([q.point for q in felt[-8:]]), state.plan_fit.curve, state.s_tip)
    touch = replace(state.touch, step="lift", since=now, felt=felt)
    return changed(
        state, touch=touch, residual_at_loss=residual, start_point=before.measurement.point, steer=0.0, felt=0.0
    )


def mean_residual(points: Array, curve: SeamCurve, s_near: float) -> Array:
    """Mean offset (2,) m of points (N,3) from a curve near an arc length, to the left and up; zero without points."""
    if not len(points):
        return np.zeros(2)
    s = curve.project(points, s_near, 0.02)
    gap = points - curve.position(s)
    return np.array((np.sum(gap * curve.normal(s), axis=1).mean(), np.sum(gap * curve.up(s), axis=1).mean()))


def _ready(state: WeldingState, p_BT: Array, config: ServoConfig) -> WeldingState:
    """The state with the points measured backwards as the first of the refined seam, and the plan registered to them.

    Forwards, friction holds the tip behind its rest point by as much as it held it ahead backwards; the path's
    parameter is the rest point's progress, so that a point's parameter is its arc length plus that lag.
    """
    assert state.plan_fit is not None
    felt = state.touch.felt[::-1]
    plan_fit = state.plan_fit
    for q in felt:
        plan_fit = add_point(plan_fit, q.point, plan_fit.curve.nearest(q.point, state.s_tip, 0.05), config.plan_fit)
    curve = plan_fit.curve
    points: list[Array] = []
    arcs: list[float] = []
    for q in felt:
        arc = curve.nearest(q.point, state.s_tip, 0.05) + max(q.arc, 0.0)
        if not arcs or arc > arcs[-1] + _LEAST_STEP_M:
            points.append(q.point)
            arcs.append(arc)
    refined = RefinedSeam(np.array(points), np.array(arcs)) if points else state.refined
    s = curve.nearest(p_BT, state.s_tip, 0.02)
    start = state.start_point
    if start is not None:
        reach = config.gap.end_window_m
        at = curve.nearest(start, 0.0, 0.02)
        start = start + (clip(at, -reach, reach) - at) * curve.frame(at).tangent
    return changed(state, plan_fit=plan_fit, refined=refined, s_tip=s, progress=s, start_point=start)
