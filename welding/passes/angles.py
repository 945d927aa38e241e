"""Holds the wire at ordered angles: how the tip yields, and how the tool turns, along a planned seam.

Torch and tip are fixed to each other and both follow the seam, so that only a roll about the line between them is free.
A travel angle or a rotation about the wire moves the tip's rest point, up and down or aside. Its springs allow that as
far as the ball stays in its joint.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weldcal.models.workpieces.seat import LEAST_LEAN_M, Press, Seated
from weldcal.welding.numerics import Array, changed
from weldcal.welding.passes.felt import CLEAR_M, FARTHEST_M
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import InfeasibleSeam
from weldcal.welding.servo.settings import Ends, ServoConfig, TorchAngles

PRESSED_M = (1.0e-3, 5.0e-3)  # a choice: over twice what is lost as contact, and 1.5 mm below the mechanical limit
CLIMBS = 0.9  # of the sideways force that lifts the ball out of its joint, as in press_for
LEVEL_RAD = math.radians(0.5)  # a choice, half of the tolerance: by which a seam may turn a tip that is not used
_PLACES = 9  # of a seam at which the loaded ball's seat is computed
_ROUNDS = 12  # after which tip and press are within 1 um


@dataclass(frozen=True, eq=False, kw_only=True)
class AnglesAlong:
    """What holds the ordered angles along a seam: the press at places of the tip, the rest at places of the torch.

    Attributes:
        s_tip, axial_m, lateral_m: (n,) m, the wanted deflections.
        s_torch, clearance_m, side_m, roll_rad: (n,) torch above and beside the felt line of the tip, and roll.
    """

    s_tip: Array
    axial_m: Array
    lateral_m: Array
    s_torch: Array
    clearance_m: Array
    side_m: Array
    roll_rad: Array

    def at(self, config: ServoConfig, s_tip: float, s_torch: float) -> ServoConfig:
        """The settings with tip and torch at these arc lengths, m."""
        axial, lateral = (float(np.interp(s_tip, self.s_tip, v)) for v in (self.axial_m, self.lateral_m))
        clearance, side = (float(np.interp(s_torch, self.s_torch, v)) for v in (self.clearance_m, self.side_m))
        # the roll's feedback lags by its time constant
        roll = float(np.interp(s_torch + config.weld_speed_m_s / config.torch.k_roll, self.s_torch, self.roll_rad))
        return changed(
            config,
            deflection=changed(config.deflection, axial_d_m=axial, delta_d_m=lateral),
            tool=changed(config.tool, torch_clearance_m=clearance, side_offset_m=side),
            torch=changed(config.torch, work_angle_rad=roll),
        )


class Held(NamedTuple):
    """A tool at ordered angles along a seam, one row a place.

    Arcs (n,) m of torch and tip, rest points (n, 3) m and R_BT (n, 3, 3), angles (n,) rad, deflections
    (n,) m. The ball's seat (n,) m is beside the bisector, and above that of the usual press.
    """

    s_torch: Array
    s_tip: Array
    rest: Array
    R_BT: Array
    travel: Array
    roll: Array
    axial: Array
    lateral: Array
    aside: Array
    above: Array


def wire_axis(travel: Array, work: Array, t: Array, n: Array, up: Array) -> Array:
    """The wire's axis (N, 3), from the work to the torch, at a travel and a work angle (N,) rad in frames of a seam."""
    cos = np.cos(travel)
    across = -(cos * np.sin(work))[:, None] * n + (cos * np.cos(work))[:, None] * up
    return np.asarray(across - np.sin(travel)[:, None] * t)


def leaned(press: Press, roll_rad: float, ratio: float) -> Press:
    """The press of an upright tip with the forces of one that leans across the seam, its springs with it."""
    s, c = math.sin(roll_rad), math.cos(roll_rad)
    across, along = press.lateral_m * c - press.axial_m * s, -ratio * (press.lateral_m * s + press.axial_m * c)
    return Press(-(across * s + along * c) / ratio, across * c - along * s)


def held(plan: SeamCurve, config: ServoConfig, travel_axial_m: float | None = None) -> Held:
    """Solve for the tool along a planned line of the tip with the wire's point and axis as ordered.

    ``travel_axial_m``: the travel angle is that of this press instead of the ordered one.
    """
    order, tool, tilt, usual = config.angles, config.tool, config.windows.tilt_rad, config.deflection
    assert order is not None
    d, h = tool.torch_offset_m, tool.torch_height_m
    chart = chord_map(plan, math.hypot(d, h), config.weld_speed_m_s, spacing=1e-3, tip_left=usual.delta_d_m)
    s_tip, s_torch = chart.s_tip, chart.s_torch
    t, n, up = plan.tangent(s_torch), plan.normal(s_torch), plan.up(s_torch)
    used = order.seat is not None
    wire = plan.position(s_torch) + config.clearance_m * up + (0.0 if used else tool.side_offset_m) * n
    share = np.clip(s_torch / plan.length, 0.0, 1.0)

    def along(ends: Ends | None) -> Array | None:
        return None if ends is None else ends[0] + (ends[1] - ends[0]) * share

    work, turn = along(order.work_rad), along(order.rotation_rad)
    ordered = along(order.travel_rad) if travel_axial_m is None else None
    assert work is not None
    wanted = travel_axial_m
    if wanted is None:
        wanted = usual.axial_d_m if used else 0.0
    travel = np.zeros(len(share)) if ordered is None else ordered
    axial, lateral, roll = (np.full(len(share), v) for v in (wanted, usual.delta_d_m, 0.0))
    aside, above = np.full(len(share), -tool.side_offset_m), np.zeros(len(share))
    # in T the tip lies `reach` from the wire's line, and `high` along it above the wire's point
    reach, high = d * math.cos(tilt) - h * math.sin(tilt), -d * math.sin(tilt) - h * math.cos(tilt)
    for k in range(_ROUNDS):
        axis = wire_axis(travel, work, t, n, up)
        foot, tip_n, tip_up = plan.position(s_tip), plan.normal(s_tip), plan.up(s_tip)
        seated = aside if used else 0.0 * aside
        to = foot - wire if turn is not None else foot + (seated + lateral)[:, None] * tip_n - wire
        e = to - np.sum(to * axis, axis=1)[:, None] * axis
        e = e / np.linalg.norm(e, axis=1, keepdims=True)
        if turn is not None:
            e = np.cos(turn)[:, None] * e + np.sin(turn)[:, None] * np.cross(axis, e)
        y = np.cross(axis, e)
        rest = wire + reach * e + high * axis
        off = rest - foot
        s_tip = s_tip + np.sum(off * plan.tangent(s_tip), axis=1)
        axial = above - np.sum(off * tip_up, axis=1)
        roll = np.arcsin(np.clip(np.sum(y * up, axis=1), -1.0, 1.0))
        if turn is not None:
            lateral = np.sum(off * tip_n, axis=1) - seated
        elif used:  # a tip that is pressed less leans less, or it would climb out
            lateral = usual.delta_d_m * np.clip(axial / usual.axial_d_m, 0.1, 1.0)
        if ordered is None:
            travel = np.clip(travel + (axial - wanted) / reach, -0.7, 0.7)
        if order.seat is not None and k % 4 == 1:
            aside, above = _seats(order.seat, order, Press(usual.axial_d_m, usual.delta_d_m), axial, lateral, roll)
    R = np.stack([math.cos(tilt) * e - math.sin(tilt) * axis, y, math.sin(tilt) * e + math.cos(tilt) * axis], axis=2)
    return Held(
        s_torch=s_torch,
        s_tip=s_tip,
        rest=rest,
        R_BT=R,
        travel=travel,
        roll=roll,
        axial=axial,
        lateral=lateral,
        aside=aside,
        above=above,
    )


def _seats(
    seat: Callable[[Press], Seated], order: TorchAngles, usual: Press, axial: Array, lateral: Array, roll: Array
) -> tuple[Array, Array]:
    """The loaded ball's seat (n,) m: beside the bisector, and above its seat at the usual press."""
    places, keys = np.linspace(0, len(axial) - 1, _PLACES).astype(int), []
    for k in places:
        press = Press(float(np.clip(axial[k], *PRESSED_M)), float(lateral[k]))
        down, left = leaned(press, float(roll[k]), order.stiffness_ratio)
        most = CLIMBS * down * order.stiffness_ratio / math.tan(order.half_angle_rad)
        keys.append(Press(round(down, 6), round(min(max(left, 0.0), most), 6)))
    seats = {key: seat(key) for key in set(keys)}
    every = np.arange(len(axial))
    aside, above = (np.interp(every, places, [seats[key][i] for key in keys]) for i in range(2))
    return aside, above - seat(usual).above_m


def angles_along(plan: SeamCurve, config: ServoConfig) -> AnglesAlong:
    """How tip and torch are led so that the wire has its ordered angles; checked along the whole seam.

    Raises:
        InfeasibleSeam: the ball would leave its joint, with what could be ordered instead.
    """
    found, order = held(plan, config), config.angles
    assert order is not None
    check_angles(plan, found, config)
    torch = np.maximum.accumulate(found.s_torch)
    tip = np.maximum.accumulate(found.s_tip)
    above, aside = (np.interp(found.s_torch, tip, v) for v in (found.above, found.aside))  # as the tip was there
    runs_up = (found.s_torch < 0.0) & (order.seat is not None)  # without an arc the angles may differ
    return AnglesAlong(
        s_tip=tip,
        axial_m=np.where(runs_up, np.clip(found.axial, *PRESSED_M), found.axial),
        lateral_m=found.lateral,
        s_torch=torch,
        clearance_m=config.clearance_m - above,
        side_m=-aside,
        roll_rad=found.roll,
    )


def lifted(plan: SeamCurve, config: ServoConfig) -> tuple[SeamCurve, ServoConfig]:
    """The line of a tip that is not used, lifted and shifted so that the wire has its angles, and the settings for it.

    Raises:
        InfeasibleSeam: the tip would come too near to the joint, or the seam's shape turns the tool.
    """
    found, order = held(plan, config), config.angles
    assert order is not None
    check_angles(plan, found, config)
    found = Held._make(v[_welding(plan, found)] for v in found)
    rows = np.stack([-found.axial, found.lateral, config.tool.torch_offset_m * found.roll])
    up, left, roll = rows.mean(axis=1).tolist()
    if np.ptp(rows, axis=1).max() > 2.0 * LEVEL_RAD * config.tool.torch_offset_m:
        raise InfeasibleSeam(
            "Plan infeasible: a tip that is not used keeps one height, and along this seam the ordered angles need"
            " several. Order one number for each angle, or let the tip feel the seam."
        )
    tool = replace(
        config.tool, torch_clearance_m=config.clearance_m - up, side_offset_m=config.tool.side_offset_m - left
    )
    given = replace(order, travel_rad=None, rotation_rad=None)  # by the line
    torch = replace(config.torch, work_angle_rad=roll / config.tool.torch_offset_m)
    config = replace(config, angles=given, tool=tool, torch=torch)
    return plan.raised(up, left), config


def _welding(plan: SeamCurve, found: Held) -> NDArray[np.bool_]:
    """The rows (n,) with the torch on the seam and the tip in its joint: before and after, the tip may be anywhere."""
    return np.asarray((found.s_torch >= 0.0) & (found.s_tip <= plan.drawn_m))


def check_angles(plan: SeamCurve, found: Held, config: ServoConfig) -> None:
    """Check that the tip stays in its joint, or clear of it, and the travel angle in its window.

    Raises:
        InfeasibleSeam: with the place, and the limits of what can be ordered.
    """
    order, usual, deg = config.angles, config.deflection, math.degrees
    assert order is not None
    rows = _welding(plan, found)
    found = Held._make(v[rows] for v in found)
    steepest = float(np.abs(found.travel).max())
    if steepest > config.windows.travel_rad:
        raise InfeasibleSeam(
            f"Plan infeasible: the wire's travel angle would be {deg(steepest):.0f} deg, and its window is"
            f" {deg(config.windows.travel_rad):.0f} deg. Order another travel angle or stick-out."
        )
    if max(map(abs, order.work_rad)) > order.half_angle_rad:
        raise InfeasibleSeam(
            f"Plan infeasible: at a work angle of {deg(max(order.work_rad, key=abs)):.0f} deg the finger touches the"
            f" joint's wall. Order at most {deg(order.half_angle_rad):.0f} deg."
        )
    low, high = (-FARTHEST_M, 1e-6) if order.seat is None else PRESSED_M
    if order.seat is not None and order.rotation_rad is None:
        low = max(low, usual.axial_d_m * LEAST_LEAN_M / usual.delta_d_m)
    over = np.maximum(found.axial - high, low - found.axial)
    k = int(np.argmax(over))
    if over[k] > 1e-6:
        ends = [Held._make(v[rows] for v in held(plan, config, press)) for press in (low, high)]
        raise InfeasibleSeam(_refusal(found, ends, config, (low, high), k))
    sin, cos = math.sin(order.half_angle_rad), max(math.cos(order.half_angle_rad), 1e-3)
    if order.seat is None:
        most = np.minimum((CLEAR_M - found.axial * sin) / cos, FARTHEST_M)
        least = -most
    else:
        places, ratio = zip(found.axial, found.roll, strict=True), order.stiffness_ratio
        down, left = np.array([leaned(Press(a, 0.0), r, ratio) for a, r in places]).T
        most, least = CLIMBS * down * ratio * cos / sin - left, LEAST_LEAN_M - np.minimum(left, 0.0)
    over = np.maximum(found.lateral - most, least - found.lateral)
    k = int(np.argmax(over))
    if over[k] > 1e-6:
        arm = config.tool.torch_offset_m
        first, last = (np.degrees(np.arcsin(np.clip((v + found.aside) / arm, -1.0, 1.0))) for v in (least, most))
        raise InfeasibleSeam(
            f"Plan infeasible: with the ordered angles the tip would lean by {1e3 * found.lateral[k]:.1f} mm at"
            f" {1e3 * max(found.s_tip[k], 0.0):.0f} mm of the seam, and from {1e3 * least[k]:.1f} to"
            f" {1e3 * most[k]:.1f} mm hold it. Order a rotation from {first.max():+.1f} to {last.min():+.1f} deg."
        )


def _refusal(found: Held, ends: list[Held], config: ServoConfig, limits: tuple[float, float], k: int) -> str:
    """The sentences of a tip that would leave its limits (low, high) m of the press, worst at the place k.

    ``ends``: the tool as it is held by the least and the largest press.
    """
    order = config.angles
    assert order is not None
    text = "the tip, which is not used, would touch the part."
    if order.seat is not None:
        a = 1e3 * found.axial[k]
        text = (
            f"the tip would have to yield {abs(a):.1f} mm {'down' if a > 0.0 else 'up'} at"
            f" {1e3 * max(found.s_tip[k], 0.0):.0f} mm of the seam. Its joint holds it from {1e3 * limits[0]:.1f} to"
            f" {1e3 * limits[1]:.1f} mm down."
        )
    travel = [math.degrees(ends[1].travel.max()), math.degrees(ends[0].travel.min())]
    steep = np.cos(found.travel) * math.cos(max(order.work_rad))
    longer = [(found.axial - found.above + end.above - a) / steep for end, a in zip(ends, limits, strict=True)]
    stick = [1e3 * (order.stick_out_m + by) for by in (longer[1].max(), longer[0].min())]
    change = [f"a travel angle from {travel[0]:+.1f} to {travel[1]:+.1f} deg"] if travel[0] <= travel[1] else []
    change += [f"a stick-out from {stick[0]:.1f} to {stick[1]:.1f} mm"] if 0.0 < stick[0] <= stick[1] else []
    what = "stick-out" if order.travel_rad is None else "travel angle"
    advice = f"Order {', or '.join(change)}" if change else "Leave the travel angle out, or weld it as shorter seams"
    return f"Plan infeasible: with the ordered {what} {text} {advice}."
