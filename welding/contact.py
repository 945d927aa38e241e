"""What one finger-camera frame says: where the tip is, how hard it leans, and whether it still touches."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from weldcal.welding.plan_fit import add_point
from weldcal.welding.refinement import drop_pending, refine, tip_point
from weldcal.welding.seam import SeamFrame
from weldcal.welding.servo_state import Measurement, ServoConfig, ServoSample, WeldingState
from weldcal.welding.vectors import clip, dot, finite, norm


def is_new_frame(state: WeldingState, sample: ServoSample) -> bool:
    """Whether the sample carries a valid frame that has not been used; a frame from the future is not one."""
    frame = sample.deflection
    return (
        frame is not None
        and frame.valid
        and state.frame_time < frame.capture_time <= sample.time + 1e-6
        and finite(frame.deflection_T)
    )


def with_frame(state: WeldingState, sample: ServoSample, seam: SeamFrame, config: ServoConfig) -> WeldingState:
    """The state after a new frame: tip point, delta = P_r - P_s (Eq. 15), its part along n and the axial part."""
    frame = sample.deflection
    assert frame is not None
    deflection = frame.deflection_T / state.gain
    X_BT = frame.X_BT_at_capture
    point = tip_point(X_BT, deflection)
    p_BT = np.asarray(X_BT.translation())
    delta = p_BT - point
    delta_n, delta_axial = dot(delta, seam.normal), -dot(delta, seam.up)
    return replace(
        state,
        measurement=Measurement(frame.capture_time, point, delta, p_BT),
        frame_time=frame.capture_time,
        delta_n=delta_n,
        delta_axial=delta_axial,
        steer=_steering(dot(delta, seam.tangent), delta_n, config) if state.proven else 0.0,
    )


def _steering(delta_t: float, delta_n: float, config: ServoConfig) -> float:
    """How far to turn the tip's frame about up, rad, where the deformation contradicts the plan's normal.

    The tip leans against what stops it. When that is far from the plan's normal the plan is wrong there (a corner it
    rounded), and pressing on along its tangent would jam the tip; friction's steady drag is no such evidence.
    """
    excess = max(0.0, abs(delta_t) - config.drag_m)
    angle = math.copysign(math.atan2(excess, max(delta_n, 0.5 * config.delta_d_m)), delta_t)
    share = (abs(angle) - config.steering_dead_rad) / (config.steering_full_rad - config.steering_dead_rad)
    return -angle * clip(share, 0.0, 1.0)


def beyond_limit(state: WeldingState, config: ServoConfig) -> bool:
    """Whether the newest frame shows the tip pushed beyond what its springs allow."""
    if state.measurement is None:
        return False
    lateral = math.sqrt(max(0.0, norm(state.measurement.delta) ** 2 - state.delta_axial**2))
    limits = config.contact
    return lateral > limits.limit_lateral_m or state.delta_axial > limits.limit_axial_m


def contact_lost(before: WeldingState, now: WeldingState, config: ServoConfig) -> bool:
    """Whether contact went between two frames: abrupt unloading, or too little deflection to call it contact."""
    limits = config.contact
    if not now.proven:
        return now.delta_axial < 0.5 * limits.regain_axial_m
    # Both springs let go at once; one falling alone is a noisy frame or a rough wall.
    unloaded = min(before.delta_n - now.delta_n, before.delta_axial - now.delta_axial) > limits.drop_m
    return unloaded or now.delta_n < limits.normal_min_m or now.delta_axial < limits.axial_min_m


def with_point(state: WeldingState, config: ServoConfig) -> WeldingState:
    """The state with its newest tactile point queued, the oldest committed, and the plan moved onto the points."""
    assert state.measurement is not None
    assert state.plan_fit is not None
    proven = state.proven or state.delta_n > 0.5 * config.delta_d_m
    if not (proven or state.delta_axial > 0.33 * config.axial_d_m):
        return replace(state, refined=drop_pending(state.refined), proven=proven)
    arc = progress_at(state, state.measurement.capture_time)
    refined = refine(state.refined, state.measurement.point, arc, config.refinement)
    plan_fit = state.plan_fit
    if len(refined) > len(state.refined):
        plan_fit = add_point(plan_fit, refined.points[-1], float(refined.arc[-1]), config.plan_fit)
    return replace(state, refined=refined, plan_fit=plan_fit, proven=proven)


def progress_at(state: WeldingState, time: float) -> float:
    """The commanded tip progress m at a past time, from the log."""
    log = state.progress_log
    if not log:
        return state.progress
    later = log[-1]
    for earlier in reversed(log):
        if earlier[0] <= time:
            span = later[0] - earlier[0]
            return earlier[1] + (later[1] - earlier[1]) * ((time - earlier[0]) / span if span > 0.0 else 0.0)
        later = earlier
    return log[0][1] - (log[0][0] - time) * state.v_tip


def with_progress(state: WeldingState, time: float, v_tip: float, dt: float) -> WeldingState:
    """The state with its progress advanced by one tick, and 0.25 s of it remembered for late frames."""
    progress = state.progress + v_tip * dt
    return replace(state, progress=progress, progress_log=(*state.progress_log[-31:], (time, progress)))
