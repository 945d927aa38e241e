"""Refines the seam by tactile points, each committed only after further frames confirm its contact."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform

from weldcal.welding.numerics import Array, dot, norm, unit


@dataclass(frozen=True, kw_only=True)
class CornerConfig:
    """Thresholds for a jump of the tip at a corner, and the shape that is filled in.

    A tip held `delta_d` to the side jumps across every convex corner of a smaller radius without measuring it.

    Attributes:
        jump_m: a step between points that is a gap in the measurement, if it also is `jump_steps` times the step
            before.
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
class RoundedCorner:
    """Hold the points (n,3) m to put between the two sides of a corner.

    With the path's length m from the last felt point to each, and the whole length m from side to side; `middle`: the
    length m to the corner's middle.
    """

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


def fill_corner(before: Array, after: Array, config: CornerConfig) -> RoundedCorner | None:
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
    return RoundedCorner(np.array(rows).reshape(-1, 3), along, length, first + 0.5 * arc)


def _line(points: Array) -> tuple[Array, Array]:
    """A point and the direction of travel of the line through points (n,3)."""
    middle = points.mean(axis=0)
    _, _, vt = np.linalg.svd(points - middle, full_matrices=False)
    direction = vt[0]
    return middle, direction if dot(points[-1] - points[0], direction) > 0.0 else -direction


_EMPTY_POINTS = np.zeros((0, 3))
_EMPTY_ARC = np.zeros(0)
_STEPS = 6  # frames over which the tip's own path is measured
_SLOW = 0.5  # share of the progress below which the tip is held back
_FRAME_M = 1.5e-3  # longer than one frame's progress (40 mm/s at 30 Hz): a longer step is a gap
_LEAST_STEP_M = 0.01e-3  # a few per cent of a frame's usual way: keeps a ratio finite while the tip stands
_STICKING = 0.25  # path per progress below which the tip is almost at rest


class PendingPoint(NamedTuple):
    """A point (3,) m in B that waits for the frames after it, and its arc parameter m."""

    point: Array
    arc: float


@dataclass(frozen=True, kw_only=True)
class RefinementConfig:
    """When a tactile point is committed, and how the path is smoothed.

    Attributes:
        frames_to_commit: further good frames a point waits for.
        fit_sigma_m: width of the local fit's Gaussian; fit_radius_share: of the plan's radius, where that is less.
        fit_sagitta_m: it is as wide as sqrt(sagitta R), up to fit_sigma_wide_m, where that is more and R the least
            radius nearby: where curvature jumps by 1/R a quadratic is off by 0.06 sigma^2/R, 6 um with these numbers.
        fit_sigma_max_m: how wide it may grow to find points.
        fit_points: effective points it grows for.
        bridge_from_m: farther than this from any point a gap is bridged on the moved plan instead.
        slope_ridge: weight that holds the fitted slope to the plan's, in effective points at one fit width.
        corner: how a corner that the tip jumped across is filled in.
    """

    frames_to_commit: int = 4
    fit_sigma_m: float = 1.5e-3
    fit_radius_share: float = 0.2
    fit_sagitta_m: float = 0.1e-3
    fit_sigma_wide_m: float = 2.5e-3
    fit_sigma_max_m: float = 3.0e-3
    fit_points: float = 5.0
    bridge_from_m: float = 0.6e-3
    slope_ridge: float = 0.2
    corner: CornerConfig = field(default_factory=CornerConfig)


@dataclass(frozen=True)
class RefinedSeam:
    """Committed tactile points and those still pending; immutable.

    Attributes:
        points: (n,3) m in B, the tip's centre.
        arc: (n,) m, the commanded tip progress at each point plus the tip's jumps, increasing.
        pending: points waiting for confirmation, oldest first.
        jumped: sum of the tip's jumps so far, less the progress it was held back, m.
        jump: number of points (before, after) a jump that is not filled in yet, or None.
        corners: (k,) arcs m of corners filled in.
    """

    points: Array
    arc: Array
    pending: tuple[PendingPoint, ...] = ()
    jumped: float = 0.0
    jump: tuple[int, int] | None = None
    corners: Array = field(default_factory=lambda: _EMPTY_ARC)

    @classmethod
    def empty(cls) -> RefinedSeam:
        """A seam without tactile points."""
        return cls(_EMPTY_POINTS, _EMPTY_ARC)

    def __len__(self) -> int:
        return len(self.arc)


def tip_point(X_BT_at_capture: RigidTransform, deflection_T: Array) -> Array:
    """REFINE (lines 16-17 of Algorithm 2): P_s = P_r - delta at the frame's own time, (3,) m; delta = -R deflection."""
    return np.asarray(X_BT_at_capture.translation() + X_BT_at_capture.rotation().matrix() @ deflection_T)


def refine(
    seam: RefinedSeam, point: Array, arc: float, config: RefinementConfig, is_corner: bool = True
) -> RefinedSeam:
    """The seam after one more valid frame: its point is queued, and the oldest of a full queue is committed.

    A gap in the points is filled in as a corner only where the plan has one (`is_corner`): a tip that sticks and slips
    in a gentle bend leaves a gap too.
    """
    pending = (*seam.pending, PendingPoint(point, arc))
    if len(pending) <= config.frames_to_commit:
        return replace(seam, pending=pending)
    oldest, pending = pending[0], pending[1:]
    seam = replace(seam, pending=pending)
    arc = oldest.arc + seam.jumped
    # The path is a function of progress: a point that does not advance it would make the fit's slope meaningless.
    if len(seam) and arc <= seam.arc[-1] + 1e-6:
        return seam
    if len(seam) and is_jump(seam.points[-4:], oldest.point, config.corner):
        step = float(np.linalg.norm(oldest.point - seam.points[-1]))
        extra = max(0.0, step - (arc - float(seam.arc[-1])))
        # Points measured in the middle of a jump belong to neither side.
        before = len(seam) if seam.jump is None or len(seam) - seam.jump[1] > 4 else seam.jump[0]
        seam = replace(seam, jumped=seam.jumped + extra, jump=(before, len(seam)) if is_corner else None)
        arc += extra
    elif len(seam) >= _STEPS:
        # Where the tip hardly advances, as in a concave corner that the rest point goes round outside, the parameter
        # follows the tip: points a third as far apart as their parameters give the direction as well, points at rest do
        # not.
        step = arc - float(seam.arc[-1])
        way = max(float(np.linalg.norm(oldest.point - seam.points[-_STEPS])) / _STEPS, _LEAST_STEP_M)
        if way < _SLOW * step < _SLOW * _FRAME_M:
            seam = replace(seam, jumped=seam.jumped + way - step)
            arc += way - step
    seam = replace(seam, points=np.vstack([seam.points, oldest.point]), arc=np.append(seam.arc, arc))
    return _filled(seam, config.corner) if seam.jump is not None else seam


def _filled(seam: RefinedSeam, config: CornerConfig) -> RefinedSeam:
    """The seam with its jump filled in, once the side after it is long enough to be fitted."""
    assert seam.jump is not None
    before, after = seam.jump
    if seam.arc[-1] - seam.arc[after] < config.side_m and len(seam) - after < 4 * config.points:
        return seam
    low = int(np.searchsorted(seam.arc, seam.arc[before - 1] - config.side_m))
    corner = fill_corner(seam.points[low:before], seam.points[after:], config)
    if corner is None:
        return replace(seam, jump=None)
    start = float(seam.arc[before - 1])
    extra = start + corner.length - float(seam.arc[after])
    return replace(
        seam,
        points=np.vstack([seam.points[:before], corner.points, seam.points[after:]]),
        arc=np.concatenate([seam.arc[:before], start + corner.along, seam.arc[after:] + extra]),
        jumped=seam.jumped + extra,
        jump=None,
        corners=np.append(seam.corners, start + corner.middle),
    )


def drop_pending(seam: RefinedSeam) -> RefinedSeam:
    """The seam after contact was lost, without the points measured while contact was going."""
    return replace(seam, pending=()) if seam.pending else seam


class LocalFit(NamedTuple):
    """The refined path near one arc parameter.

    Attributes:
        point, tangent: (3,), the tangent of unit length along travel.
        bend: (3,) second derivative 1/m.
        speed: path length per arc parameter.
        effective: effective number of points behind the fit.
    """

    point: Array
    tangent: Array
    bend: Array
    speed: float
    effective: float


def local_fit(
    seam: RefinedSeam,
    arc: float,
    plan_tangent: Array,
    radius: float,
    config: RefinementConfig,
    least_radius: float = 0.0,
) -> LocalFit | None:
    """Fit a quadratic to the points around `arc`, on both sides of it (the tip is a chord ahead of the torch).

    Args:
        seam: committed points.
        arc: parameter m.
        plan_tangent: (3,) registered plan's tangent, towards which the slope is held.
        radius: the plan's radius of curvature m there; least_radius: the least within 5 mm, when known.
        config: widths.

    Returns:
        None where even the widest window holds fewer than 3 effective points.
    """
    sigma = max(min(config.fit_radius_share * radius, config.fit_sigma_m), 0.3e-3)
    sigma = max(sigma, min(math.sqrt(config.fit_sagitta_m * least_radius), config.fit_sigma_wide_m))
    widest = max(config.fit_sigma_max_m, sigma)
    if len(seam.corners):
        # The points of a corner that was filled in are dense and free of noise: a wide fit would cut the corner.
        sigma = max(min(sigma, 0.4 * float(np.min(np.abs(seam.corners - arc)))), 0.3e-3)
    # At the ends points lie on one side only, and a quadratic's end is three times as noisy as its middle: a window up
    # to twice as wide compensates for that.
    edge = min(arc - float(seam.arc[0]), float(seam.arc[-1]) - arc) if len(seam) else math.inf
    if edge < 2.0 * sigma and not len(seam.corners):
        sigma = max(sigma, min((2.0 - max(edge, 0.0) / (2.0 * sigma)) * sigma, config.fit_sigma_max_m, 0.2 * radius))
    while True:
        low, high = seam.arc.searchsorted((arc - 3.0 * sigma, arc + 3.0 * sigma)).tolist()
        n = high - low
        if n >= 3:
            x = (seam.arc[low:high] - arc) / sigma
            w = np.exp(-0.5 * x * x)
            effective = float(w.sum() ** 2 / (w @ w))
            if effective >= config.fit_points:
                break
        if sigma >= widest:
            if n < 4 or effective < 3.0:
                return None
            break
        sigma = min(1.5 * sigma, widest)
    basis = np.empty((3, n))
    basis[0], basis[1], basis[2] = 1.0, x, x * x
    weighted = basis * w
    normal = weighted @ basis.T
    points = seam.points[low:high] - seam.points[low]
    rhs = weighted @ points
    ridge = config.slope_ridge
    normal[1, 1] += ridge
    normal[2, 2] += 1e-6
    rhs[1] += ridge * sigma * plan_tangent
    inverse = np.linalg.inv(normal)  # of (3, 3), well conditioned by its scale; two right sides follow one another
    c = inverse @ rhs
    slope = c[1] / sigma
    speed = math.sqrt(float(slope @ slope))
    if not math.isfinite(speed):
        return None
    # The fitted point moves along the slope plus the effect of the moving weights as the window advances: where
    # the curvature jumps the two differ by 0.2 sigma/R, and a torch that headed along the slope would leave the point.
    left_over = points - basis.T @ c
    slope = slope + (inverse[0] @ (weighted * x)) @ left_over / sigma
    speed = math.sqrt(float(slope @ slope))
    # A tip that sticks leaves points that hardly advance, and their direction is noise: the plan's stands in for it. In
    # a concave corner of 1 mm the tip still comes on by a third of the rest point's way, and its direction is good.
    slope = slope + max(0.0, _STICKING - speed) * plan_tangent
    speed = math.sqrt(float(slope @ slope))
    if speed < 0.2:
        return None
    return LocalFit(c[0] + seam.points[low], slope / speed, 2.0 * c[2] / sigma**2, speed, effective)
