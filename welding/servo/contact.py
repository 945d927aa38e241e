"""Updates the servo's state from finger-camera frames: tip point, deflection, contact and tactile points."""

import math

import numpy as np

from weldcal.welding.numerics import Array, changed, clip, dot, finite, norm
from weldcal.welding.seam.curve import SeamFrame
from weldcal.welding.seam.plan_fit import add_point
from weldcal.welding.seam.refinement import drop_pending, refine, tip_point
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Measurement, Phase, ServoSample, WeldingState

LEAST_POINTS = 5  # of a path that is fitted; before, the torch follows the plan
_PRESSED = 0.9  # a choice: of the wanted deflections; a gain of 8 % less still passes


def is_new_frame(state: WeldingState, sample: ServoSample) -> bool:
    """Whether the sample carries a valid frame that has not been used; a frame from the future is not one."""
    frame = sample.deflection
    return (
        frame is not None
        and frame.valid
        and state.frame_time < frame.capture_time <= sample.time + 1e-6
        and finite(frame.deflection_T)
        and finite(frame.X_BT_at_capture.translation())
    )


def freshness(state: WeldingState, time: float) -> float:
    """Weight of the newest frame at a time s: 1 up to three camera periods of age, 0 from six on."""
    return clip(2.0 - (time - max(state.frame_time, state.started)) / 0.1, 0.0, 1.0)


def with_frame(state: WeldingState, sample: ServoSample, seam: SeamFrame, config: ServoConfig) -> WeldingState:
    """The state after a new frame: tip point, delta = P_r - P_s (Eq. 15), its part along n and the axial part."""
    frame = sample.deflection
    assert frame is not None
    deflection = (frame.deflection_T if state.zero is None else frame.deflection_T - state.zero) / state.gain
    X_BT = frame.X_BT_at_capture
    point = tip_point(X_BT, deflection)
    felt = felt_turn(state, point, seam, config) if state.proven else 0.0
    seam = turned(seam, felt)
    p_BT = np.asarray(X_BT.translation())
    delta = p_BT - point
    steer = _steering(state, delta, seam, config) if state.proven else 0.0
    seam = turned(seam, steer)
    delta_n, delta_axial = dot(delta, seam.normal), -dot(delta, seam.up)
    same = state.reading is not None and bool(np.array_equal(frame.deflection_T, state.reading))
    return changed(
        state,
        reading=frame.deflection_T,
        same_readings=state.same_readings + 1 if same and state.phase == Phase.TRACK else 0,
        measurement=Measurement(frame.capture_time, point, delta, p_BT),
        frame_time=frame.capture_time,
        delta_n=delta_n,
        delta_axial=delta_axial,
        felt=felt,
        steer=steer,
    )


def turned(seam: SeamFrame, angle: float) -> SeamFrame:
    """The seam's frame turned about its up by an angle rad."""
    if angle == 0.0:
        return seam
    c, s = math.cos(angle), math.sin(angle)
    return seam._replace(tangent=c * seam.tangent + s * seam.normal, normal=c * seam.normal - s * seam.tangent)


def felt_turn(state: WeldingState, point: Array, at: SeamFrame, config: ServoConfig) -> float:
    """Angle from the plan's tangent to the direction of the last tactile points, rad about up; zero where they agree.

    A plan rounds its corners, and beside a rounded corner its tangent is wrong by half of the turn. The direction of
    the last points is noisier than the plan's, so it is used only where the two differ clearly.
    """
    felt_path = config.felt_path
    seam = state.refined
    points = [point, *(q.point for q in reversed(seam.pending))]
    # On a stretch that was measured backwards the last committed points lie ahead.
    if not (seam.pending and len(seam) and seam.pending[0].arc + seam.jumped < seam.arc[-1]):
        points += [*seam.points[-1:-13:-1]]
    x, y = [0.0], [0.0]
    for earlier in points[1:]:
        back = earlier - point
        x.append(dot(back, at.tangent))
        y.append(dot(back, at.normal))
        if len(x) >= felt_path.points and math.hypot(x[-1], y[-1]) >= felt_path.length_m:
            break
    else:
        return 0.0
    n = len(x)
    mx, my = sum(x) / n, sum(y) / n
    xx = sum((v - mx) ** 2 for v in x)
    yy = sum((v - my) ** 2 for v in y)
    xy = sum((v - mx) * (w - my) for v, w in zip(x, y, strict=True))
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    # The principal axis has no direction; the path from the earliest to the newest point has.
    if math.cos(angle) * x[-1] + math.sin(angle) * y[-1] > 0.0:
        angle = math.remainder(angle + math.pi, 2.0 * math.pi)
    share = (abs(angle) - felt_path.dead_rad) / (felt_path.full_rad - felt_path.dead_rad)
    return clip(angle, -0.5 * math.pi, 0.5 * math.pi) * clip(share, 0.0, 1.0)


def _steering(state: WeldingState, delta: Array, seam: SeamFrame, config: ServoConfig) -> float:
    """Angle to turn the tip's frame about up, rad, where the deformation contradicts the plan's normal.

    The tip leans against the wall that stops it. A lean far from the plan's normal shows that the plan is wrong there,
    and moving on along its tangent would jam the tip; steady drag by friction is not such evidence. Two causes explain
    the lean: a plan that is ahead or behind at a corner, whose own tangent nearby then leaves no lean; or a wall where
    none is planned, to which the frame turns.
    """
    steering = config.steering
    lean, delta_n = dot(delta, seam.tangent), dot(delta, seam.normal)
    excess = max(0.0, abs(lean) - steering.drag_m)
    angle = -math.copysign(math.atan2(excess, max(delta_n, 0.5 * config.deflection.delta_d_m)), lean)
    share = clip((abs(angle) - steering.dead_rad) / (steering.full_rad - steering.dead_rad), 0.0, 1.0)
    if share == 0.0 or state.plan_fit is None:
        return 0.0
    curve, s, reach = state.plan_fit.curve, state.s_tip, steering.reach_m
    best = excess
    for k in (-8, -7, -6, -5, -4, -3, -2, -1, 1, 2, 3, 4, 5, 6, 7, 8):
        there = curve.frame(s + k * reach / 8.0).tangent
        cost = max(0.0, abs(dot(delta, there)) - steering.drag_m) + 0.02 * reach * abs(k)
        if cost < best:
            best = cost
            angle = math.atan2(dot(there, seam.normal), dot(there, seam.tangent))
    return angle * share


def beyond_limit(state: WeldingState, config: ServoConfig) -> bool:
    """Whether the newest frame shows a deflection beyond the tip's mechanical limits."""
    if state.measurement is None:
        return False
    lateral = math.sqrt(max(0.0, norm(state.measurement.delta) ** 2 - state.delta_axial**2))
    limits = config.faults
    return lateral > limits.lateral_m or state.delta_axial > limits.axial_m


def contact_lost(before: WeldingState, now: WeldingState, config: ServoConfig) -> bool:
    """Whether contact was lost between two frames: abrupt unloading, or too little deflection."""
    limits = config.contact
    if not now.proven:
        return now.delta_axial < 0.5 * limits.regain_axial_m
    # Both springs unload at once; one alone is a noisy frame or a rough wall.
    unloaded = min(before.delta_n - now.delta_n, before.delta_axial - now.delta_axial) > limits.drop_m
    return unloaded or now.delta_n < limits.normal_min_m or now.delta_axial < limits.axial_min_m


def with_point(state: WeldingState, config: ServoConfig) -> WeldingState:
    """The state with its newest tactile point queued, the oldest committed, and the plan moved onto the points."""
    deflection = config.deflection
    if state.settling:  # after a tack: until it is pressed in again, the ball rests higher
        pressed = min(state.delta_n / deflection.delta_d_m, state.delta_axial / deflection.axial_d_m)
        if pressed < _PRESSED:
            return changed(state, refined=drop_pending(state.refined))
        state = changed(state, settling=False)
    assert state.measurement is not None
    assert state.plan_fit is not None
    proven = state.proven or state.delta_n > 0.5 * deflection.delta_d_m
    if not (proven or state.delta_axial > 0.33 * deflection.axial_d_m):
        return changed(state, refined=drop_pending(state.refined), proven=proven)
    arc = progress_at(state, state.measurement.capture_time)
    plan_fit, corner = state.plan_fit, config.refinement.corner
    is_corner = plan_fit.curve.least_radius(state.s_tip, corner.reach_m) < corner.planned_radius_m
    refined = refine(state.refined, state.measurement.point, arc, config.refinement, is_corner)
    if len(refined) > len(state.refined):
        plan_fit = add_point(plan_fit, refined.points[-1], float(refined.arc[-1]), config.plan_fit)
        if plan_fit is not state.plan_fit and len(state.refined) >= LEAST_POINTS:
            # In a gap the torch's target must not move with the plan: the tool would roll with each new point.
            was = state.plan_fit.curve.frame(state.s_torch)
            now = plan_fit.curve.frame(plan_fit.curve.nearest(was.position, state.s_torch))
            off = was.position - now.position
            residual = state.residual + np.array((dot(off, now.normal), dot(off, now.up)))
            state = changed(state, residual=residual)
    return changed(state, refined=refined, plan_fit=plan_fit, proven=proven)


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
    furthest = max(state.furthest, progress)
    return changed(
        state, progress=progress, furthest=furthest, progress_log=(*state.progress_log[-31:], (time, progress))
    )
