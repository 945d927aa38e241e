"""The welding servo as one pure step: from the measured deflection and pose to the tool's motion and the arc."""

import math
from dataclasses import replace

import numpy as np

from weldcal.welding.numerics import Array, changed, clip, dot, finite
from weldcal.welding.passes.stitch import Stitch
from weldcal.welding.passes.tacks import LIFT_M_S, SLEW_M_S2
from weldcal.welding.seam.curve import SeamCurve, SeamError, SeamFrame
from weldcal.welding.seam.feasibility import InfeasibleSeam, check_feasible
from weldcal.welding.seam.plan_fit import PlanFit
from weldcal.welding.seam.refinement import drop_pending
from weldcal.welding.servo.arc import Stand, stand, stand_step, way_to_rest_m
from weldcal.welding.servo.contact import (
    contact_lost,
    freshness,
    is_new_frame,
    turned,
    with_frame,
    with_point,
    with_progress,
)
from weldcal.welding.servo.faults import advance, angles, fault, finish, goes_on, raised, unlit, watch
from weldcal.welding.servo.feel_start import BACK_STEPS, begin_feeling_back, feel_start_step, mean_residual
from weldcal.welding.servo.felt_before import with_felt_before
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Diagnostics, Phase, ServoSample, WeldingCommand, WeldingState
from weldcal.welding.servo.touch import check_length, touch_step
from weldcal.welding.servo.track import TickMotion, TorchTarget, guarded_motion, torch_target, weaving


def start_arc(state: WeldingState, curve: SeamCurve) -> float:
    """Arc length m on the moved plan at which the arc starts.

    The measured start of the groove, else the planned one.
    """
    return 0.0 if state.start_point is None else curve.nearest(state.start_point, 0.0, 0.02)


def current_piece(state: WeldingState, config: ServoConfig) -> Stitch | None:
    """Return the piece of the seam that is welded, or will be next; None after the last one."""
    assert state.plan_fit is not None
    start = start_arc(state, state.plan_fit.curve)
    return config.stitch.piece(max(state.stitched_to, start), start, state.s_end)


def stitched(state: WeldingState, config: ServoConfig) -> WeldingState:
    """Return the state after a piece: the arc off, and not seen yet in the next one."""
    piece = current_piece(state, config)
    to = state.s_end if piece is None else piece.end
    return changed(state, torch_on=False, arc_seen=False, arc_waited_s=0.0, stitched_to=to)


def with_arc(state: WeldingState, sample: ServoSample) -> WeldingState:
    """The state of a tick whose arc is established, or not asked for."""
    if not state.torch_on or (state.arc_seen and state.arc_waited_s == 0.0):
        return state
    # the ramp to rest has ended all speeds: they start again from zero
    lit_at = state.lit_at if state.arc_seen else sample.time
    return changed(state, arc_seen=True, arc_waited_s=0.0, lit_at=lit_at)


def wait_for_arc(
    state: WeldingState, sample: ServoSample, config: ServoConfig, dt: float
) -> tuple[WeldingState, Array, str | None]:
    """One tick with the torch on and no arc.

    The next state, the motion (6,) that ramps to rest, and the reason to stop.

    No time of standing counts as a lack of progress.
    """
    V_stop = state.V if state.arc_waited_s == 0.0 else state.V_stop
    waited = state.arc_waited_s + dt
    share = clip(1.0 - waited / config.limits.ramp_s, 0.0, 1.0)
    state = changed(
        state,
        arc_waited_s=waited,
        V_stop=V_stop,
        v_tip=0.0,
        omega=0.0,
        u_n=0.0,
        u_a=0.0,
        advanced=(state.advanced[0], sample.time),
    )
    torch = config.torch
    reason = None
    if not state.arc_seen and waited > torch.ignition_limit_s:
        reason = (
            f"The arc was not established within {torch.ignition_limit_s:g} s; check the power source, wire and gas."
        )
    elif state.arc_seen and waited > torch.arc_lost_s:
        reason = f"The arc went out for {torch.arc_lost_s:g} s; check the power source, wire and gas."
    return state, share * V_stop, reason


_DOWN_SHARE = 0.5  # a choice: of the wanted deflection, at which the ball is firmly in its joint
_IN_JOINT_M = 1.0e-3  # a choice: half of the lowest tack
_THERE_M = 0.3e-3  # from the plan: a tip that is not used has come down
_MOVING = (Phase.TRACK, Phase.COAST, Phase.FINISH)


def welding_step(
    state: WeldingState, sample: ServoSample, plan: SeamCurve, config: ServoConfig
) -> tuple[WeldingState, WeldingCommand]:
    """One tick (125 Hz) of Algorithm 2, guarded: TOUCH, TRACK, COAST over gaps, FINISH past the end, DONE or FAULT.

    Args:
        state: what the last tick returned; `WeldingState()` at the start.
        sample: time, pose of T in B, newest finger-camera frame.
        plan: the planned seam in B; it is read at the first tick and kept.
        config: settings.

    Returns:
        (state, command); every number of the command is finite. A fault takes the arc off at once, the motion within
        `ramp_s`, and stays until a new state is made. Source: flange calibration and tactile welding paper, Section
        2.2.2 and Algorithm 2, with the corrections of docs/weld_law.md.
    """
    if not math.isfinite(sample.time):
        state = fault(state, "The time of a servo tick is not a number; check the clock.")
        sample = replace(sample, time=state.time or 0.0)
    dt = config.period_s if state.time is None else clip(sample.time - state.time, 0.0, 0.05)
    if state.plan_fit is None and state.phase != Phase.FAULT:
        state = _begin(state, sample, plan, config)
    if not finite(sample.X_BT.translation()):
        state = fault(state, "The robot's pose is not a number; check the robot's connection.")
    clock_stopped_s = (
        state.clock_stopped_s + config.period_s if state.time is not None and sample.time <= state.time else 0.0
    )
    state = changed(state, time=sample.time, clock_stopped_s=clock_stopped_s)

    is_new = config.felt and state.phase not in (Phase.DONE, Phase.FAULT) and is_new_frame(state, sample)
    before = state
    if is_new:
        state = with_frame(state, sample, _frame_at_tip(state), config)
    state = watch(state, sample, config)
    if state.phase == Phase.TOUCH:
        return _touch(before, state, sample, is_new, config, dt)
    if is_new and state.phase in _MOVING:
        state = _contact(before, state, config)
    if state.phase in _MOVING and state.torch_on and not sample.arc:
        state, V, problem = wait_for_arc(state, sample, config, dt)
        return _answer(state, V, config, Diagnostics()) if problem is None else _rest(fault(state, problem), config)
    if state.phase in _MOVING and state.stand:
        state, V, over = stand_step(with_arc(state, sample), sample, config, dt)
        if over and config.stitch.on_m:
            state = changed(stitched(state, config), stand=Stand.NONE)
            over = state.stitched_to >= state.s_end
        return _rest(_done(state), config) if over else _answer(state, V, config, Diagnostics())
    if state.phase in _MOVING:
        return _weld(with_arc(state, sample), sample, config, dt)
    return _rest(state, config)


def _begin(state: WeldingState, sample: ServoSample, plan: SeamCurve, config: ServoConfig) -> WeldingState:
    tool = config.tool
    try:
        tip_line = plan.raised(tool.tip_seat_height_m) if tool.tip_seat_height_m else plan
        # Rest point and torch run along the tip's line, lower by the axial deflection.
        line = tip_line.raised(config.clearance_m) if config.clearance_m else tip_line
        check_length(tip_line, config)
        check_feasible(line, tool.torch_offset_m, config.weld_speed_m_s, config.windows)
    except (InfeasibleSeam, SeamError) as problem:
        return fault(state, str(problem))
    return changed(
        state, plan_fit=PlanFit.start(tip_line), started=sample.time, s_tip=config.touch.arc_m, s_end=tip_line.length
    )


def _frame_at_tip(state: WeldingState) -> SeamFrame:
    assert state.plan_fit is not None
    return state.plan_fit.curve.frame(state.s_tip)


def _touch(
    before: WeldingState, state: WeldingState, sample: ServoSample, is_new: bool, config: ServoConfig, dt: float
) -> tuple[WeldingState, WeldingCommand]:
    feels_start = config.felt and config.touch.feel_start
    assert state.plan_fit is not None
    seam, along, ready, problem = state.plan_fit.curve.frame(config.touch.arc_m), 0.0, False, None
    if not config.felt:
        gap = seam.position - sample.X_BT.translation()
        aside, above = dot(gap, seam.normal), dot(gap, seam.up)
        seated = math.hypot(aside, above) < _THERE_M
        lateral, upward = config.deflection.k_follow * aside, config.deflection.k_follow * above
    elif state.touch.step in BACK_STEPS:
        state, (along, lateral, upward), problem, ready = feel_start_step(before, state, sample, is_new, config)
        assert state.plan_fit is not None
        seam, seated = state.plan_fit.curve.frame(state.s_tip), False
    else:
        state, lateral, upward, problem, seated = touch_step(state, sample, is_new, seam, config)
    if problem is not None:
        return _rest(fault(state, problem), config)
    if seated and state.touch.felt and not feels_start:
        state, problem = with_felt_before(state, sample, config)
        if problem is not None:
            return _rest(fault(state, problem), config)
    state = _slewed(state, lateral, upward, config, dt)
    speed_up = config.limits.tip_acceleration_m_s2 * dt
    state = changed(state, v_tip=clip(along, state.v_tip - speed_up, state.v_tip + speed_up))
    V = np.concatenate([np.zeros(3), state.v_tip * seam.tangent + state.u_n * seam.normal + state.u_a * seam.up])
    if seated and feels_start:
        state = begin_feeling_back(state, sample.time)
    elif seated or ready:
        assert state.plan_fit is not None
        curve, p_BT = state.plan_fit.curve, np.asarray(sample.X_BT.translation())
        s = curve.nearest(p_BT, state.s_tip)
        p_BW = p_BT + sample.X_BT.rotation().matrix() @ config.p_TW
        s_torch = curve.nearest(p_BW, s - config.tool.torch_offset_m, 0.1)
        proven = config.felt and (seated or state.proven)
        phase = Phase.TRACK if config.felt else Phase.FINISH  # in which the tool follows the plan, here on its line
        state = changed(state, phase=phase, proven=proven, s_tip=s, progress=s, s_torch=s_torch, torch_arc=s_torch)
    return _answer(state, V, config, Diagnostics(omega=0.0))


def _contact(before: WeldingState, state: WeldingState, config: ServoConfig) -> WeldingState:
    """Change the phase by the contact that a new frame shows."""
    limits, end_window = config.contact, config.gap.end_window_m
    assert state.plan_fit is not None
    if state.phase == Phase.TRACK:
        lost = contact_lost(before, state, config)
        if (hop := config.hop_at(state.s_tip)) is not None and state.s_tip < hop.up:
            return changed(_coasting(drop(state), hop.down), settling=True)
        if not lost:
            return with_point(raised(state, config), config)
        state = drop(state)
        if state.s_tip > state.s_end - end_window:
            assert before.measurement is not None
            assert state.plan_fit is not None
            last = state.plan_fit.curve.nearest(before.measurement.point, state.s_tip)
            low, high = state.s_end - end_window, state.s_end + end_window
            if goes_on(state, config):
                high = state.s_end
            return changed(finish(state), s_end=clip(last, low, high))
        return _coasting(state, state.s_tip)
    if state.phase == Phase.COAST:
        # Just after the loss the springs are still relaxing: that is not a new contact.
        waited = state.frame_time - state.lost_time > limits.regain_after_s
        settled = waited and state.s_tip - state.lost_at > limits.regain_after_m
        touching = settled and state.delta_axial > limits.regain_axial_m and _as_low_as_before(state)
        regained = state.regained + 1 if touching else 0
        if regained >= limits.regain_frames:
            return changed(state, phase=Phase.TRACK, regained=0, proven=False)
        return changed(state, regained=regained)
    return state


def drop(state: WeldingState) -> WeldingState:
    """Return the state of a tip whose last points do not count."""
    return changed(state, refined=drop_pending(state.refined), proven=False, regained=0, steer=0.0, felt=0.0)


def _coasting(state: WeldingState, lost_at: float) -> WeldingState:
    """Return the state that coasts on the moved plan and what it was off; contact counts again from `lost_at` m."""
    residual = _tip_residual(state)
    return changed(state, phase=Phase.COAST, lost_at=lost_at, lost_time=state.frame_time, residual_at_loss=residual)


def _as_low_as_before(state: WeldingState) -> bool:
    """Whether a tip that comes down after a tack is in the joint, not on the tack or on the face beside."""
    if not state.settling:
        return True
    assert state.measurement is not None
    assert state.plan_fit is not None
    point = state.measurement.point
    _, above = mean_residual(point[None], state.plan_fit.curve, state.s_tip)
    return bool(above - state.residual_at_loss[1] < _IN_JOINT_M)


def _tip_residual(state: WeldingState) -> Array:
    """Mean offset of the newest tactile points from the moved plan, (2,) m to the left and up."""
    assert state.plan_fit is not None
    return mean_residual(state.refined.points[-8:], state.plan_fit.curve, state.s_tip)


def _weld(
    state: WeldingState, sample: ServoSample, config: ServoConfig, dt: float
) -> tuple[WeldingState, WeldingCommand]:
    """One tick in TRACK, COAST or FINISH: the tip along the seam, the torch to its target, the arc on its pieces."""
    state, seam, off = _on_seam(state, sample)
    state = _ended(state, config)
    if state.phase == Phase.FAULT:
        return _rest(state, config)
    if state.phase == Phase.FINISH and math.isnan(state.hold[0]):
        state = changed(state, hold=off - _press(config))
    state, target, motion, error = _moved(state, sample, seam, off, config, dt)
    state, problem = _torch_problem(state, sample, target, error, config)
    state, why, problem = _arc_step(state, sample.time, target.s, motion.v_torch, error, problem, config)
    if why is not None:
        # The tool begins to come to rest, with the motion of this tick still.
        state = stand(changed(state, V=motion.V_BT), why)
        return _answer(state, state.V_stop, config, Diagnostics())
    if problem is not None:
        return _rest(fault(state, problem), config)
    if target.s >= state.s_end:
        return _rest(_done(state), config)
    diagnostics = Diagnostics(
        e_t=error[0],
        e_height=error[1],
        n_d_dot_n_t=motion.conditioning.cos_torch,
        conditioning=motion.conditioning.value,
        omega=motion.omega,
        torch_speed=motion.v_torch,
        tip_speed=motion.v_tip,
        p_BTorch_target=target.point,
    )
    return _answer(state, motion.V_BT, config, diagnostics)


def _on_seam(state: WeldingState, sample: ServoSample) -> tuple[WeldingState, SeamFrame, Array]:
    """The state with the tip's arc length, the seam's frame there, and what the tool is off it: (2,) m left and up."""
    assert state.plan_fit is not None
    curve = state.plan_fit.curve
    p_BT = np.asarray(sample.X_BT.translation())
    at = p_BT
    if state.measurement is not None and (state.phase == Phase.TRACK or state.settling):
        # The tool cuts a corner on its inside and is next to the second leg while the tip is still on the first.
        at = state.measurement.point + (p_BT - state.measurement.p_BT)
    s_tip = curve.nearest(at, state.s_tip)
    seam = curve.frame(s_tip)
    gap = p_BT - seam.position
    return changed(state, s_tip=s_tip), seam, np.array((dot(gap, seam.normal), dot(gap, seam.up)))


def _ended(state: WeldingState, config: ServoConfig) -> WeldingState:
    """FAULT where the tip coasts for too long, FINISH where it is past the end of what it feels; else as it is."""
    assert state.plan_fit is not None
    tracks, cut_short = state.phase == Phase.TRACK, goes_on(state, config)
    if state.phase == Phase.COAST and state.s_tip - state.lost_at > config.gap.coast_m:
        text = f"Contact lost for {1e3 * config.gap.coast_m:.0f} mm in the middle of the seam; check the groove there."
        return fault(state, text)
    # A groove that is drawn on past the seam's end is felt on; only a gap there ends the feeling.
    last = state.plan_fit.curve.drawn_m if cut_short and tracks else state.s_end
    if state.phase == Phase.FINISH or state.s_tip <= last + (config.gap.end_window_m if tracks else 0.0):
        return state
    # Still in contact this far beyond the plan's end: the seam does not end before this point.
    return finish(changed(state, s_end=state.s_tip) if tracks and not cut_short else state)


def _moved(
    state: WeldingState, sample: ServoSample, seam: SeamFrame, off: Array, config: ServoConfig, dt: float
) -> tuple[WeldingState, TorchTarget, TickMotion, tuple[float, float]]:
    """The motion of this tick, the torch's target, and what the wire is off it: m to the left and up."""
    assert state.plan_fit is not None
    curve = state.plan_fit.curve
    state = _slewed(state, *_servo(state, off, sample, config), config, dt)
    p_BW = np.asarray(sample.X_BT.translation()) + sample.X_BT.rotation().matrix() @ config.p_TW
    target = torch_target(state, curve, p_BW, config)
    if state.torch_on and config.weave.amplitude_m > 0.0:
        state, target = weaving(state, target, p_BW, sample.time - state.lit_at, config, dt)
    motion = guarded_motion(
        state, sample.X_BT, turned(seam, state.felt + state.steer), target, (state.u_n, state.u_a), config, dt
    )
    e = p_BW - target.point
    state = changed(
        with_progress(state, sample.time, motion.v_tip, dt),
        s_torch=target.s,
        torch_arc=target.arc,
        residual=target.residual,
        v_tip=motion.v_tip,
        omega=motion.omega,
    )
    return state, target, motion, (dot(e, target.normal), dot(e, target.up))


def _torch_problem(
    state: WeldingState, sample: ServoSample, target: TorchTarget, error: tuple[float, float], config: ServoConfig
) -> tuple[WeldingState, str | None]:
    """The state with the torch's progress; a sentence where it stands, is too far off or leaves its angles."""
    state, problem = advance(state, target.s, sample.time, config)
    problem = problem or angles(sample, target, config)
    off_m = math.hypot(*error)
    if problem is None and state.torch_on and off_m > config.faults.torch_error_m:
        problem = f"The torch is {1e3 * off_m:.1f} mm off the seam; check the groove and the plan."
    return state, problem


def _arc_step(
    state: WeldingState,
    now: float,
    s: float,
    v_torch: float,
    error: tuple[float, float],
    problem: str | None,
    config: ServoConfig,
) -> tuple[WeldingState, Stand | None, str | None]:
    """The arc at arc length `s` m of the torch: the next state, why the tool comes to rest, and the problem left.

    A problem stops what burns or coasts at once. On the way to a piece only an arc that is not lit counts.
    """
    piece, torch = current_piece(state, config), config.torch
    if piece is None or (problem is not None and (state.torch_on or state.phase == Phase.COAST)):
        return state, None, problem
    on_the_way, off_m = way_to_rest_m(v_torch, config), math.hypot(*error)
    # Once started the arc burns to the end: the plan may still move back under a torch that has just passed its start.
    there = s >= piece.start - (on_the_way if torch.from_rest else 0.0) and off_m < torch.ignition_error_m
    burning = (state.torch_on or there) and s < piece.end
    if burning and not state.torch_on and torch.from_rest:
        return state, Stand.START, None
    if burning and state.torch_on and torch.crater_s > 0.0 and s >= piece.end - on_the_way:
        return state, Stand.CRATER, None
    if config.stitch.on_m > 0.0 and state.torch_on and not burning:
        return stitched(state, config), None, None
    state = changed(state, torch_on=burning, lit_at=now if burning and not state.torch_on else state.lit_at)
    return state, None, unlit(state, s, s - piece.start, off_m, config)


def _done(state: WeldingState) -> WeldingState:
    """The end of the seam: the arc off, and the motion to rest."""
    return changed(state, phase=Phase.DONE, torch_on=False, V_stop=state.V, stopped_ticks=0)


def _servo(state: WeldingState, off: Array, sample: ServoSample, config: ServoConfig) -> tuple[float, float]:
    """The tip's wanted lateral and upward speed, m/s.

    From the deflection in TRACK, from the moved plan in COAST and FINISH.
    """
    deflection = config.deflection
    if state.phase == Phase.TRACK:
        # A late frame shows where the tip was, not where it is: its correction fades out.
        fresh = freshness(state, sample.time)
        lateral = deflection.k_p * (deflection.delta_d_m - state.delta_n)
        return fresh * lateral, fresh * deflection.k_z * (state.delta_axial - deflection.axial_d_m)
    wanted, rise = state.hold + _press(config), np.zeros(2)
    if state.phase == Phase.COAST:
        # after a tack the plan may have come off by more than over a gap: the tip comes down deeper
        place = np.array((0.0, -_DOWN_SHARE * deflection.axial_d_m if state.settling else -config.gap.hover_m))
        hop = config.hop_at(state.s_tip)
        if hop is not None:
            # released as slowly to the side as it is lifted: the tool turns about the torch for both
            place, slope = hop.place(state.s_tip, _press(config), place)
            rise = slope * state.v_tip
        wanted = state.residual_at_loss + place
    lateral, upward = deflection.k_follow * (wanted - off) + rise
    return float(lateral), float(upward)


def _press(config: ServoConfig) -> Array:
    """The wanted place (2,) m of the tip's rest point beside and above its seat."""
    return np.array((config.deflection.delta_d_m, -config.deflection.axial_d_m))


def _slewed(state: WeldingState, lateral: float, upward: float, config: ServoConfig, dt: float) -> WeldingState:
    """The state with the servo speeds limited in speed and slew."""
    deflection = config.deflection
    hops = state.phase == Phase.COAST and config.hop_at(state.s_tip) is not None
    faster = LIFT_M_S if hops else config.touch.fast_m_s if state.phase == Phase.TOUCH else 0.0
    top, step = max(deflection.speed_m_s, faster), (SLEW_M_S2 if hops else deflection.slew_m_s2) * dt
    u_n = clip(clip(lateral, -top, top), state.u_n - step, state.u_n + step)
    u_a = clip(clip(upward, -top, top), state.u_a - step, state.u_a + step)
    return changed(state, u_n=u_n, u_a=u_a)


def _rest(state: WeldingState, config: ServoConfig) -> tuple[WeldingState, WeldingCommand]:
    """The answer in DONE and FAULT: the last motion ramps to zero with the arc off, by ticks.

    The clock may be faulty.
    """
    share = clip(1.0 - state.stopped_ticks * config.period_s / config.limits.ramp_s, 0.0, 1.0)
    state = changed(state, torch_on=False, stopped_ticks=state.stopped_ticks + 1)
    return _answer(state, share * state.V_stop, config, Diagnostics())


def _answer(
    state: WeldingState, V: Array, config: ServoConfig, diagnostics: Diagnostics
) -> tuple[WeldingState, WeldingCommand]:
    if not finite(V):
        state = fault(
            state, "The welding law returned a number that is not finite: this is a defect, report it with a recording."
        )
        V = state.V_stop
    measurement = state.measurement
    diagnostics = changed(
        diagnostics,
        delta_n=state.delta_n,
        delta_axial=state.delta_axial,
        s_tip=state.s_tip,
        s_torch=state.s_torch,
        p_BTip=None if measurement is None else measurement.point,
        gain=state.gain,
        n_points=len(state.refined),
    )
    state = changed(state, V=V)
    return state, WeldingCommand(V, state.torch_on, state.phase, state.reason, diagnostics)
