"""Where along its line a groove begins and ends, what of it is hidden, and whether its ends are those of the plate."""

from __future__ import annotations

import math

import numpy as np

from weldcal.welding.locate.groove_follow import Slices
from weldcal.welding.locate.groove_line import Line
from weldcal.welding.locate.groove_seam import GrooveNotFound
from weldcal.welding.locate.groove_search import CoarseGroove
from weldcal.welding.locate.groove_section import BAND_M, Profile
from weldcal.welding.locate.planes import Floats


def seen_extent(
    f: Floats, line: Line, profile: Profile, slices: Slices, groove: CoarseGroove
) -> tuple[float, float, list[tuple[float, float]]]:
    """Where along the line the groove begins and ends, and what is not seen of it in between."""
    half_width = profile.depth / min(profile.slopes)
    s, n, beside = line.coordinates(f[:, :2])
    centre = np.interp(s, slices.s, slices.column("centre"))
    run = np.abs(n - centre)
    expected = -profile.depth + min(profile.slopes) * run
    beside &= (run < 0.75 * half_width) & (np.abs(f[:, 2] - expected) < 0.35 * profile.depth)
    cell = max(0.0005, 0.75 * groove.pitch_m)
    counts = np.bincount((s[beside] / cell).astype(int), minlength=3)
    filled = np.flatnonzero(counts >= 1)
    sturdy = filled[[np.count_nonzero(counts[max(0, k - 2) : k + 3]) >= 3 for k in filled]]
    inside = np.sort(s[beside])
    first = float(inside[np.searchsorted(inside, sturdy[0] * cell)])
    last = float(inside[np.searchsorted(inside, (sturdy[-1] + 1) * cell) - 1])
    # Beyond the last section that makes sense single points do not tell where the groove goes.
    first = max(first, float(slices.s[0]) - 3.0 * slices.half_slice)
    last = min(last, float(slices.s[-1]) + 3.0 * slices.half_slice)
    jump = np.flatnonzero(np.diff(inside) > max(0.003, 5.0 * groove.pitch_m))
    gaps = [(float(inside[k]), float(inside[k + 1])) for k in jump if first <= inside[k] and inside[k + 1] <= last]
    # Half of a pitch is lost at each end, less what many rows make up for.
    rows = max(1.0, 1.5 * half_width / groove.pitch_m)
    loss = groove.pitch_m / (rows + 1.0)
    return first - loss, last + loss, gaps


def ends_at_edges(
    f: Floats, ends: tuple[float, float], line: Line, profile: Profile, reach_m: float
) -> tuple[bool, bool]:
    """Whether lower ground is seen within `reach_m` beyond each end: then the plate ends there, and not only the view."""
    half_width = profile.depth / min(profile.slopes)
    tail = line.extended(reach_m + 0.001, reach_m + 0.001)
    s, n, beside = tail.coordinates(f[:, :2])
    s = s - (reach_m + 0.001)
    strip = beside & (np.abs(n) < half_width + BAND_M)
    seen = []
    for end, sign in zip(ends, (-1.0, 1.0), strict=True):
        beyond = sign * (s - end)
        out = strip & (beyond > 0.002) & (beyond < reach_m)
        ground = out & (f[:, 2] < -1.3 * profile.depth)
        seen.append(bool(np.count_nonzero(ground) > max(5.0, 0.5 * np.count_nonzero(out))))
    return seen[0], seen[1]


def refuse_gap(f: Floats, line: Line, slices: Slices, profile: Profile, steepest_rad: float) -> None:
    """Raises GrooveNotFound where half-way to the shoulders it is as deep as in the middle, or the walls stand upright."""
    if max(profile.slopes) > math.tan(steepest_rad):
        raise GrooveNotFound(
            f"An opening {1e3 * profile.depth:.1f} mm deep was seen whose walls stand upright: it is a gap or a slot, not a "
            "V-groove."
        )
    s, n, beside = line.coordinates(f[:, :2])
    run = np.abs(n - np.interp(s, slices.s, slices.column("centre"))) / (0.5 * float(np.median(slices.column("width"))))
    middle, half_way = beside & (run < 0.15), beside & (run > 0.4) & (run < 0.7)
    if np.count_nonzero(middle) < 20 or np.count_nonzero(half_way) < 20:
        return
    ratio = float(np.median(f[half_way, 2]) / np.median(f[middle, 2]))
    if ratio > 0.8:
        raise GrooveNotFound(
            f"An opening {1e3 * profile.depth:.1f} mm deep was seen whose floor is flat: it is a gap or a slot, not a "
            "V-groove."
        )
