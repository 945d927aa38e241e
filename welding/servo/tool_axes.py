"""Computes the tool's chord and axes on the seam, the roll rate that holds the work angle, and the tool's path along a seam."""

import math
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform

from weldcal.welding.numerics import Array, clip, cross, dot, norm, pose, unit
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig


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
    """The tool along a whole seam, one row a place: arc lengths of torch and tip (n,) m, time (n,) s, and poses of T in B."""

    s_torch: Array
    s_tip: Array
    time: Array
    X_BT: list[RigidTransform]


def tool_path(plan: SeamCurve, config: ServoConfig) -> ToolPath:
    """Compute how the servo moves the tool along a planned seam, from the touch to the torch at the seam's end.

    The tip's rest point leads: it is pressed aside and down by the wanted deflections. The torch trails by the chord, at its height. The
    lean across the chord is the wanted work angle against the surface at the torch.

    Args:
        plan: the planned seam in B.
        config: settings.
    """
    tool, press = config.tool, config.deflection
    line = plan.raised(tool.tip_seat_height_m) if tool.tip_seat_height_m else plan
    chart = chord_map(line, tool.torch_offset_m, config.weld_speed_m_s, spacing=1e-3, tip_left=press.delta_d_m)
    tip, torch = chart.s_tip, chart.s_torch
    rest = line.position(tip) + press.delta_d_m * line.normal(tip) - press.axial_d_m * line.up(tip)
    up = line.up(torch)
    wire = line.position(torch) + config.clearance_m * up + tool.side_offset_m * line.normal(torch)
    u = rest - wire
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    y = np.cross(up, u)
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    lean = config.torch.work_angle_rad
    y = math.cos(lean) * y + math.sin(lean) * np.cross(u, y)
    # in T the chord is (d, 0, -h), and (h, 0, d) is square to it and to y
    e, d, h = np.cross(u, y), tool.torch_offset_m, tool.torch_height_m
    x, z = (d * u + h * e) / math.hypot(d, h), (d * e - h * u) / math.hypot(d, h)
    poses = [pose(np.column_stack([x[k], y[k], z[k]]), rest[k]) for k in range(len(tip))]
    steps = np.hypot(np.diff(tip), np.diff(torch))
    speed = np.maximum(np.hypot(chart.tip_speed, chart.torch_speed), 1e-6)
    time = np.concatenate([[0.0], np.cumsum(2.0 * steps / (speed[1:] + speed[:-1]))])
    return ToolPath(torch, tip, time, poses)
