"""Where along its line a groove begins and ends, what of it is hidden, and whether its ends are those of the plate."""

from __future__ import annotations

import math

import numpy as np

from weldcal.welding.groove_follow import Slices
from weldcal.welding.groove_line import Line
from weldcal.welding.groove_search import CoarseGroove
from weldcal.welding.groove_section import BAND_M, Profile
from weldcal.welding.planes import Floats


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
    jump = np.flatnonzero(np.diff(inside) > max(0.003, 3.0 * groove.pitch_m))
    gaps = [(float(inside[k]), float(inside[k + 1])) for k in jump if first <= inside[k] and inside[k + 1] <= last]
    # Half of a pitch is lost at each end, less what many rows make up for.
    rows = max(1.0, 1.5 * half_width / groove.pitch_m)
    loss = groove.pitch_m / (rows + 1.0)
    return first - loss, last + loss, gaps


def one_lap(line: Line, gaps: list[tuple[float, float]]) -> tuple[float, float, list[tuple[float, float]]]:
    """From the middle of the overlap round to itself."""
    first = 0.015
    start = line.at(np.array([first]))[0][0]
    late = line.s > 0.5 * line.length
    k = int(np.argmin(np.where(late, np.linalg.norm(line.points - start, axis=1), math.inf)))
    last = float(line.s[k])
    return first, last, [(max(a, first), min(b, last)) for a, b in gaps if b > first and a < last]


def ends_at_edges(f: Floats, base: Floats, at: Floats, line: Line, profile: Profile, pitch: float) -> tuple[bool, bool]:
    """Whether the face beside the groove ends where the groove does: then it is the edge of the plate."""
    half_width = profile.depth / min(profile.slopes)
    s, n, beside = line.coordinates(f[:, :2])
    strip = (
        beside & (np.abs(n) > half_width + 0.001) & (np.abs(n) < half_width + BAND_M) & (f[:, 2] > -0.4 * profile.depth)
    )
    seen = []
    for end, sign in ((at[0], -1.0), (at[-1], 1.0)):
        beyond = sign * (s - end)
        out, back = (beyond > 0.002) & (beyond < 0.008), (beyond > -0.008) & (beyond < -0.002)
        seen.append(bool(np.count_nonzero(strip & out) < 0.25 * max(int(np.count_nonzero(strip & back)), 1)))
    return seen[0], seen[1]
