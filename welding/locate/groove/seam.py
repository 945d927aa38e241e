"""Data of a V-groove.

The expected profile, the measured seam with its sigmas, limits, and the errors that refuse it.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from weldcal.models.errors import WeldcalError
from weldcal.welding.locate.groove.search import SearchConfig
from weldcal.welding.locate.planes import Floats
from weldcal.welding.seam.curve import SeamCurve


class GrooveNotFound(WeldcalError):
    """The cloud shows no V-groove."""


class SeveralGrooves(WeldcalError):
    """The cloud shows more than one V-groove and no point selects one."""


class GrooveTooNarrow(WeldcalError):
    """The scanner's points lie too far apart for this groove."""


class GrooveUncertain(WeldcalError):
    """The groove was found, but its position is not accurate enough to weld."""


@dataclass(frozen=True, kw_only=True)
class GrooveConfig:
    """Limits of the groove extraction.

    Attributes:
        least_pitches: a groove must be this many point distances wide.
        smoothing_m: width of the Gaussian along the seam.
        most_sigma_m: a root that is less certain than this, outside gaps, is refused.
        longest_gap_m, most_missing: one gap, and the share of the whole seam, that may be bridged.
        steepest_wall_rad: steeper walls cannot be measured from above: an opening that has them is a gap.
        ground_reach_m: search length beyond an end for lower ground, which distinguishes the plate's end from the
            view's.
        most_bridge_sigma_m: how uncertain the line may be where it is bridged.
    """

    search: SearchConfig = field(default_factory=SearchConfig)
    least_pitches: float = 3.0
    smoothing_m: float = 0.0045
    most_sigma_m: float = 0.0005
    longest_gap_m: float = 0.045
    most_missing: float = 0.5
    most_bridge_sigma_m: float = 0.0015
    steepest_wall_rad: float = math.radians(78.0)
    ground_reach_m: float = 0.009


@dataclass(frozen=True)
class Profile:
    """The expected cross-section: slopes of the walls and depth, with their sigmas."""

    slopes: tuple[float, float]
    depth: float
    slope_sigma: float = 0.15  # relative
    depth_sigma: float = 0.30


@dataclass(frozen=True, eq=False, kw_only=True)
class GrooveSeam:
    """A measured V-groove, sampled every millimetre of arc length from its start.

    Metres, radians, in the cloud's frame A.

    curve                the root as a seam; at a sharp corner it and `root` are rounded with a radius of 0.5 mm root,
    left, right    (N,3) root and shoulder lines, left as one travels; s (N,) arc length of the root depth, angle
    (N,) of the root below the face, and between the walls sigma, sigma_height  (N,) standard deviations of the root
    sideways and in height gaps                 (from, to) arc lengths that were bridged and not seen; corners, apexes
    arc lengths of tight corners, and (K,3) where the two sides meet there ends_seen            whether first and last
    end lie at the edge of the face, not at the edge of what was seen start                a phrase that says which end
    is the start bend_radius          of a face bent over a
    cylinder, negative for a hollow one
    """

    curve: SeamCurve
    root: Floats
    left: Floats
    right: Floats
    s: Floats
    depth: Floats
    angle: Floats
    sigma: Floats
    sigma_height: Floats
    gaps: tuple[tuple[float, float], ...]
    corners: tuple[float, ...]
    apexes: Floats
    closed: bool
    ends_seen: tuple[bool, bool]
    start: str
    pitch: float
    face_sigma: float
    bend_radius: float = math.inf

    @property
    def width(self) -> float:
        """Median width of the opening, m."""
        return float(np.median(np.linalg.norm(self.left - self.right, axis=1)))

    @property
    def half_angle(self) -> float:
        """Half the median angle between the walls, rad."""
        return 0.5 * float(np.median(self.angle))

    @property
    def typical_sigma(self) -> float:
        """Rms over the seam of the root's sigma sideways, m."""
        return float(np.sqrt(np.mean(np.square(self.sigma))))

    @property
    def confidence(self) -> float:
        """Share of the seam that was seen, 0 to 1, less a tenth for each end that may be out of view."""
        hidden = sum(b - a for a, b in self.gaps) / float(self.s[-1])
        return max(0.0, 1.0 - hidden - 0.1 * self.ends_seen.count(False))

    @property
    def summary(self) -> str:
        """One sentence that describes the result."""
        kind = "closed V-groove" if self.closed else "V-groove"
        text = (
            f"a {kind} {1e3 * self.s[-1]:.0f} mm long, {1e3 * self.width:.1f} mm wide,"
            f" {1e3 * float(np.median(self.depth)):.1f} mm deep, {math.degrees(2.0 * self.half_angle):.0f} deg; its"
            f" root is known to {1e3 * self.typical_sigma:.2f} mm; {self.start}"
        )
        if math.isfinite(self.bend_radius):
            bent = "bent over" if self.bend_radius > 0.0 else "hollow with"
            text += f"; in a face {bent} a radius of {1e3 * abs(self.bend_radius):.0f} mm"
        for a, b in self.gaps:
            text += f"; not seen from {1e3 * a:.0f} to {1e3 * b:.0f} mm"
        for seen, end in zip(self.ends_seen, ("beginning", "end"), strict=True):
            text += "" if seen else f"; its {end} is not at the plate's edge and may be out of view"
        return text
