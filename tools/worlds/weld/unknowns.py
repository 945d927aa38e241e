"""What of the weld study's world differs from what the servo believes: time stamps, wedge, tip, seat and lag."""

import math
from dataclasses import astuple, dataclass, fields

import numpy as np

from weldcal.tools.worlds.weld.groove import DRAWN, Wedge

Range = tuple[float, float]
_NONE = (0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """Ranges (low, high) from which a seed draws one world, evenly; SI units. The servo gets none of it.

    Attributes:
        image_bias_s, pose_bias_s: how late a picture or a pose is stamped; image_jitter_s, pose_jitter_s: one sigma of
            each single stamp.
        left_wall_rad, right_wall_rad: how much farther each wall of the groove is open.
        wear_m: lost of the tip's radius; seat_m: how much higher the tip sits than wedge and radius say.
        lag_share: the robot's lag over the one that the servo looks ahead by; None leaves the budget's.
    """

    image_bias_s: Range = _NONE
    image_jitter_s: Range = _NONE
    pose_bias_s: Range = _NONE
    pose_jitter_s: Range = _NONE
    left_wall_rad: Range = _NONE
    right_wall_rad: Range = _NONE
    wear_m: Range = _NONE
    seat_m: Range = _NONE
    lag_share: Range | None = None


NOTHING_UNKNOWN = Unknowns()


@dataclass(frozen=True, kw_only=True)
class WeldUnknowns:
    """One draw: as in Unknowns; `lag_share` NaN where the budget's lag holds."""

    image_bias_s: float = 0.0
    image_jitter_s: float = 0.0
    pose_bias_s: float = 0.0
    pose_jitter_s: float = 0.0
    left_wall_rad: float = 0.0
    right_wall_rad: float = 0.0
    wear_m: float = 0.0
    seat_m: float = 0.0
    lag_share: float = math.nan

    @property
    def wedge(self) -> Wedge:
        """The groove's section as it really is, with the tip as it really is."""
        return Wedge(
            DRAWN.radius_m - self.wear_m,
            DRAWN.half_angle_rad + 0.5 * (self.left_wall_rad + self.right_wall_rad),
            DRAWN.depth_m,
            0.5 * (self.left_wall_rad - self.right_wall_rad),
        )

    def lag_s(self, budget_s: float, believed_s: float) -> float:
        """The robot's lag: the budget's, or a share of the servo's own."""
        return budget_s if math.isnan(self.lag_share) else self.lag_share * believed_s


def draw_world(unknowns: Unknowns, seed: int) -> WeldUnknowns:
    """The world of a seed, from a generator of its own: the other errors of a run do not change with it."""
    rng = np.random.default_rng((seed, 1))
    ranges = zip((field.name for field in fields(WeldUnknowns)), astuple(unknowns), strict=True)
    return WeldUnknowns(**{name: math.nan if r is None else float(rng.uniform(*r)) for name, r in ranges})
