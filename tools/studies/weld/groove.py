"""Contact of the tip in the groove: a massless sphere on springs between two walls with Coulomb friction."""

import math
from dataclasses import dataclass, field

import numpy as np

from weldcal.welding.numerics import Array, dot
from weldcal.welding.seam.curve import SeamCurve

RADIUS_M = 2.5e-3
HALF_ANGLE_RAD = math.radians(22.5)
DEPTH_M = 8.0e-3
SEAT_M = RADIUS_M / math.sin(HALF_ANGLE_RAD)  # centre of the seated tip above the groove's root
DROP_M = DEPTH_M + RADIUS_M - SEAT_M  # how much lower it sits than on the face
STEP_S = 2.0e-3
_HALF_WIDTH_M = DEPTH_M * math.tan(HALF_ANGLE_RAD)
_STIFF_LATERAL, _STIFF_AXIAL = 600.0, 300.0  # N/m
_STEEP = 1.0 / math.tan(HALF_ANGLE_RAD)
_SHARE = 1.0 - math.exp(-STEP_S / 0.030)  # a free or sliding tip relaxes in 30 ms
_MAX_SLIDE_M = 0.3e-3  # per step: 150 mm/s, the snap round a corner


def floor(y: float) -> tuple[float, float]:
    """Lowest height m of the tip's centre over its seat at lateral place y m, and the slope there."""
    x = abs(y)
    if x <= _HALF_WIDTH_M - RADIUS_M * math.cos(HALF_ANGLE_RAD):
        return x * _STEEP, math.copysign(_STEEP, y)
    if x >= _HALF_WIDTH_M:
        return DROP_M, 0.0
    # The centre rolls round the sharp upper edge.
    rise = math.sqrt(RADIUS_M**2 - (_HALF_WIDTH_M - x) ** 2)
    return DEPTH_M - SEAT_M + rise, math.copysign((_HALF_WIDTH_M - x) / rise, y)


@dataclass(frozen=True)
class Groove:
    """The true groove: its tip line, the stretches (from, to) m where it is missing, and its wall's roughness.

    Attributes:
        rough: (N,) m to the left, evenly over the line's length.
        friction: Coulomb's coefficient.
    """

    line: SeamCurve
    gaps: tuple[tuple[float, float], ...] = ()
    rough: Array = field(default_factory=lambda: np.zeros(4))
    friction: float = 0.2

    def present(self, s: float) -> bool:
        """Whether there is work under the tip at arc length s m."""
        return 0.0 <= s <= self.line.length and not any(a < s < b for a, b in self.gaps)


class Tip:
    """Where the tip's centre is: along, across and above the groove's tip line, m."""

    def __init__(self, rest: Array, groove: Groove) -> None:
        self._groove = groove
        self._rough = groove.rough.tolist()
        self.s = float(groove.line.project(rest))
        f = groove.line.frame(self.s)
        self.y, self.z = dot(rest - f.position, f.normal), dot(rest - f.position, f.up)
        self.touching = False

    def step(self, rest: Array, dt: float) -> Array:
        """Move for dt s towards balance with the spring's rest point (3,) m; the centre (3,) m.

        Along the groove the tip sticks within the friction of both walls and else slides until it is at that edge;
        across, the walls' slope turns the axial spring into a lateral force, which both walls share at the seat.
        """
        line = self._groove.line
        for _ in range(max(1, round(dt / STEP_S))):
            f = line.frame(self.s)
            gap = rest - f.position
            gt, gn, gb = dot(gap, f.tangent), dot(gap, f.normal) - self.y, dot(gap, f.up) - self.z
            low, slope = floor(self.y)
            if not self._groove.present(self.s) or (self.z > low + 1e-9 and self.z + _SHARE * gb > low):
                self.touching = False
                self.s, self.y, self.z = self.s + _SHARE * gt, self.y + _SHARE * gn, self.z + _SHARE * gb
                if self._groove.present(self.s):
                    self.z = max(self.z, floor(self.y)[0])
                continue
            self.touching = True
            self._slide(gt, gn, gb, low, slope, f.curvature)
        f = line.frame(self.s)
        side = self.y
        if self.touching:
            place = min(max(self.s / line.length, 0.0), 1.0) * (len(self._rough) - 1)
            i = min(int(place), len(self._rough) - 2)
            side += self._rough[i] + (place - i) * (self._rough[i + 1] - self._rough[i])
        return np.asarray(f.position + side * f.normal + self.z * f.up)

    def _slide(self, gt: float, gn: float, gb: float, low: float, slope: float, curvature: float) -> None:
        friction = self._groove.friction
        press, push = max(0.0, -_STIFF_AXIAL * gb), _STIFF_LATERAL * gn
        total = press / math.sin(HALF_ANGLE_RAD) if low < DROP_M - 1e-9 else press
        hold = friction * total / _STIFF_LATERAL
        # The spring's force along a bent groove stiffens or yields with the lateral pull: below zero the tip snaps.
        yielding = 1.0 - curvature * (gn + self.y)
        way = max(0.0, abs(gt) - hold) / max(yielding, 0.05)
        self.s += math.copysign(min(way, _MAX_SLIDE_M), gt)
        seated = abs(self.y) < 1e-7
        if seated and abs(push) <= press * _STEEP:
            self.y = self.z = 0.0
            return
        drive = push - press * (math.copysign(_STEEP, push) if seated else slope)
        drag = friction * press * math.sqrt(1.0 + slope * slope)
        if abs(drive) > drag:
            stiff = _STIFF_LATERAL + _STIFF_AXIAL * slope * slope
            move = _SHARE * math.copysign(abs(drive) - drag, drive) / stiff
            y = self.y + max(-_MAX_SLIDE_M, min(_MAX_SLIDE_M, move))
            self.y = 0.0 if y * self.y < 0.0 else y
        self.z = floor(self.y)[0]
