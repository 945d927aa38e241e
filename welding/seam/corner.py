"""Reconstructs a corner that the tip jumped across: extends the two measured sides until they meet and rounds them."""

import math
from dataclasses import dataclass

import numpy as np

from weldcal.welding.numerics import Array, dot, norm, unit


@dataclass(frozen=True, kw_only=True)
class CornerConfig:
    """Thresholds for a jump of the tip at a corner, and the shape that is filled in.

    A tip held `delta_d` to the side jumps across every convex corner of a smaller radius without measuring it.

    Attributes:
        jump_m: a step between points that is a gap in the measurement, if it also is `jump_steps` times the step before.
        side_m: length of each side that is fitted; points: how many it needs.
        turn_rad: sides that turn by less are one side.
        reach_m: farther than this from the points felt the sides do not meet.
        radius_m: of the rounding; half of delta_d halves the largest error over all radii that are jumped.
        spacing_m: of the points filled in.
        planned_radius_m: where the plan, which rounds its corners, bends less than this within `reach_m` there is none.
    """

    jump_m: float = 1.2e-3
    jump_steps: float = 2.5
    side_m: float = 4.0e-3
    points: int = 6
    turn_rad: float = math.radians(25.0)
    reach_m: float = 8.0e-3
    radius_m: float = 1.0e-3
    spacing_m: float = 0.2e-3
    planned_radius_m: float = 12.5e-3


@dataclass(frozen=True)
class Corner:
    """The points (n,3) m to put between the two sides, the path's length m from the last felt point to each, and the
    whole length m from side to side; `middle`: the length m to the corner's middle."""

    points: Array
    along: Array
    length: float
    middle: float


def is_jump(last: Array, point: Array, config: CornerConfig) -> bool:
    """Whether a gap separates a point (3,) m from the points (n,3) m before it."""
    if len(last) < 4:
        return False
    step = norm(point - last[-1])
    return config.jump_m < step < config.reach_m and step > config.jump_steps * norm(last[-1] - last[-4]) / 3.0


def fill_corner(before: Array, after: Array, config: CornerConfig) -> Corner | None:
    """Compute the corner between two sides, each (n,3) m in order of travel; None where there is none.

    The lines through the sides are met where they pass closest in space.
    """
    if len(before) < config.points or len(after) < config.points:
        return None
    (p, t), (q, w) = _line(before), _line(after)
    cos = dot(t, w)
    turn = math.acos(max(-1.0, min(1.0, cos)))
    if turn < config.turn_rad or turn > math.radians(170.0):
        return None
    gap = q - p
    # Closest points of two lines in space: both foot points as far along as these solve.
    det = 1.0 - cos * cos
    along_p = (dot(gap, t) - cos * dot(gap, w)) / det
    along_q = (cos * dot(gap, t) - dot(gap, w)) / det
    apex = 0.5 * (p + along_p * t + q + along_q * w)
    to_apex, from_apex = dot(apex - before[-1], t), dot(after[0] - apex, w)
    if not (-config.spacing_m < to_apex < config.reach_m and -config.spacing_m < from_apex < config.reach_m):
        return None
    tangent = min(config.radius_m * math.tan(0.5 * turn), max(to_apex, 0.0), max(from_apex, 0.0))
    radius = tangent / math.tan(0.5 * turn)
    inward = unit(w - cos * t, t)
    first, arc, last = max(to_apex - tangent, 0.0), radius * turn, max(from_apex - tangent, 0.0)
    length = first + arc + last
    along = np.arange(config.spacing_m, length, config.spacing_m)
    start = apex - tangent * t
    rows = []
    for x in along.tolist():
        if x <= first:
            rows.append(start - (first - x) * t)
        elif x < first + arc:
            a = (x - first) / radius
            rows.append(start + radius * (math.sin(a) * t + (1.0 - math.cos(a)) * inward))
        else:
            rows.append(apex + (tangent + x - first - arc) * w)
    return Corner(np.array(rows).reshape(-1, 3), along, length, first + 0.5 * arc)


def _line(points: Array) -> tuple[Array, Array]:
    """A point and the direction of travel of the line through points (n,3)."""
    middle = points.mean(axis=0)
    _, _, vt = np.linalg.svd(points - middle, full_matrices=False)
    direction = vt[0]
    return middle, direction if dot(points[-1] - points[0], direction) > 0.0 else -direction
