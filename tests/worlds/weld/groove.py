"""Contact of the tip in the groove: a massless sphere on springs between two walls with Coulomb friction."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from weldcal.welding.numerics import Array, dot
from weldcal.welding.seam.curve import SeamCurve

STEP_S = 2.0e-3
_STIFF_LATERAL, _STIFF_AXIAL = 600.0, 300.0  # N/m
_SHARE = 1.0 - math.exp(-STEP_S / 0.030)  # a free or sliding tip relaxes in 30 ms
_MAX_SLIDE_M = 0.3e-3  # per step: 150 mm/s, the snap round a corner


@dataclass(frozen=True)
class Wedge:
    """The section of the groove and the ball that sits in it.

    Attributes:
        radius_m: of the tip; half_angle_rad: between the walls' bisector and each wall; depth_m: root to face.
        tilt_rad: of the bisector to the left. The contact keeps the surface's axes: it is a degree at most.
    """

    radius_m: float = 2.5e-3
    half_angle_rad: float = math.radians(22.5)
    depth_m: float = 8.0e-3
    tilt_rad: float = 0.0

    @cached_property
    def seat_m(self) -> float:
        """Distance of the seated tip's centre from the groove's root."""
        return self.radius_m / math.sin(self.half_angle_rad)

    @cached_property
    def drop_m(self) -> float:
        """How much lower the seated tip sits than on the face."""
        return self.depth_m + self.radius_m - self.seat_m

    @cached_property
    def steep(self) -> float:
        """Slope of the walls, height over width."""
        return 1.0 / math.tan(self.half_angle_rad)

    @cached_property
    def half_width_m(self) -> float:
        """From the middle to the sharp upper edge."""
        return self.depth_m * math.tan(self.half_angle_rad)

    @cached_property
    def wall_end_m(self) -> float:
        """Lateral place of the centre at which the tip leaves the wall for its edge."""
        return self.half_width_m - self.radius_m * math.cos(self.half_angle_rad)

    def seat_line(self, root: SeamCurve) -> SeamCurve:
        """Return the line of the seated tip's centre above a root line."""
        return root.raised(self.seat_m * math.cos(self.tilt_rad), self.seat_m * math.sin(self.tilt_rad))

    def floor(self, y: float) -> tuple[float, float]:
        """Lowest height m of the tip's centre over its seat at lateral place y m, and the slope there."""
        x = abs(y)
        if x <= self.wall_end_m:
            return x * self.steep, math.copysign(self.steep, y)
        if x >= self.half_width_m:
            return self.drop_m, 0.0
        # The centre rolls round the sharp upper edge.
        rise = math.sqrt(self.radius_m**2 - (self.half_width_m - x) ** 2)
        return self.depth_m - self.seat_m + rise, math.copysign((self.half_width_m - x) / rise, y)


DRAWN = Wedge()  # as the drawing says, and as the servo believes
SEAT_M, DROP_M = DRAWN.seat_m, DRAWN.drop_m


@dataclass(frozen=True)
class Groove:
    """The true groove: its tip line, the stretches (from, to) m where it is missing, and its wall's roughness.

    Attributes:
        rough: (N,) m to the left, evenly over the line's length.
        friction: Coulomb's coefficient; wedge: the section as it really is.
        tacks: from and to m, and how far the top lifts the seated ball, m.
    """

    line: SeamCurve
    gaps: tuple[tuple[float, float], ...] = ()
    rough: Array = field(default_factory=lambda: np.zeros(4))
    friction: float = 0.2
    wedge: Wedge = DRAWN
    tacks: tuple[tuple[float, float, float], ...] = ()

    def floor(self, s: float, y: float, wedge: Wedge) -> tuple[float, float]:
        """Lowest height m of the tip's centre over its seat at s and y m, and its slope across; a tack's ends slope."""
        low, slope = wedge.floor(y)
        for a, b, top in self.tacks:
            height = min(top, s - a, b - s)
            if height > low:
                low, slope = height, 0.0
        return low, slope

    def present(self, s: float) -> bool:
        """Return whether there is work under the tip at arc length s m."""
        return 0.0 <= s <= self.line.length and not any(a < s < b for a, b in self.gaps)


class TipPlace:
    """Where the tip's centre is: along, across and above the groove's tip line, m."""

    def __init__(self, rest: Array, groove: Groove) -> None:
        self._groove = groove
        self._wedge = groove.wedge
        self._rough = groove.rough.tolist()
        self.s = float(groove.line.project(rest))
        f = groove.line.frame(self.s)
        self.y, self.z = dot(rest - f.position, f.normal), dot(rest - f.position, f.up)
        self.touching = False

    def step(self, rest: Array, dt: float) -> Array:
        """Move for dt s towards balance with the spring's rest point (3,) m; the centre (3,) m.

        Along the groove the tip sticks within the friction of both walls and else slides until it is at that edge.
        Across, the walls' slope turns the axial spring into a lateral force, which both walls share at the seat.
        """
        groove, line, wedge = self._groove, self._groove.line, self._wedge
        r0, r1, r2 = rest.tolist()
        for _ in range(max(1, round(dt / STEP_S))):
            p0, p1, p2, t0, t1, t2, n0, n1, n2, u0, u1, u2, curvature = line.frame_numbers(self.s)
            g0, g1, g2 = r0 - p0, r1 - p1, r2 - p2
            gt = g0 * t0 + g1 * t1 + g2 * t2
            gn = g0 * n0 + g1 * n1 + g2 * n2 - self.y
            gb = g0 * u0 + g1 * u1 + g2 * u2 - self.z
            low, slope = groove.floor(self.s, self.y, wedge)
            lifted = gb > 0.0 or self.z > low + 1e-9
            if not groove.present(self.s) or (lifted and self.z + _SHARE * gb > low):
                self.touching = False
                self.s, self.y, self.z = self.s + _SHARE * gt, self.y + _SHARE * gn, self.z + _SHARE * gb
                if groove.present(self.s):
                    self.z = max(self.z, groove.floor(self.s, self.y, wedge)[0])
                continue
            self.touching = True
            self._slide(gt, gn, gb, low, slope, curvature)
        f = line.frame(self.s)
        side = self.y
        if self.touching:
            place = min(max(self.s / line.length, 0.0), 1.0) * (len(self._rough) - 1)
            i = min(int(place), len(self._rough) - 2)
            side += self._rough[i] + (place - i) * (self._rough[i + 1] - self._rough[i])
        return np.asarray(f.position + side * f.normal + self.z * f.up)

    def _slide(self, gt: float, gn: float, gb: float, low: float, slope: float, curvature: float) -> None:
        friction, wedge = self._groove.friction, self._wedge
        press, push = max(0.0, -_STIFF_AXIAL * gb), _STIFF_LATERAL * gn
        total = press / math.sin(wedge.half_angle_rad) if low < wedge.drop_m - 1e-9 else press
        hold = friction * total / _STIFF_LATERAL
        # The spring's force along a bent groove stiffens or yields with the lateral pull: below zero the tip snaps.
        yielding = 1.0 - curvature * (gn + self.y)
        way = max(0.0, abs(gt) - hold) / max(yielding, 0.05)
        self.s += math.copysign(min(way, _MAX_SLIDE_M), gt)
        seated = abs(self.y) < 1e-7
        if seated and abs(push) <= press * wedge.steep:
            self.y, self.z = 0.0, self._groove.floor(self.s, 0.0, wedge)[0]
            return
        drive = push - press * (math.copysign(wedge.steep, push) if seated else slope)
        drag = friction * press * math.sqrt(1.0 + slope * slope)
        if abs(drive) > drag:
            stiff = _STIFF_LATERAL + _STIFF_AXIAL * slope * slope
            move = _SHARE * math.copysign(abs(drive) - drag, drive) / stiff
            y = self.y + max(-_MAX_SLIDE_M, min(_MAX_SLIDE_M, move))
            self.y = 0.0 if y * self.y < 0.0 else y
        self.z = self._groove.floor(self.s, self.y, wedge)[0]
