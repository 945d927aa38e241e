"""Measures one groove from its coarse line: root and shoulder lines, ends, gaps and corners, each with a sigma."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from weldcal.welding.locate.groove.line import Corner, SmoothLine, round_corners, smoothing_weights, split_legs
from weldcal.welding.locate.groove.seam import GrooveConfig, GrooveNotFound, GrooveSeam, GrooveUncertain, Profile
from weldcal.welding.locate.groove.search import CoarseGroove
from weldcal.welding.locate.groove.section import (
    BAND_M,
    ENOUGH,
    STATION_M,
    Slices,
    agreed,
    common_profile,
    cut_slices,
    followed,
    measured_profile,
)
from weldcal.welding.locate.planes import Floats, into, point_pitch, thinned
from weldcal.welding.seam.curve import SeamCurve

MOST_POINTS = 400_000  # about one groove
THINNED = 0.9  # a pitch smaller than this times that of the search means that the cloud was thinned for the search
SIGMA_SCALE = 1.1  # on the slices' own sigmas, for errors common to neighbouring slices
# Common to the whole line, in point pitches: a choice, judged by tests of coverage (tests/welding/locate).
SIGMA_FLOOR_PITCHES = 0.04
SIGMA_FLOOR_NOISE = 0.20  # the same, in the scanner's noise
HEIGHT_FLOOR_NOISE = 0.25  # of the root: flying points off the walls increase with the scanner's noise
# The edge of a face lies up to half a pitch off: near the standard deviation of that, 1 / sqrt(12).
ONE_SIDED_PITCHES = 0.2
END_PITCHES, END_REACH_M = 0.12, 0.006
CORNER_REACH_M = 0.004  # a corner's error fades over the width of the sections beside it: no less than a groove is wide
GAP_ENDS = 0.6  # at a shadow's ends, of the lever in its middle: its few sections beside it are as uncertain


def measure_groove(
    points: Floats, groove: CoarseGroove, config: GrooveConfig, start_A: npt.ArrayLike | None
) -> GrooveSeam:
    """Refine a coarse centre line to the groove's root and shoulder lines."""
    f = into(groove.X_AQ, points)
    low = groove.line_Q.min(axis=0) - 0.03
    high = groove.line_Q.max(axis=0) + 0.03
    near = np.all((f[:, :2] > low) & (f[:, :2] < high), axis=1)
    around = f[near & (f[:, 2] < 0.003)]
    near &= (f[:, 2] > -config.search.max_depth_m) & (f[:, 2] < max(5.0 * groove.sigma_m, 0.003))
    f = f[near]
    # Later lines stay within a few millimetres of this one: points further away are not needed.
    rough = cKDTree(groove.line_Q[::4]).query(f[:, :2], distance_upper_bound=0.5 * groove.width_m + BAND_M + 0.012)[0]
    f = f[np.isfinite(rough)]
    # The openings were found in a thinned cloud; the measurement uses all points.
    f = thinned(f, MOST_POINTS)
    fine = point_pitch(f[np.abs(f[:, 2]) < 0.003][:, :2])
    groove = replace(groove, pitch_m=fine) if fine < THINNED * groove.pitch_m else groove
    pitch, sigma = groove.pitch_m, groove.sigma_m
    line = SmoothLine(groove.line_Q).even()
    if groove.closed:
        line = SmoothLine(np.vstack([groove.line_Q, groove.line_Q[:1]])).even()
    else:
        # The farthest cells of an opening are its corners: the ends of the coarse line lead there, not along the
        # groove.
        trim = min(groove.width_m, 0.25 * line.length)
        inner = (line.s >= trim) & (line.s <= line.length - trim)
        line = SmoothLine(line.points[inner]).extended(trim + 0.006, trim + 0.006)
    first_profile = measured_profile(f, line, groove, config)
    half_slice = max(0.0015, 1.5 * pitch, 0.003 * min(1.0, sigma / 0.0008))
    wide: list[Floats] = []
    for _ in range(3):
        whole, corners, profile = _traced(f, line, first_profile, groove, half_slice, config, wide)
        bends = [c.apex for c in corners if c.wide]
        if not bends:
            break
        # A corner that turns out to be a bend: follow the line again without a corner there.
        wide += bends
    corners = [c for c in corners if not c.wide]
    slices = agreed(cut_slices(f, whole, profile, sigma, pitch, half_slice, corners))
    return _finish(f, around, whole, slices, corners, groove, profile, config, start_A)


def _traced(
    f: Floats,
    line: SmoothLine,
    profile: Profile,
    groove: CoarseGroove,
    half_slice: float,
    config: GrooveConfig,
    wide: list[Floats],
) -> tuple[SmoothLine, list[Corner], Profile]:
    """Move the coarse line onto the groove in legs between its corners.

    The joined line, the corners and the common profile.
    """
    pitch, sigma = groove.pitch_m, groove.sigma_m
    lines: list[SmoothLine] = [line]
    corners: list[Corner] = []
    for step in range(4):
        lines = [followed(f, one, profile, sigma, pitch, half_slice, config, step > 0) for one in lines]
        if groove.closed:
            # The joint of a ring is measured from one side only, so it is moved at each iteration.
            lines = [lines[0].rolled()]
        elif step == 0:
            lines, corners = split_legs(lines[0], profile, wide)
        if step > 0:
            # The groove has one profile: its angle and depth, once known, constrain every slice.
            longest = max(lines, key=lambda one: one.length)
            slices = cut_slices(f, longest, profile, sigma, pitch, half_slice, [])
            profile = common_profile(f, longest, slices, profile, sigma, pitch)
    whole = lines[0]
    if corners:
        whole, corners = round_corners(f, lines, corners, profile, sigma, pitch)
    return whole, corners, profile


def _finish(
    f: Floats,
    around: Floats,
    line: SmoothLine,
    slices: Slices,
    corners: list[Corner],
    groove: CoarseGroove,
    profile: Profile,
    config: GrooveConfig,
    start_A: npt.ArrayLike | None,
) -> GrooveSeam:
    """Ends, gaps, smoothed lines and their sigmas, in the cloud's frame and in the direction of travel."""
    if len(slices.s) < 5:
        raise GrooveNotFound("An opening was found whose cross-sections show no V: it is not a groove to weld.")
    refuse_gap(f, line, slices, profile, config.steepest_wall_rad)
    first, last, gaps, ends_seen = _seen(f, around, line, slices, groove, profile, config)
    at = np.linspace(first, last, max(8, round((last - first) / STATION_M) + 1))
    for corner in corners:
        at = np.unique(np.append(at[np.abs(at - corner.s) > 0.0022], corner.s + np.arange(-0.002, 0.0021, 0.00025)))
    at = at[(at >= first) & (at <= last)]
    width = max(config.smoothing_m, 2.0 * slices.half_slice)
    smooth, errors = _smoothed(at, slices, width)
    sigma = _line_sigma(at, line, slices, groove, gaps, corners, errors["centre"], width, (first, last))
    _refuse_uncertain(at, sigma, gaps, [c for c in corners if first < c.s < last], groove, config)
    base, normal = line.at(at)
    moved = base + smooth["centre"][:, None] * normal
    root = np.column_stack([moved, smooth["root"]])
    left = np.column_stack([moved + smooth["left"][:, None] * normal, smooth["face_left"]])
    right = np.column_stack([moved + smooth["right"][:, None] * normal, smooth["face_right"]])
    depth = 0.5 * (smooth["face_left"] + smooth["face_right"]) - smooth["root"]
    if groove.closed:
        for one in (root, left, right):
            _close(one)
    R, p = groove.X_AQ.rotation().matrix(), groove.X_AQ.translation()
    lines = [v @ R.T + p for v in (root, left, right)]
    corners = [c for c in corners if first < c.s < last]
    corner_s = [c.s - first for c in corners]
    apexes = np.array([[*c.apex, np.interp(c.s, at, smooth["root"])] for c in corners]).reshape(-1, 3) @ R.T + p
    target = np.zeros(3) if start_A is None else np.asarray(start_A, dtype=np.float64)
    what = "the robot" if start_A is None else "the point given"
    word = f"starts at the end nearest to {what}"
    height_floor = math.hypot(0.25 * SIGMA_FLOOR_PITCHES * groove.pitch_m, HEIGHT_FLOOR_NOISE * groove.sigma_m)
    per_station = [sigma, np.hypot(errors["root"], height_floor), depth, smooth["angle"]]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lines[0], axis=0), axis=1))])
    if groove.closed:
        k = int(np.argmin(np.linalg.norm(lines[0] - target, axis=1)))
        order = np.concatenate([np.arange(k, len(at) - 1), np.arange(0, k + 1)])
        lines = [v[order] for v in lines]
        per_station = [v[order] for v in per_station]
        word = f"a closed seam, starts where it is nearest to {what}"
    elif np.linalg.norm(lines[0][-1] - target) < np.linalg.norm(lines[0][0] - target):
        lines = [lines[0][::-1], lines[2][::-1], lines[1][::-1]]
        per_station = [v[::-1] for v in per_station]
        gaps = [(last - b + first, last - a + first) for a, b in gaps][::-1]
        corner_s = [float(s[-1]) - c for c in corner_s][::-1]
        apexes, ends_seen = apexes[::-1], ends_seen[::-1]
    return GrooveSeam(
        curve=SeamCurve.from_points(lines[0], up=R[:, 2]),
        root=lines[0],
        left=lines[1],
        right=lines[2],
        s=s,
        depth=per_station[2],
        angle=per_station[3],
        sigma=per_station[0],
        sigma_height=per_station[1],
        gaps=tuple((a - first, b - first) for a, b in gaps),
        corners=tuple(corner_s),
        apexes=apexes,
        closed=groove.closed,
        ends_seen=ends_seen,
        start=word,
        pitch=groove.pitch_m,
        face_sigma=groove.sigma_m,
    )


def _seen(
    f: Floats,
    around: Floats,
    line: SmoothLine,
    slices: Slices,
    groove: CoarseGroove,
    profile: Profile,
    config: GrooveConfig,
) -> tuple[float, float, list[tuple[float, float]], tuple[bool, bool]]:
    """First and last arc length of the groove, its gaps, and which ends are ends of the plate.

    Raises:
        GrooveUncertain: too much of it is hidden.
    """
    first, last, gaps = measured_extent(f, line, profile, slices, groove)
    gaps = [_unmeasured(gap, slices) for gap in gaps]
    ends_seen = (True, True)
    if groove.closed:
        first, last = 0.0, line.length
    else:
        ends_seen = ends_at_edges(around, (first, last), line, profile, config.ground_reach_m)
        # The last section at the edge of a shadow is not reliable.
        first = first if ends_seen[0] else max(first, float(slices.s[1]))
        last = last if ends_seen[1] else min(last, float(slices.s[-2]))
    missing = sum(b - a for a, b in gaps)
    longest = max((b - a for a, b in gaps), default=0.0)
    if longest > config.longest_gap_m or missing > config.most_missing * (last - first):
        raise GrooveUncertain(
            f"{1e3 * missing:.0f} of {1e3 * (last - first):.0f} mm of the groove are hidden: clear the view or scan"
            " again from elsewhere."
        )
    return first, last, [(a, b) for a, b in gaps if a >= first and b <= last], ends_seen


def _smoothed(at: Floats, slices: Slices, width: float) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return what the sections measured, smoothed at arc lengths (N,), and its sigma (N,), each by name."""
    sigma, sigma_z = slices.sigma, slices.sigma_height
    even = np.ones(len(sigma))
    values = {
        "centre": (slices.column("centre"), sigma),
        "root": (slices.column("root"), sigma_z),
        "angle": (slices.column("angle"), sigma_z),
        "left": (np.array([x.shoulders[0] - x.centre for x in slices.sections]), sigma),
        "right": (np.array([x.shoulders[1] - x.centre for x in slices.sections]), sigma),
        "face_left": (np.array([x.faces[0] for x in slices.sections]), even),
        "face_right": (np.array([x.faces[1] for x in slices.sections]), even),
    }
    smooth: dict[str, Floats] = {}
    errors: dict[str, Floats] = {}
    for name, (value, spread) in values.items():
        own = smoothing_weights(slices.s, slices.s, spread, 2.0 * width)
        off = (value - own @ value) / (spread * np.sqrt(np.maximum(1.0 - np.diag(own), 0.1)))
        scale = 1.4826 * float(np.median(np.abs(off)))
        spread = spread * np.maximum(1.0, np.abs(off) / max(4.0 * scale, 1e-12))
        W = smoothing_weights(at, slices.s, spread, width)
        smooth[name] = W @ value
        errors[name] = SIGMA_SCALE * max(1.0, scale) * np.sqrt(np.square(W) @ np.square(spread))
    return smooth, errors


def _line_sigma(
    at: Floats,
    line: SmoothLine,
    slices: Slices,
    groove: CoarseGroove,
    gaps: list[tuple[float, float]],
    corners: list[Corner],
    sigma: Floats,
    width: float,
    ends: tuple[float, float],
) -> Floats:
    """Return the line's sigma (N,) m at arc lengths (N,): of sections, over gaps, of one wall, at ends and corners."""
    pitch = groove.pitch_m
    for a, b in gaps:
        hidden = (at > a) & (at < b)
        bend = max(line.tightest_bend((a, b)), 2.0)
        # Sections next to a shadow are few: a bridge is not much better known at its ends than in its middle.
        lever = np.maximum((at[hidden] - a) * (b - at[hidden]), GAP_ENDS * (0.5 * (b - a)) ** 2)
        sigma[hidden] += 0.25 * bend * lever
    # Where one wall was not measured the edge of the face replaces it, with an error common to the whole line.
    one_walled = np.array([float(min(x.on_walls) < ENOUGH) for x in slices.sections])
    one_sided = np.clip(smoothing_weights(at, slices.s, np.ones(len(one_walled)), width) @ one_walled, 0.0, 1.0)
    sigma = np.hypot(sigma, math.hypot(SIGMA_FLOOR_PITCHES * pitch, SIGMA_FLOOR_NOISE * groove.sigma_m))
    sigma = np.hypot(sigma, ONE_SIDED_PITCHES * pitch * one_sided)
    if not groove.closed:
        # The last sections have neighbours on one side only, and contain points of the plate's edge.
        sigma = np.hypot(sigma, END_PITCHES * pitch * np.exp(-np.minimum(at - ends[0], ends[1] - at) / END_REACH_M))
    for corner in corners:
        reach = max(corner.blind, corner.radius, CORNER_REACH_M)
        sigma = np.hypot(sigma, corner.sigma * np.exp(-0.5 * np.square((at - corner.s) / reach)))
    return sigma


def _refuse_uncertain(
    at: Floats,
    sigma: Floats,
    gaps: list[tuple[float, float]],
    corners: list[Corner],
    groove: CoarseGroove,
    config: GrooveConfig,
) -> None:
    """Raise GrooveUncertain where a corner, the seen line or a hidden bend is not known well enough."""
    scan = f"from this scan (noise {1e3 * groove.sigma_m:.2f} mm, points {1e3 * groove.pitch_m:.1f} mm apart)"
    hidden = np.zeros(len(at), dtype=bool)
    for a, b in gaps:
        hidden |= (at > a) & (at < b)
    for corner in corners:
        if corner.sigma > config.most_bridge_sigma_m:
            raise GrooveUncertain(
                f"The groove's corner may be sharp or round: its line there is only known to {1e3 * corner.sigma:.1f}"
                f" mm {scan}. Use a finer scanner or move it nearer."
            )
    mean = math.sqrt(np.mean(np.square(sigma[~hidden])))
    if mean > config.most_sigma_m:
        raise GrooveUncertain(
            f"The groove's root is only known to {1e3 * mean:.2f} mm {scan} and"
            f" {1e3 * config.most_sigma_m:.2f} mm are required. Use a finer scanner or move it nearer."
        )
    if np.max(sigma[hidden], initial=0.0) > config.most_bridge_sigma_m:
        longest = max(b - a for a, b in gaps)
        raise GrooveUncertain(
            f"{1e3 * longest:.0f} mm of the groove are hidden where it bends, and its line there is only known to "
            f"{1e3 * np.max(sigma[hidden]):.1f} mm: clear the view or scan again from elsewhere."
        )


def _unmeasured(gap: tuple[float, float], slices: Slices) -> tuple[float, float]:
    """The gap widened to the nearest sections on both sides."""
    before, after = slices.s[slices.s <= gap[0]], slices.s[slices.s >= gap[1]]
    low = min(gap[0], float(before[-1]) + slices.half_slice) if len(before) else gap[0]
    high = max(gap[1], float(after[0]) - slices.half_slice) if len(after) else gap[1]
    return low, high


def _close(line: Floats, over: int = 8) -> None:
    """Close a ring (N,3) in place, with the difference spread over the stations next to its ends."""
    gap = line[0] - line[-1]
    share = np.linspace(0.5, 0.0, over)[:, None]
    line[:over] -= share * gap
    line[-over:] += share[::-1] * gap


def measured_extent(
    f: Floats, line: SmoothLine, profile: Profile, slices: Slices, groove: CoarseGroove
) -> tuple[float, float, list[tuple[float, float]]]:
    """Arc lengths where the groove begins and ends, and the gaps in between that were not seen."""
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
    # Beyond the last valid section single points do not show where the groove runs.
    first = max(first, float(slices.s[0]) - 3.0 * slices.half_slice)
    last = min(last, float(slices.s[-1]) + 3.0 * slices.half_slice)
    jump = np.flatnonzero(np.diff(inside) > max(0.003, 5.0 * groove.pitch_m))
    gaps = [(float(inside[k]), float(inside[k + 1])) for k in jump if first <= inside[k] and inside[k + 1] <= last]
    # Half a pitch is lost at each end, less with many rows of points.
    rows = max(1.0, 1.5 * half_width / groove.pitch_m)
    loss = groove.pitch_m / (rows + 1.0)
    return first - loss, last + loss, gaps


def ends_at_edges(
    f: Floats, ends: tuple[float, float], line: SmoothLine, profile: Profile, reach_m: float
) -> tuple[bool, bool]:
    """Tell whether lower ground is seen within `reach_m` beyond each end.

    There the plate ends, and not only the view.
    """
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


def refuse_gap(f: Floats, line: SmoothLine, slices: Slices, profile: Profile, steepest_rad: float) -> None:
    """Raise GrooveNotFound for a flat floor (as deep half-way to the shoulders as in the middle) or vertical walls."""
    if max(profile.slopes) > math.tan(steepest_rad):
        raise GrooveNotFound(
            f"An opening {1e3 * profile.depth:.1f} mm deep was found with vertical walls: it is a gap or a slot, not a "
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
            f"An opening {1e3 * profile.depth:.1f} mm deep was found with a flat floor: it is a gap or a slot, not a "
            "V-groove."
        )
