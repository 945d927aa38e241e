"""Lead a pass along the path that the tip felt in the root pass: the felt line, and the line of a pass beside it."""

import math
from dataclasses import dataclass, replace

import numpy as np

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import TORCH_ABOVE_ROOT_M, ServoConfig, TorchAngles
from weldcal.welding.servo.state import WeldingState

CLEAR_M = 1.5e-3  # a choice: between the ball and the weld below it, the height of spatter
FARTHEST_M = 25e-3  # a choice: offsets of the largest fillets; a larger one is more likely a typing error
_STEP_M = 1e-3  # of the line: as the chord map of a weld
_WIDTH_M = 2e-3  # one sigma of the fit: 15 frames of the tip, as of the torch in the root pass
_LEAST_POINTS = 5.0  # effective, of a local line: as the torch's own fit
_OFF_M = 1e-9  # of a tip that is not pressed
_CLOSED_M = 1e-3  # between a ring's start and the end of its turn


class PassError(InputError):
    """A pass that cannot be welded."""


@dataclass(frozen=True, kw_only=True)
class WeldPass:
    """A pass after the root.

    Attributes:
        lateral_m, vertical_m: of its torch's path from that of the root, to the left of the root's travel and along the
            joint's bisector out of it.
        travel_rad: lean along its own travel, push positive; None: as the lift of the tip gives it.
        angle_rad: lean of the tool across the seam; positive: its left side, in the root's travel, is higher.
        speed_m_s: None: as the root. reverse: it is welded from the end to the start.
        interpass_s: least time since the arc of the pass before went out.
    """

    lateral_m: float = 0.0
    vertical_m: float = 0.0
    angle_rad: float = 0.0
    speed_m_s: float | None = None
    travel_rad: float | None = None
    reverse: bool = False
    interpass_s: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.lateral_m, self.vertical_m, self.angle_rad, self.interpass_s, self.speed_m_s or 1.0)
        if not all(map(math.isfinite, numbers)) or self.interpass_s < 0.0 or (self.speed_m_s or 1.0) < 0.0:
            raise PassError("A pass needs finite offsets, a positive speed, and an interpass time of zero or more.")
        if math.hypot(self.lateral_m, self.vertical_m) > FARTHEST_M:
            raise PassError(f"A pass may lie {1e3 * FARTHEST_M:g} mm from the root at most.")

    @property
    def lean_rad(self) -> float:
        """Lean in the travel of the pass itself."""
        return -self.angle_rad if self.reverse else self.angle_rad


def felt_line(state: WeldingState, ahead_m: float) -> SeamCurve:
    """The line of the tip's centre that a finished root pass has felt, from its start to its end and `ahead_m` on.

    The moved plan gives the shape, the tactile points what it is off by; in a gap this is interpolated, and beyond the
    points it stays.
    """
    assert state.plan_fit is not None
    curve, points = state.plan_fit.curve, state.refined.points
    s = np.arange(0.0, min(curve.drawn_m, state.s_end + ahead_m) + 0.5 * _STEP_M, _STEP_M)
    line, up = curve.position(s), curve.up(s)
    if len(points) > _LEAST_POINTS:
        at = np.empty(len(points))
        at[0] = float(curve.project(points[0], float(state.refined.arc[0]), 0.02))
        way = np.linalg.norm(np.diff(points, axis=0), axis=1)  # long where the tip was lifted over a tack
        for i in range(1, len(at)):
            at[i] = curve.nearest(points[i], at[i - 1] + way[i - 1])
        gap = points - curve.position(at)
        off = np.column_stack([np.sum(gap * curve.normal(at), axis=1), np.sum(gap * curve.up(at), axis=1)])
        left, above = _smoothed(s, at, off).T
        line = line + left[:, None] * curve.normal(s) + above[:, None] * up
    return SeamCurve.from_points(line, up, length=state.s_end)


def _smoothed(s: Array, at: Array, off: Array) -> Array:
    """Offsets (n, 2) m at arcs s (n,) by local lines through offsets (m, 2) at arcs (m,)."""
    x = (at - np.clip(s, at.min(), at.max())[:, None]) / _WIDTH_M
    w = np.exp(-0.5 * x**2)
    w0, w1, w2 = w.sum(axis=1), (w * x).sum(axis=1), (w * x**2).sum(axis=1)
    known = w0**2 > _LEAST_POINTS * (w**2).sum(axis=1)
    m0, m1 = w @ off, (w * x) @ off
    spread = np.maximum(w0 * w2 - w1**2, 1e-12)[:, None]
    value = (w2[:, None] * m0 - w1[:, None] * m1) / spread
    if not known.any():
        return np.broadcast_to(off.mean(axis=0), (len(s), 2))
    return np.column_stack([np.interp(s, s[known], value[known, k]) for k in range(2)])


def backwards(line: SeamCurve, ahead_m: float = 0.0, overlap_m: float = 0.0) -> SeamCurve:
    """The same line in the other direction; a ring that is welded `overlap_m` over its start goes on for `ahead_m`."""
    end, turn = line.length, line.length - overlap_m
    s = np.linspace(end, 0.0, max(9, math.ceil(end / _STEP_M)))
    if overlap_m and np.linalg.norm(line.position(turn) - line.position(0.0)) < _CLOSED_M:
        s = np.concatenate([s, np.arange(turn - _STEP_M, turn - ahead_m, -_STEP_M)])
    return SeamCurve.from_points(line.position(s), line.up(s), length=end if s[-1] > 0.0 else None)


def pass_line(
    felt: SeamCurve, order: WeldPass, root: ServoConfig, ball_m: float, ahead_m: float, overlap_m: float
) -> SeamCurve:
    """The line of a pass's lifted tip in its own travel, above the path of its torch.

    Args:
        felt: line of the tip in the root pass; root: its settings; ball_m: radius of the tip.
        ahead_m: how far the tip goes on at the end; overlap_m: of a ring.
    """
    line = felt.raised(order.vertical_m + lift_m(root, ball_m), root.tool.side_offset_m + order.lateral_m)
    return backwards(line, ahead_m, overlap_m) if order.reverse else line


def lift_m(root: ServoConfig, ball_m: float) -> float:
    """How much higher than in the root the tip hangs above its torch's path, m: clear of weld and tacks below that."""
    over_tacks = max((tack.lift + CLEAR_M for tack in root.tacks), default=0.0)
    return max(over_tacks, ball_m + CLEAR_M - (TORCH_ABOVE_ROOT_M - root.clearance_m))


def pass_config(root: ServoConfig, order: WeldPass, ball_m: float) -> ServoConfig:
    """Settings of a pass after the root: the tip is not used, and hangs above the path of the torch."""
    tool = replace(root.tool, torch_clearance_m=root.clearance_m - lift_m(root, ball_m), side_offset_m=0.0)
    angles = None
    if order.travel_rad is not None:
        half_rad = 0.5 * math.pi if root.angles is None else root.angles.half_angle_rad
        work, travel = order.lean_rad, order.travel_rad
        angles = TorchAngles(work_rad=(work, work), travel_rad=(travel, travel), half_angle_rad=half_rad)
    return replace(
        root,
        felt=False,
        tacks=(),
        angles=angles,
        tool=tool,
        touch=replace(root.touch, offset_m=0.0),
        deflection=replace(root.deflection, delta_d_m=_OFF_M, axial_d_m=_OFF_M),
        torch=replace(root.torch, work_angle_rad=order.lean_rad),
        weld_speed_m_s=order.speed_m_s or root.weld_speed_m_s,
    )
