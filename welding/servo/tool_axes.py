"""Computes the tool's chord and axes on the seam, its roll rate, its path along a seam, and the least pipe for it."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.errors import WeldcalError
from weldcal.models.mesh import TriMesh, extrude, merge
from weldcal.models.tool import WeldingTool
from weldcal.models.workpieces.seat import JointSection, press_for, seat
from weldcal.welding.numerics import Array, clip, cross, dot, norm, pose, unit
from weldcal.welding.passes.angles import angles_along, held
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.seam.clearance import check_clearance
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import InfeasibleSeam, SeamWindows, check_feasible
from weldcal.welding.servo.settings import TORCH_ABOVE_ROOT_M, DeflectionControl, ServoConfig, ToolGeometry

TRAVEL_MARGIN_RAD = math.radians(3.0)  # the weld stops 5 deg beyond the window: 2 deg are left for the plan's error
PIPES_M, PIPE_STEP_M = (0.005, 0.5), 5e-4  # radii among which the least one for a tool is searched


class ToolAxes(NamedTuple):
    """The tool's points and axes at a tick, all in B.

    `rest`: point T (3,) m; `left`: y_T (3,); `chord`: torch to rest point (3,) m, `d` long; `along`: its direction u;
    `across`: the paper's n_d, level and to the left; `yaw`: the axis u x n_d that turns the chord towards n_d;
    `up`: between the seam's at tip and torch.
    """

    rest: Array
    left: Array
    chord: Array
    d: float
    along: Array
    across: Array
    yaw: Array
    up: Array

    @property
    def torch(self) -> Array:
        """The torch point (3,) m."""
        return self.rest - self.chord


def tool_axes(X_BT: RigidTransform, tip_up: Array, torch_up: Array, config: ServoConfig) -> ToolAxes:
    """Compute the axes of a tool at X_BT above a seam with given up-normals (3,) at tip and torch."""
    R = X_BT.rotation().matrix()
    chord = -(R @ config.p_TW)
    d = norm(chord)
    along = chord / d
    up = unit(tip_up + torch_up, tip_up)
    left = R[:, 1]
    across = unit(cross(up, along), left)
    return ToolAxes(
        rest=X_BT.translation(),
        left=left,
        chord=chord,
        d=d,
        along=along,
        across=across,
        yaw=cross(along, across),
        up=up,
    )


def height_share(axes: ToolAxes, torch_up: Array) -> float:
    """Component of the yaw axis along the torch's up (3,), which pitch divides by; at least 0.2 in magnitude."""
    share = dot(axes.yaw, torch_up)
    return share if abs(share) > 0.2 else math.copysign(0.2, share)


def roll_rate(axes: ToolAxes, torch_up: Array, config: ServoConfig) -> float:
    """The rate rad/s about the chord that brings the lean across it to the wanted work angle."""
    torch = config.torch
    lean = math.asin(clip(dot(axes.left, torch_up), -1.0, 1.0)) - torch.work_angle_rad
    return clip(-torch.k_roll * lean, -0.3, 0.3)


class ToolPath(NamedTuple):
    """The tool along a whole seam, one row a place.

    Arc lengths of torch and tip (n,) m, time (n,) s, and poses of T in B.
    """

    s_torch: Array
    s_tip: Array
    time: Array
    X_BT: list[RigidTransform]


def tool_path(plan: SeamCurve, config: ServoConfig) -> ToolPath:
    """Compute how the servo moves the tool along a planned seam, from the touch to the torch at the seam's end.

    The tip's rest point leads: it is pressed aside and down by the wanted deflections. The torch trails by the chord,
    at its height. The lean across the chord is the wanted work angle against the surface at the torch, or the wire has
    its ordered angles.

    Args:
        plan: the planned seam in B.
        config: settings.
    """
    tool, press = config.tool, config.deflection
    line = plan.raised(tool.tip_seat_height_m) if tool.tip_seat_height_m else plan
    chart = chord_map(line, tool.torch_offset_m, config.weld_speed_m_s, spacing=1e-3, tip_left=press.delta_d_m)
    tip, torch = chart.s_tip, chart.s_torch
    rest, wire, up = _pressed(line, tip, torch, config)
    u = rest - wire
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    y = np.cross(up, u)
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    lean = config.torch.work_angle_rad
    y = math.cos(lean) * y + math.sin(lean) * np.cross(u, y)
    # in T the chord is (d, 0, -h), and (h, 0, d) is square to it and to y
    e, d, h = np.cross(u, y), tool.torch_offset_m, tool.torch_height_m
    x, z = (d * u + h * e) / math.hypot(d, h), (d * e - h * u) / math.hypot(d, h)
    R = np.stack([x, y, z], axis=2)
    if config.angles is not None:
        found = held(line, config)
        rest, R = found.rest, found.R_BT
    poses = [pose(R[k], rest[k]) for k in range(len(tip))]
    steps = np.hypot(np.diff(tip), np.diff(torch))
    speed = np.maximum(np.hypot(chart.tip_speed, chart.torch_speed), 1e-6)
    time = np.concatenate([[0.0], np.cumsum(2.0 * steps / (speed[1:] + speed[:-1]))])
    return ToolPath(torch, tip, time, poses)


def _pressed(line: SeamCurve, tip: Array, torch: Array, config: ServoConfig) -> tuple[Array, Array, Array]:
    """Rest points, wire points and ups at the torch (n,3) for arc lengths (n,) m of tip and torch on the tip's line."""
    press, up = config.deflection, line.up(torch)
    rest = line.position(tip) + press.delta_d_m * line.normal(tip) - press.axial_d_m * line.up(tip)
    return rest, line.position(torch) + config.clearance_m * up + config.tool.side_offset_m * line.normal(torch), up


def check_travel(plan: SeamCurve, config: ServoConfig) -> None:
    """Check the torch's travel angle along a planned seam.

    The pressed tip's rest point is deeper in the joint than the torch.

    Raises:
        InfeasibleSeam: the angle leaves its window by more than TRAVEL_MARGIN_RAD, or see angles_along.
    """
    if config.angles is not None:
        angles_along(plan, config)
        return
    tool, windows = config.tool, config.windows
    line, path = plan.raised(tool.tip_seat_height_m) if tool.tip_seat_height_m else plan, tool_path(plan, config)
    tip, chord = path.s_tip, math.hypot(tool.torch_offset_m, tool.torch_height_m)
    for _ in range(
        4
    ):  # the pressed rest point is a chord from the torch: in a ring this is further along than on the tip's line
        rest, wire, up = _pressed(line, tip, path.s_torch, config)
        far = np.linalg.norm(rest - wire, axis=1)
        tip = tip + (chord - far) * far / np.maximum(np.sum((rest - wire) * line.tangent(tip), axis=1), 0.3 * far)
    rise = np.clip(np.sum((rest - wire) * up, axis=1) / chord, -1.0, 1.0)
    travel = np.abs(np.arcsin(rise) + math.atan2(tool.torch_height_m, tool.torch_offset_m) + windows.tilt_rad)
    k = int(np.argmax(travel))
    if travel[k] > windows.travel_rad + TRAVEL_MARGIN_RAD:
        raise InfeasibleSeam(
            f"Plan infeasible: the torch's travel angle would be {math.degrees(travel[k]):.0f} deg at"
            f" {1e3 * path.s_torch[k]:.0f} mm of the seam, and its window is {math.degrees(windows.travel_rad):.0f}"
            " deg. Take a tool whose torch is nearer to its tip, or weld the straight edges as seams of their own."
        )


def check_ring(
    mesh: TriMesh, line: Array, up: Array, section: JointSection, tool: WeldingTool, lean_rad: float = 0.0
) -> None:
    """Check that a tool fits along a root (N,3) m of a joint, and that its torch can follow.

    The directions up (N,3) point out of the joint.

    Raises:
        NoClearance: its body would touch the part.
        InfeasibleSeam: its torch cannot follow its tip, or leaves its windows.
    """
    press = press_for(section, tool, None, None)
    above = seat(section, tool, press).above_m
    config = ServoConfig(
        tool=ToolGeometry(
            torch_offset_m=tool.chord_m,
            torch_height_m=tool.torch_height_m,
            torch_clearance_m=TORCH_ABOVE_ROOT_M - above,
        ),
        deflection=DeflectionControl(delta_d_m=press.lateral_m, axial_d_m=press.axial_m),
        windows=SeamWindows.of(tool),
    )
    seam = SeamCurve.from_points(line + above * up, up=up)
    check_clearance(mesh, RigidTransform(), seam, tool.capsules(), tool.X_FT, tool.chord_m, lean_rad)
    check_feasible(seam, tool.chord_m, config.weld_speed_m_s, config.windows)
    check_travel(seam, config)


@lru_cache(maxsize=64)
def least_pipe_m(tool: WeldingTool, wall_m: float, lean_rad: float = 0.0) -> float:
    """Diameter m of the least pipe whose outside the tool can weld onto a plate, both as far as `wall_m` from the seam.

    Tip and torch stand on the ring, a chord apart: nothing but the lean across the chord is free.
    """
    low, high = PIPES_M
    while high - low > PIPE_STEP_M:
        radius = 0.5 * (low + high)
        whole, part = (
            np.linspace(0.0, a, 181) for a in (2.0 * math.pi, min(2.0 * math.pi, 3.0 * tool.chord_m / radius))
        )
        circle, arc = (
            np.stack([np.cos(a), np.sin(a)], axis=1) for a in (whole, part)
        )  # all places of a ring are alike
        up = np.hstack([arc, np.ones((181, 1))]) / math.sqrt(2.0)
        plate = (radius + wall_m) * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
        mesh = merge(extrude(radius * circle[:-1], 0.0, wall_m), extrude(plate, -0.01, 0.0))
        section = JointSection(0.25 * math.pi, wall_m, wall_m)
        try:
            check_ring(mesh, np.pad(radius * arc, ((0, 0), (0, 1))), up, section, tool, lean_rad)
            high = radius
        except WeldcalError:
            low = radius
    return 2.0 * high
