"""The faults of a weld: what is watched in each phase, and the sentence that ends it."""

import math
from dataclasses import replace

import numpy as np

from weldcal.welding.numerics import changed, clip, dot
from weldcal.welding.servo.contact import beyond_limit
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase, ServoSample, WeldingState
from weldcal.welding.servo.track import TorchTarget

_FALL_M = 0.5e-3  # half of what the lowest tack lifts a tip that is seated above the plan
# A frame: at 8 mm/s a slope of 7 %, five times that of a plan by a scanner that nobody has corrected.
_FOLLOW_M = 0.02e-3


def fault(state: WeldingState, reason: str) -> WeldingState:
    """Enter FAULT with a reason and the arc off in this tick; the first fault is kept."""
    if state.phase == Phase.FAULT:
        return state
    return changed(state, phase=Phase.FAULT, reason=reason, torch_on=False, V_stop=state.V, stopped_ticks=0)


def watch(state: WeldingState, sample: ServoSample, config: ServoConfig) -> WeldingState:
    """Check the faults of every phase: stopped clock, deflection beyond its limit, hidden tag, frozen camera."""
    faults = config.faults
    if state.phase in (Phase.DONE, Phase.FAULT):
        return state
    if state.clock_stopped_s > faults.hidden_s:
        # The arm may still move, and by a stopped clock no frame is ever late.
        text = f"The robot's clock has stood still for {state.clock_stopped_s:.2f} s; check the robot's connection."
        return fault(state, text)
    if not config.felt:
        return state
    # Past the end of a seam cut short the tip is not needed: what it feels, or does not, is no reason to stop the
    # torch.
    needed = state.phase != Phase.TRACK or state.s_tip <= state.s_end or not goes_on(state, config)
    if beyond_limit(state, config) and state.phase != Phase.FINISH:
        text = "The tip is pushed beyond its mechanical limit; clear the groove, or check the plan."
        return fault(state, text) if needed else finish(state)
    blind = sample.time - max(state.frame_time, state.started)
    if blind > faults.hidden_s and state.phase != Phase.FINISH:
        return fault(state, _blind_sentence(state, sample, blind, faults.hidden_s)) if needed else finish(state)
    # Identical readings to the last bit mean one picture repeated with new times.
    if state.same_readings >= faults.frozen_frames:
        text = f"The finger camera repeats one picture ({state.same_readings} identical readings); restart the camera."
        return fault(state, text)
    return state


def _blind_sentence(state: WeldingState, sample: ServoSample, blind_s: float, limit_s: float) -> str:
    """Why there is no reading: pictures come and do not show the tag, or none came."""
    newest = sample.deflection
    without_s = sample.time - max(state.started, -math.inf if newest is None else newest.capture_time)
    if without_s > limit_s:
        return f"No picture from the finger camera for {without_s:.2f} s; check its power, its cable and the network."
    return f"Tag hidden: the finger camera has not seen it for {blind_s:.2f} s; clean the tag and its window."


def goes_on(state: WeldingState, config: ServoConfig) -> bool:
    """Whether the seam is cut short of its groove: where it ends was said, and does not have to be felt."""
    if state.plan_fit is None:
        return False
    plan = state.plan_fit.plan
    return plan.drawn_m > plan.length + config.gap.end_window_m


def finish(state: WeldingState) -> WeldingState:
    """Enter FINISH: from here on the tip is not used, and holds its offset to the plan from the next tick."""
    return changed(state, phase=Phase.FINISH, steer=0.0, felt=0.0, hold=np.full(2, math.nan))


def raised(state: WeldingState, config: ServoConfig) -> WeldingState:
    """Check, until the arc is lit, that a tip that was seated above the plan does not fall: it was not in the root."""
    t, fit, last = state.touch, state.plan_fit, state.measurement
    if math.isnan(t.raised_m) or math.isfinite(state.lit_at) or fit is None or last is None:
        return state
    frame = fit.plan.frame(state.s_tip)
    rise = dot(last.point - frame.position, frame.up) - t.raised_m
    if rise < -_FALL_M:
        text = "The tip was seated on something above the seam and fell off it; clear the joint, and scan again."
        return fault(state, text)
    return changed(state, touch=replace(t, raised_m=t.raised_m + clip(rise, -_FOLLOW_M, _FOLLOW_M)))


def unlit(state: WeldingState, s_torch: float, past_start: float, error: float, config: ServoConfig) -> str | None:
    """Fault sentence where the arc is still not lit so far past the piece's start, or at the seam's end, else None."""
    on_m, window_m = config.stitch.on_m, config.torch.ignition_window_m
    if on_m:
        window_m = min(window_m, 0.5 * on_m)
    lit = state.torch_on if on_m else math.isfinite(state.lit_at)
    if lit or (past_start <= window_m and (s_torch < state.s_end or math.isfinite(state.lit_at))):
        return None
    return (
        f"Not welded: {1e3 * past_start:.0f} mm past the seam's start the arc is not lit, because the torch is"
        f" {1e3 * error:.2f} mm off the seam (limit {1e3 * config.torch.ignition_error_m:.2g} mm); check the plan's"
        " start."
    )


def advance(state: WeldingState, s_torch: float, now: float, config: ServoConfig) -> tuple[WeldingState, str | None]:
    """Check that the torch advances by half a millimetre in `stall_s`; otherwise return a fault sentence."""
    faults = config.faults
    since, s = state.advanced
    if abs(s_torch - s) > 0.5e-3:
        return changed(state, advanced=(now, s_torch)), None
    if now - since <= faults.stall_s:
        return state, None
    return (
        state,
        f"The torch has stood at {1e3 * s_torch:.0f} mm for {faults.stall_s:.0f} s; check the seam's shape there.",
    )


def angles(sample: ServoSample, target: TorchTarget, config: ServoConfig) -> str | None:
    """Fault sentence for a work or travel angle beyond its window plus a margin for the plan's error, or None."""
    R = sample.X_BT.rotation().matrix()
    margin = math.radians(5.0)
    travel = math.asin(clip(dot(R[:, 0], target.up), -1.0, 1.0)) + config.windows.tilt_rad
    work = math.asin(clip(dot(R[:, 1], target.up), -1.0, 1.0)) - config.torch.work_angle_rad
    for name, angle, limit in (("travel", travel, config.windows.travel_rad), ("work", work, config.windows.work_rad)):
        if abs(angle) > limit + margin:
            return (
                f"The {name} angle is {math.degrees(angle):.1f} deg, beyond its window of {math.degrees(limit):.0f}"
                " deg; check the plan's surface."
            )
    return None
