"""Computes the tool's chord and axes on the seam, and the roll rate that holds the work angle."""

import math
from typing import NamedTuple

from pydrake.math import RigidTransform

from weldcal.welding.numerics import Array, clip, cross, dot, norm, unit
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
