"""Computes the motion that a planned seam requires of a tool whose torch trails its tip.

Turn, speed and travel angle.
"""

import math
from dataclasses import dataclass

import numpy as np

from weldcal.welding.numerics import Array
from weldcal.welding.seam.curve import SeamCurve


@dataclass(frozen=True, kw_only=True)
class ChordMap:
    """Tip and torch on the nominal plan, one row per torch position.

    Attributes:
        s_torch, s_tip: (n,) arc lengths m of the two ends of the chord.
        turn: (n,) psi_r - psi_t in rad; max_turn: the largest, unsigned.
        cos_torch: (n,) n_d . n_t.
        conditioning: (n,) sqrt((t_s . u)^2 + cos_torch^2); min_conditioning: the least.
        tip_speed, torch_speed: (n,) m/s that the projective law gives; speed_loss: largest share of torch speed lost.
        travel: (n,) rad, travel angle: pitch of the chord against the surface at the torch, negative nose down.
        back_up_m: how far the torch must run backwards.
    """

    s_torch: Array
    s_tip: Array
    turn: Array
    cos_torch: Array
    conditioning: Array
    tip_speed: Array
    torch_speed: Array
    travel: Array

    @property
    def back_up_m(self) -> float:
        """Longest distance that the torch must move backwards, m."""
        return float(np.max(np.maximum.accumulate(self.s_torch) - self.s_torch))

    @property
    def max_turn(self) -> float:
        """Largest |psi_r - psi_t|, rad."""
        return float(np.max(np.abs(self.turn)))

    @property
    def min_conditioning(self) -> float:
        """Least conditioning, 0..sqrt 2."""
        return float(np.min(self.conditioning))

    @property
    def speed_loss(self) -> float:
        """Largest relative loss of torch speed caused by the limits, 0..1."""
        top = float(np.max(self.torch_speed))
        return min(1.0, 1.0 - float(np.min(self.torch_speed)) / top) if top > 0.0 else 1.0

    def travel_at(self, s: Array) -> Array:
        """The predicted travel angle rad where the torch is at arc length s (n,) m."""
        return np.interp(s, np.maximum.accumulate(self.s_torch), self.travel)


def chord_map(
    plan: SeamCurve,
    d: float,
    weld_speed: float,
    tip_speed_limit: float = 0.040,
    omega_limit: float = 0.8,
    spacing: float = 0.5e-3,
    tip_left: float = 0.0,
) -> ChordMap:
    """Move the chord along the plan with both ends on it, from the torch d before the seam to the torch at its end.

    The pairs (tip, torch) at distance d form a curve whose tangent is (n_d . n_t, t_s . u): the projective law itself.
    It is followed by its own length, which covers a tip at rest while the torch moves, and a torch that backs up.

    Args:
        plan: the seam; straight beyond its ends.
        d: chord m.
        weld_speed, tip_speed_limit: m/s; omega_limit: rad/s.
        spacing: step along the pair curve, m.
        tip_left: the tip's end of the chord runs this far to the left of the seam, m: the rest point of a tip that
            leans.
    """
    pairs = [(0.0, -math.sqrt(d * d - tip_left * tip_left))]
    tip, torch = pairs[0]
    heading = (1.0, 1.0)
    farthest = torch
    for _ in range(math.ceil(6.0 * (plan.length + d) / spacing)):
        c_tip, c_torch, _ = _ends(plan, tip, torch, tip_left)
        size = math.hypot(c_tip, c_torch)
        if size > 1e-3:
            way = (c_torch / size, c_tip / size)
            # Through the fold of a hairpin the pair keeps its direction; only the torch may reverse.
            sense = 1.0 if way[0] * heading[0] + way[1] * heading[1] >= 0.0 else -1.0
            heading = (sense * way[0], sense * way[1])
        tip, torch = tip + spacing * heading[0], torch + spacing * heading[1]
        for _ in range(3):
            c_tip, c_torch, distance = _ends(plan, tip, torch, tip_left)
            pull = (d - distance) / max(c_tip * c_tip + c_torch * c_torch, 1e-3)
            tip, torch = tip + pull * c_tip, torch - pull * c_torch
            if abs(pull) < 1e-9:
                break
        pairs.append((tip, torch))
        farthest = max(farthest, torch)
        # A torch a whole chord back means a tool turned round in a hairpin: the rest is not needed.
        if torch >= plan.length or torch < farthest - d:
            break
    s_tip, s_torch = np.array(pairs).T
    u = (plan.position(s_tip) + tip_left * plan.normal(s_tip) - plan.position(s_torch)) / d
    t_tip, t_torch = plan.tangent(s_tip), plan.tangent(s_torch)
    cos_tip, cos_torch = np.sum(t_tip * u, axis=1), np.sum(t_torch * u, axis=1)
    up = plan.up(s_torch)
    turn = np.unwrap(np.arctan2(np.sum(np.cross(t_torch, t_tip) * up, axis=1), np.sum(t_torch * t_tip, axis=1)))
    tiny = 1e-9
    scale = np.minimum(
        weld_speed / np.maximum(np.abs(cos_tip), tiny), tip_speed_limit / np.maximum(np.abs(cos_torch), tiny)
    )
    scale = np.minimum(scale, omega_limit * d / np.maximum(np.abs(np.sin(turn)), tiny))
    travel = np.arcsin(np.clip(np.sum(u * up, axis=1), -1.0, 1.0))
    conditioning = np.hypot(cos_tip, cos_torch)
    return ChordMap(
        s_torch=s_torch,
        s_tip=s_tip,
        turn=turn,
        cos_torch=cos_torch,
        conditioning=conditioning,
        tip_speed=scale * cos_torch,
        torch_speed=scale * cos_tip,
        travel=travel,
    )


def _ends(plan: SeamCurve, tip: float, torch: float, tip_left: float) -> tuple[float, float, float]:
    """(tip direction . u, torch direction . u, distance m) of a pair of arc lengths.

    On the inside of a bend the tip's path is shorter.
    """
    x, y, z, tx, ty, tz, nx, ny, nz, _, _, _, curvature = plan.frame_numbers(tip)
    at_x, at_y, at_z, to_x, to_y, to_z, *_ = plan.frame_numbers(torch)
    x, y, z = x - at_x, y - at_y, z - at_z
    share = 1.0
    if tip_left != 0.0:
        x, y, z = x + tip_left * nx, y + tip_left * ny, z + tip_left * nz
        share = max(1.0 - curvature * tip_left, 0.1)
    distance = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    at_tip, at_torch = x * tx + y * ty + z * tz, x * to_x + y * to_y + z * to_z
    return share * at_tip / distance, at_torch / distance, distance
