"""The TOUCH phase: descend next to the planned seam and search sideways until the tip is seated in the groove."""

import math
from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.welding.numerics import changed, clip, dot, pose, unit
from weldcal.welding.seam.curve import SeamCurve, SeamError, SeamFrame
from weldcal.welding.servo.contact import freshness
from weldcal.welding.servo.settings import ServoConfig, TouchOnConfig
from weldcal.welding.servo.state import GainFit, ServoSample, WeldingState

_TAG_SIGMA_M = 0.05e-3  # sigma of a frame's deflection in the gain fit
_SEATED_FRAMES = 3
_WALL_FRAMES = 15
# A choice: a ball at rest leans as the servo wants; one that leans by 15 % more still slides down its wall.
_SLIDING_LEAN = 1.15
_REST_M = 0.3e-3  # six sigma of the tag's noise: a ball whose height changes by more still slides down its wall


def touch_start_pose(plan: SeamCurve, config: ServoConfig) -> RigidTransform:
    """Start pose X_BT of the weld: above the face, on the -n side of the seam's start, torch behind.

    Args:
        plan: the planned seam in B.
        config: geometry; the tip's line is `tool.tip_seat_height_m` above the plan.
    """
    touch, tool = config.touch, config.tool
    frame = plan.frame(touch.arc_m)
    behind = plan.frame(touch.arc_m - tool.torch_offset_m)
    # Along the chord, so that the torch is on the seam too where the face turns along it, as on a pipe.
    x = unit(frame.position - behind.position, frame.tangent)
    y, lean = unit(np.cross(frame.up, x), frame.normal), config.torch.work_angle_rad
    y = math.cos(lean) * y + math.sin(lean) * np.cross(x, y)
    R = np.column_stack([x, y, np.cross(x, y)])
    height = tool.tip_seat_height_m + tool.tip_drop_m + touch.height_m
    p_BT = frame.position + height * frame.up + touch.offset_m * frame.normal
    return pose(R, p_BT)


def check_length(line: SeamCurve, config: ServoConfig) -> None:
    """Check that the tip's line is long enough to be touched before its end.

    Raises:
        SeamError: with the least length.
    """
    least = config.touch.arc_m + config.gap.end_window_m
    # Where a plan moves the touch ahead, the groove may be touched past the seam's end.
    room = line.drawn_m if config.touch.arc_m > TouchOnConfig.arc_m else line.length
    if room < least:
        raise SeamError(
            f"The seam is only {1e3 * room:.0f} mm long: too short for the touch-on, which needs {1e3 * least:.0f} mm."
        )


def touch_step(
    state: WeldingState, sample: ServoSample, is_new: bool, seam: SeamFrame, config: ServoConfig
) -> tuple[WeldingState, float, float, str | None, bool]:
    """One tick of the touch search.

    Args:
        seam: the tip's planned line at the touch arc; `is_new`: whether the state holds a frame of this tick.

    Returns:
        (state, wanted lateral speed, wanted upward speed m/s, fault sentence or None, whether the tip is seated).
    """
    deflection = config.deflection
    touch, t = config.touch, state.touch
    gap = sample.X_BT.translation() - seam.position
    left, height = dot(gap, seam.normal), dot(gap, seam.up)
    deep, fresh = state.delta_axial, freshness(state, sample.time)
    depth_servo = fresh * clip(
        deflection.k_z * (deep - deflection.axial_d_m), -deflection.speed_m_s, deflection.speed_m_s
    )
    # After contact with the face it may descend by the groove's depth more.
    floor = (config.tool.tip_drop_m if t.step == "descend" else 0.0) - touch.depth_m - deflection.axial_d_m
    if height < floor:
        return state, 0.0, 0.0, _no_work(state, sample, height, config), False

    if t.step == "descend":
        if state.zero is None and touch.zero_frames > 0:
            state, problem = _zeroed(state, sample, is_new, config)
            return state, 0.0, 0.0, problem, False
        fast = height > config.tool.tip_drop_m + touch.slow_height_m and deep < 0.3 * deflection.axial_d_m
        speed = touch.fast_m_s if fast else touch.slow_m_s
        if is_new and deep > 0.9 * deflection.axial_d_m:
            return _next(state, "settle", sample.time), 0.0, 0.0, None, False
        down = min(speed, deflection.k_z * max(0.0, deflection.axial_d_m - deep) + 0.3e-3)
        return state, 0.0, -fresh * down, None, False

    assert state.measurement is not None
    tip_height = dot(state.measurement.point - seam.position, seam.up)
    if t.step == "settle":
        if sample.time - t.since < touch.settle_s:
            return state, 0.0, depth_servo, None, False
        t = replace(t, step="search", since=sample.time, face_height=tip_height, start_left=left)
        return changed(state, touch=t), 0.0, depth_servo, None, False

    if t.step == "search":
        return _search(state, is_new, left, tip_height, depth_servo, fresh, config, sample.time)
    return _press(state, sample, is_new, left, seam, config)


def _no_work(state: WeldingState, sample: ServoSample, height: float, config: ServoConfig) -> str:
    """Fault sentence for a tip that is too deep: its depth, its last deflection and the age of that reading."""
    below = 1e3 * (config.tool.tip_drop_m - height)
    if state.measurement is None:
        read = "without a valid view of its tag"
    else:
        age = sample.time - state.measurement.capture_time
        read = f"and it read {1e3 * state.delta_axial:.1f} mm of deflection {age:.2f} s ago"
    where = "found no surface" if state.touch.step == "descend" else "lost the surface"
    return (
        f"Seam not found: the tip {where} (its rest is {below:.1f} mm below where it should meet the face, {read}); "
        "check the plan's height."
    )


def _zeroed(
    state: WeldingState, sample: ServoSample, is_new: bool, config: ServoConfig
) -> tuple[WeldingState, str | None]:
    """Average the readings of the free tip as the tag's zero, which removes the tag's bias."""
    touch, t = config.touch, state.touch
    if not is_new or sample.deflection is None:
        return state, None
    free = (*t.free, np.asarray(sample.deflection.deflection_T, dtype=float))
    if len(free) < touch.zero_frames:
        return changed(state, touch=replace(t, free=free)), None
    readings = np.array(free)
    zero = readings.mean(axis=0)
    if max(float(np.abs(zero).max()), float(np.ptp(readings, axis=0).max())) > touch.zero_limit_m:
        text = (
            f"The tip is not free before touch-on: it reads {1e3 * float(np.linalg.norm(zero)):.1f} mm; raise the start"
            " pose."
        )
        return state, text
    return changed(state, zero=zero, touch=replace(t, free=())), None


def _search(
    state: WeldingState,
    is_new: bool,
    left: float,
    tip_height: float,
    depth_servo: float,
    fresh: float,
    config: ServoConfig,
    now: float,
) -> tuple[WeldingState, float, float, str | None, bool]:
    deflection = config.deflection
    touch, t = config.touch, state.touch
    half_drop = 0.5 * config.tool.tip_drop_m
    # Beside a guiding joint is no face: high above the plan the ball is in the root only where it does not slide.
    guiding = touch.offset_m == 0.0
    dropped = tip_height < (0.5 * half_drop if guiding else max(half_drop, t.face_height - half_drop))
    # A ball that slides down its wall leans by a sixth more than wanted, at the least: friction 0.2, up to 120 deg.
    leaning = 0.9 < state.delta_n / deflection.delta_d_m < (_SLIDING_LEAN if guiding else math.inf)
    frames = t.seated_frames
    if is_new:
        pressed = abs(state.delta_axial - deflection.axial_d_m) < 0.25 * deflection.axial_d_m
        slides = guiding and not dropped and not abs(tip_height - t.rest_m) < _REST_M
        frames = frames + 1 if leaning and not slides and (pressed or not dropped) else 0
        t = replace(t, seated_frames=frames, rest_m=tip_height if slides else t.rest_m)
        state = changed(state, touch=t)
    guided = guiding and frames >= _WALL_FRAMES and tip_height < touch.above_m
    if guided or (dropped and frames >= _SEATED_FRAMES):
        state = changed(state, touch=replace(t, raised_m=math.nan if dropped else tip_height))
        if not touch.calibrate_gain:
            return state, 0.0, depth_servo, None, True
        return _next(state, "press up", now, left), 0.0, 0.0, None, False
    if not dropped and frames >= _WALL_FRAMES:
        return (
            state,
            0.0,
            0.0,
            "Seam not found: the tip met a wall but no groove; check the plan and clear the workpiece.",
            False,
        )
    if left - t.start_left > touch.range_m:
        text = f"Seam not found within {1e3 * touch.range_m:.0f} mm; check the plan, or scan the workpiece again."
        return state, 0.0, 0.0, text, False
    # A tip falling into the groove is hardly pressed down: wait for the depth servo, or it climbs over the far wall.
    held = fresh * clip(2.0 * state.delta_axial / deflection.axial_d_m - 0.5, 0.0, 1.0)
    lateral = clip(deflection.k_p * (deflection.delta_d_m - state.delta_n), -touch.search_m_s, touch.search_m_s)
    return state, held * lateral, depth_servo, None, False


_LEGS = {"press up": ("press down", 1.0), "press down": ("press back", -1.0), "press back": ("", 0.0)}


def _press(
    state: WeldingState, sample: ServoSample, is_new: bool, left: float, seam: SeamFrame, config: ServoConfig
) -> tuple[WeldingState, float, float, str | None, bool]:
    """Press the seated tip against the wall and back: the wall is fixed, so deflection per motion is the tag's gain."""
    deflection = config.deflection
    touch, t = config.touch, state.touch
    following, sign = _LEGS[t.step]
    if is_new and state.measurement is not None and state.measurement.capture_time >= t.since - 1.0:
        x = dot(state.measurement.p_BT - seam.position, seam.normal)
        t = replace(t, gain_fit=_add(t.gain_fit, x, state.delta_n))
        state = changed(state, touch=t)
    target = t.start_left + sign * (touch.press_ratio - 1.0) * deflection.delta_d_m
    gap = target - left
    if abs(gap) > 0.05e-3:
        return state, clip(deflection.k_p * gap, -touch.press_m_s, touch.press_m_s), 0.0, None, False
    if following:
        return _next(state, following, sample.time, t.start_left), 0.0, 0.0, None, False
    return changed(state, gain=_gain(t.gain_fit, config)), 0.0, 0.0, None, True


def _add(fit: GainFit, x: float, y: float) -> GainFit:
    return GainFit(fit.n + 1, fit.x + x, fit.y + y, fit.xx + x * x, fit.xy + x * y)


def _gain(fit: GainFit, config: ServoConfig) -> float:
    """Slope of deflection over motion, regularised towards 1."""
    if fit.n < 3:
        return 1.0
    sxx, sxy = fit.xx - fit.x**2 / fit.n, fit.xy - fit.x * fit.y / fit.n
    information, prior = sxx / _TAG_SIGMA_M**2, 1.0 / config.touch.gain_sigma**2
    return clip((sxy / _TAG_SIGMA_M**2 + prior) / (information + prior), 0.7, 1.3)


def _next(state: WeldingState, step: str, now: float, left: float | None = None) -> WeldingState:
    t = replace(state.touch, step=step, since=now, seated_frames=0)
    return changed(state, touch=t if left is None else replace(t, start_left=left))
