"""The guarded law: computes tip speed and turning rate that keep the torch on the seam at its speed."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform

from weldcal.welding.numerics import Array, box_least_squares, changed, clip, cross, dot, norm, unit
from weldcal.welding.seam.curve import SeamCurve, SeamFrame
from weldcal.welding.seam.refinement import LocalFit, RefinedSeam, local_fit
from weldcal.welding.servo.contact import LEAST_POINTS
from weldcal.welding.servo.guards import SeamConditioning, seam_conditioning
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import WeldingState
from weldcal.welding.servo.tool_axes import height_share, roll_rate, tool_axes
from weldcal.welding.servo.weave import learn, weave_at

_SHARP_PER_M = 100.0  # a planned radius of 10 mm: a corner that the plan has rounded
_CARRY_M = 5.0e-3  # the last millimetres before the seam's end give no committed point
_BEND_OVER_M = (
    3.0e-3,
    10.0e-3,
)  # least and most length of path whose bend is extrapolated; 0.4 of the plan's radius between
_RISE = 0.05  # slope of the path against the plan's surface
_WINDOW_M = 5.0e-3  # two sigma of the widest fit
_PITCH_SHARE = 0.95  # a choice: the tip's speed is that of the tick before
_EDGE_POINTS = 30  # points on a gap's side: 8 mm at the nominal speed and frame rate


class TorchTarget(NamedTuple):
    """The torch's target: point m, tangent, normal, up (3,), path parameter m, plan arc m, residual (2,) m.

    `bend`: of the path to the left, 1/m; `rate`: of the weave, along the seam, to the left and up, m/s; `turning`: the
    weave's largest acceleration to the side, m/s^2.
    """

    point: Array
    tangent: Array
    normal: Array
    up: Array
    arc: float
    s: float
    residual: Array
    bend: float = 0.0
    rate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turning: float = 0.0


@dataclass(frozen=True)
class TickMotion:
    """The motion of one tick: V_BT (6,), tip and torch speed m/s, rate about the tool's up rad/s, conditioning."""

    V_BT: Array
    v_tip: float
    v_torch: float
    omega: float
    conditioning: SeamConditioning


def torch_target(state: WeldingState, curve: SeamCurve, p_BW: Array, config: ServoConfig) -> TorchTarget:
    """The refined path at the torch; in gaps the moved plan plus the residual measured nearby.

    Args:
        curve: the tip line of the plan, registered to the tactile points.
        p_BW: torch point, (3,) m.
    """
    tool = config.tool
    s = curve.nearest(p_BW - config.clearance_m * np.array(curve.frame_numbers(state.s_torch)[9:12]), state.s_torch)
    plan = curve.frame(s)
    seam = state.refined
    residual, fit, arc = state.residual, None, state.torch_arc
    drift = np.zeros(2)
    if len(seam) >= LEAST_POINTS:
        first, last = float(seam.arc[0]), float(seam.arc[-1])
        inside = clip(arc, first + 1e-3, max(last - 1e-3, first + 1e-3))
        radius = 1.0 / max(abs(plan.curvature), 1e-6)
        if _nearest_point(seam.arc, inside) < config.refinement.bridge_from_m:
            fit = local_fit(seam, inside, plan.tangent, radius, config.refinement, curve.least_radius(s, _WINDOW_M))
        # Before the first point, and where the window is empty, the plan plus the nearest residual is used.
        if fit is not None:
            here = curve.frame(curve.nearest(fit.point, s + inside - arc))
            off = fit.point - here.position
            residual = np.array((dot(off, here.normal), dot(off, here.up)))
            if inside != arc:
                fit = _carried_on(seam, fit, inside, arc, plan, config) if arc > last else None
        else:
            # The change is spread over the path, so that the torch makes no step.
            step = 0.05 * abs(s - state.s_torch)
            residual = state.residual + np.clip(_bridged(state, curve, arc, s) - state.residual, -step, step)
            came_on = s - state.s_torch
            drift = (residual - state.residual) / came_on if came_on > 1e-6 else drift
    if fit is None:
        # The torch follows the target's direction, not the plan's.
        t, bend = unit(plan.tangent + drift[0] * plan.normal + drift[1] * plan.up, plan.tangent), plan.curvature
        up = unit(plan.up - dot(plan.up, t) * t, plan.up)
        on_path = plan.position + residual[0] * plan.normal + residual[1] * up
        step = s - state.s_torch
    else:
        # The plan gives the surface better than a few points near a corner: the path leaves it by three degrees at
        # most.
        rise = dot(fit.tangent, plan.up)
        t = unit(fit.tangent + (clip(rise, -_RISE, _RISE) - rise) * plan.up, fit.tangent)
        on_path = fit.point
        up = unit(plan.up - dot(plan.up, t) * t, plan.up)
        step = dot(p_BW - on_path, t) / fit.speed
    n = cross(up, t)
    if fit is not None:
        bend = dot(fit.bend, n) / fit.speed**2
        if abs(plan.curvature) > _SHARP_PER_M:
            # At a sharp corner the bend here does not describe the path a moment later, and turning the torch's path
            # takes a ramp at the limit of the turning rate, of which half counts as lag.
            speed = config.weld_speed_m_s
            ramp = speed / (config.tool.torch_offset_m * config.limits.omega_acceleration_rad_s2)
            then = local_fit(
                seam,
                arc + speed * (config.lag_s + 0.5 * ramp),
                plan.tangent,
                1.0 / abs(plan.curvature),
                config.refinement,
            )
            if then is not None:
                bend = math.asin(clip(dot(then.tangent, n), -1.0, 1.0)) / (speed * config.lag_s)
    if config.clearance_m:
        # Where the surface twists along the seam, the direction of a line above or below it differs slightly.
        h = 2.0e-3
        up_after, up_before = (np.array(curve.frame_numbers(at)[9:12]) for at in (s + h, s - h))
        twist = dot(up_after - up_before, n) / (2.0 * h)
        t = unit(t + config.clearance_m * twist * n, t)
        n = cross(up, t)
    point = on_path + config.clearance_m * up + tool.side_offset_m * n
    ahead = dot(p_BW - point, t)
    return TorchTarget(
        point=point + ahead * t,
        tangent=t,
        normal=n,
        up=up,
        arc=arc + clip(step, -2e-3, 2e-3),
        s=s,
        residual=residual,
        bend=bend,
    )


def weaving(
    state: WeldingState, target: TorchTarget, p_BW: Array, since_s: float, config: ServoConfig, dt: float
) -> tuple[WeldingState, TorchTarget]:
    """The target in its weave so many seconds after the arc was lit, and what the torch (3,) m shows of the arm's lag.

    The rates are those after the arm's lag. The place is where the arm, as late as it has shown to be, is now.
    """
    weave, learnt = config.weave, state.weave
    now, then = weave_at(weave, since_s - learnt.late_s), weave_at(weave, since_s + config.lag_s)
    left, up = math.cos(weave.plane_rad), math.sin(weave.plane_rad)
    side = left * target.normal + up * target.up
    point = target.point + now.side * side
    rate = (1.0 + learnt.loss) * then.side_rate
    state = changed(state, weave=learn(learnt, weave, now, dot(p_BW - point, side), dt))
    rates = (then.ahead_rate, left * rate, up * rate)
    return state, target._replace(point=point, rate=rates, turning=weave.side_peaks[1])


def _carried_on(
    seam: RefinedSeam, fit: LocalFit, inside: float, arc: float, plan: SeamFrame, config: ServoConfig
) -> LocalFit | None:
    """Extrapolate the path past the last point with the bend before it; None farther on, where the plan is used."""
    ahead = arc - inside
    if ahead > _CARRY_M:
        return None
    over = clip(0.4 / max(abs(plan.curvature), 1e-6), *_BEND_OVER_M)
    before = local_fit(seam, inside - over, plan.tangent, 1.0, config.refinement)
    bend = np.zeros(3) if before is None else (fit.tangent - before.tangent) / over
    if norm(bend) * over > 1.0:
        return None
    tangent = unit(fit.tangent + ahead * bend, fit.tangent)
    return LocalFit(fit.point + ahead * fit.tangent + 0.5 * ahead**2 * bend, tangent, bend, 1.0, fit.effective)


def _nearest_point(arcs: Array, arc: float) -> float:
    """Distance to the nearest of ascending arcs, m."""
    i = int(arcs.searchsorted(arc))
    return min(abs(arc - float(arcs[k])) for k in (max(0, i - 1), min(i, len(arcs) - 1)))


def _bridged(state: WeldingState, curve: SeamCurve, arc: float, s: float) -> Array:
    """The residual (normal, up) m inside a gap: a cubic with the slopes of the points on its two sides."""
    seam = state.refined
    i = int(np.searchsorted(seam.arc, arc))
    edges: list[tuple[float, Array, Array]] = []
    for low, high, edge in ((max(0, i - _EDGE_POINTS), i, i - 1), (i, min(len(seam), i + _EDGE_POINTS), i)):
        if high - low < 3:
            continue
        points, at = seam.points[low:high], s + seam.arc[low:high] - arc
        for _ in range(2):
            at = at + np.sum((points - curve.position(at)) * curve.tangent(at), axis=1)
        gap = points - curve.position(at)
        off = np.column_stack([np.sum(gap * curve.normal(at), axis=1), np.sum(gap * curve.up(at), axis=1)])
        x = seam.arc[low:high] - seam.arc[edge]
        middle = x.mean()
        slope = (x - middle) @ off / max(float((x - middle) @ (x - middle)), 1e-12)
        edges.append((float(seam.arc[edge]), off.mean(axis=0) - slope * middle, slope))
    if not edges:
        return state.residual
    if len(edges) == 1:
        return edges[0][1]
    (a0, y0, m0), (a1, y1, m1) = edges
    width = max(a1 - a0, 1e-6)
    x = clip((arc - a0) / width, 0.0, 1.0)
    rise, leave, meet = x * x * (3.0 - 2.0 * x), x * (1.0 - x) ** 2, x * x * (x - 1.0)
    return np.asarray(y0 + rise * (y1 - y0) + width * (leave * m0 + meet * m1))


def guarded_motion(
    state: WeldingState,
    X_BT: RigidTransform,
    tip: SeamFrame,
    target: TorchTarget,
    servo: tuple[float, float],
    config: ServoConfig,
    dt: float,
) -> TickMotion:
    """One tick of the guarded law in space (docs/weld_law.md, sections 3 and 4).

    Unknown are the tip's speed along the seam and the rate about the tool's up; pitch is eliminated by the torch's
    height, roll is free and holds the work angle. Nothing is divided by n_d . n_t.

    Args:
        tip: seam frame at the tip.
        target: of the torch.
        servo: the tip's lateral and upward speeds, m/s.
    """
    limits, torch, weights = config.limits, config.torch, config.weights
    axes = tool_axes(X_BT, tip.up, target.up, config)
    u, m, a, d, up = axes.along, axes.across, axes.yaw, axes.d, axes.up
    t, n, b = target.tangent, target.normal, target.up
    e = axes.torch - target.point
    limit = torch.feedback_limit_m
    ahead, left, rise = target.rate
    back_n = left - torch.k_b * clip(dot(e, n), -limit, limit)
    back_b = rise - torch.k_h * clip(dot(e, b), -limit, limit)

    # A command takes effect after the robot's lag: the rows look that far ahead along the path.
    turn = clip(target.bend * config.weld_speed_m_s * config.lag_s, -0.6, 0.6)
    t, n = math.cos(turn) * t + math.sin(turn) * n, math.cos(turn) * n - math.sin(turn) * t
    swung = clip(state.omega * config.lag_s, -0.1, 0.1)
    m_then = math.cos(swung) * m - math.sin(swung) * u

    # V_W = v t_s + V_0 - d w m + d w_p a. The height row gives w_p; putting it in leaves x -> x - (x.b)/(a.b) a.
    ab = height_share(axes, b)
    tb = tip.tangent
    base = servo[0] * tip.normal + servo[1] * tip.up
    lean_n, lean_t = dot(a, n) / ab, dot(a, t) / ab
    up_v, up_w, up_0 = dot(tb, b), -d * dot(m_then, b), dot(base, b) - back_b
    # The pitch that lifts or lowers the tip has its limit: the tip is the slower one, the torch keeps its height.
    share, most = dot(tip.up, b), _PITCH_SHARE * limits.pitch_rate_max_rad_s * d * abs(ab)
    wanted = state.v_tip * up_v + state.omega * up_w + up_0
    slower = clip((wanted - clip(wanted, -most, most)) / max(share, 0.5), min(servo[1], 0.0), max(servo[1], 0.0))
    base, up_0 = base - slower * tip.up, up_0 - slower * share
    n_v, n_w = dot(tb, n) - up_v * lean_n, -d * dot(m_then, n) - up_w * lean_n
    t_v, t_w = dot(tb, t) - up_v * lean_t, -d * dot(m_then, t) - up_w * lean_t
    n_0, t_0 = dot(base, n) - up_0 * lean_n, dot(base, t) - up_0 * lean_t

    speed = config.weld_speed_m_s
    radius = 1.0 / max(abs(tip.curvature), 1e-6)
    top = min(limits.tip_speed_max_m_s, max(limits.tip_speed_floor * speed, limits.turn_rate_max_rad_s * radius))
    dv, dw, w_top = (limits.tip_acceleration_m_s2 * dt, limits.omega_acceleration_rad_s2 * dt, limits.omega_max_rad_s)
    # The weave, which the arm has been found able to do, comes on top of the path's own turning.
    swing = target.turning / d * dt
    dw += swing
    # Where the tip would have to move square to the torch's path, or against it, the tip must not stop for the torch's
    # speed: the tip creeps round, and the torch waits.
    creep = limits.creep * speed * clip(1.0 - 10.0 * dot(tb, u), 0.0, 1.0)
    # Chord just past square to the torch's path: the rest point may move back a little, within what friction holds.
    given_back = state.furthest - state.progress
    least = (
        creep if creep > 0.0 else -limits.give_back_m_s * clip(2.0 - 2.0 * given_back / limits.give_back_m, 0.0, 1.0)
    )
    v_low = min(max(least, state.v_tip - dv), state.v_tip + dv)
    v_high = max(v_low, min(top, state.v_tip + dv))
    w_low, w_high = max(-w_top, state.omega - dw), min(w_top, state.omega + dw)
    v, w = box_least_squares(
        (
            (weights.lateral, n_v, n_w, back_n - n_0),
            (weights.torch_speed, t_v, t_w, speed + ahead - t_0),
            (weights.omega, 0.0, d, 0.0),
            (weights.tip_speed, 1.0, 0.0, speed + ahead),
        ),
        (v_low, v_high),
        (w_low, max(w_low, w_high)),
    )
    w_p = clip(-(v * up_v + w * up_w + up_0) / (d * ab), -limits.pitch_rate_max_rad_s, limits.pitch_rate_max_rad_s)
    w_p_then, w_p_step = dot(state.V[:3], m), limits.pitch_acceleration_rad_s2 * dt + swing
    w_p = clip(w_p, w_p_then - w_p_step, w_p_then + w_p_step)

    # Roll about the level chord holds the work angle; the roll caused by yaw about a tilted tool axis is subtracted.
    level = unit(u - dot(u, up) * up, u)
    w_r = clip((roll_rate(axes, b, config) - w * dot(a, level)) / max(dot(u, level), 0.2), -w_top, w_top)
    V = np.concatenate([w * a + w_p * m + w_r * u, v * tb + base])
    return TickMotion(V, v, v * t_v + w * t_w + t_0, w, seam_conditioning(u, tb, t))
