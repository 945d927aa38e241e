"""Propose the passes that fill a joint of two flat walls, from the area that the wire lays down.

A V groove and a fillet are the same wedge of half angle a about the bisector of their walls. An area A of metal with a
level surface fills it up to h = sqrt(A / tan a).

A layer that is wider than a bead may be is made of beads side by side.
"""

import math
from itertools import pairwise

from weldcal.welding.passes.felt import PassError, WeldPass

WIDEST_M = 12e-3  # a choice: of a stringer bead of 1.2 mm wire; a weave or two beads fill more
MOST_BEADS = 50  # of a layer: no arm welds more in one go


def bead_area(wire_feed_m_s: float, wire_m: float, speed_m_s: float) -> float:
    """Cross section m^2 of the metal that a wire of a diameter lays down at a travel speed, without spatter."""
    return wire_feed_m_s * 0.25 * math.pi * wire_m**2 / speed_m_s


def fill_height(area_m2: float, half_angle_rad: float) -> float:
    """Height m over the root to which an area fills a wedge."""
    return math.sqrt(area_m2 / math.tan(half_angle_rad))


def bead_places(from_m: float, to_m: float, half_angle_rad: float, beads: int) -> list[float]:
    """How far from the middle the centroids of beads of equal area lie, side by side in a layer, m.

    Args:
        from_m, to_m: heights of the layer over the root.
    """
    if beads == 1:
        return [0.0]
    tan, width = math.tan(half_angle_rad), (from_m + to_m) * math.tan(half_angle_rad) / beads
    edges = [width * (k - 0.5 * beads) for k in range(1, beads)]
    inner = [0.5 * (a + b) for a, b in pairwise(edges)]
    # the outer bead, from its edge e to the wall at y tan: moment and area of (e, y tan) over the layer's heights y
    e, d1, d2, d3 = edges[-1], to_m - from_m, to_m**2 - from_m**2, to_m**3 - from_m**3
    outer = 0.5 * (tan**2 * d3 / 3.0 - e**2 * d1) / (0.5 * tan * d2 - e * d1)
    return [-outer, *inner, outer]


def propose_passes(
    areas_m2: list[float], half_angle_rad: float, depth_m: float, widest_m: float = WIDEST_M
) -> list[WeldPass]:
    """The passes after the root that fill a wedge of a depth, each beside the last surface.

    Args:
        areas_m2: of the root's bead and of each bead after it, the last one's again.
        half_angle_rad: between a wall and the bisector: half of a groove's angle, 45 deg in a fillet.
        depth_m: height over the root up to which it is filled: of a fillet its throat.
        widest_m: of a bead.

    Raises:
        PassError: no area, or no wedge.
    """
    if not areas_m2 or min(areas_m2) <= 0.0 or not 0.0 < half_angle_rad < 0.5 * math.pi or depth_m <= 0.0:
        raise PassError("A proposal of passes needs beads with an area, and walls with an angle between them.")
    filled = areas_m2[0]
    found: list[WeldPass] = []
    while (height := fill_height(filled, half_angle_rad)) < depth_m - 1e-9:
        area = areas_m2[min(len(found) + 1, len(areas_m2) - 1)]
        beads, top = 1, fill_height(filled + area, half_angle_rad)
        while (height + top) * math.tan(half_angle_rad) > beads * widest_m and beads < MOST_BEADS:
            beads += 1
            top = fill_height(filled + beads * area, half_angle_rad)
        places = bead_places(height, top, half_angle_rad, beads)
        found += [WeldPass(lateral_m=x, vertical_m=height) for x in places]
        filled += beads * area
    return found


def filling_passes(
    root_m2: float, area_m2: float, half_angle_rad: float, depth_m: float, widest_m: float = WIDEST_M
) -> tuple[list[WeldPass], float]:
    """The passes after the root that fill a wedge to its depth, and the area of each that fills it exactly, m^2.

    Args:
        root_m2: of the root's bead; area_m2: of a bead after it, near which the answer is.

    Raises:
        PassError: as propose_passes, or no number of beads of one area fills it.
    """
    rest = math.tan(half_angle_rad) * depth_m**2 - root_m2
    if not propose_passes([root_m2, area_m2], half_angle_rad, depth_m, widest_m) or rest <= 0.0:
        return [], area_m2
    least = max(1, round(rest / area_m2))
    for beads in range(least, least + MOST_BEADS):
        passes = propose_passes([root_m2, rest / beads], half_angle_rad, depth_m, widest_m)
        if len(passes) == beads:
            return passes, rest / beads
    raise PassError("No number of equal beads fills this joint: change the wire feed, the speed or the widest bead.")
