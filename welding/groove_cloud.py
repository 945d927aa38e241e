"""A weld seam from a cloud alone: the V-groove in a plate's face becomes its root and both shoulders, with their sigma.

No drawing takes part. Openings in flat faces are found coarsely (groove_search); slices across them are fitted with a V
(groove_section), each slice with points of its own; the centres' offsets are smoothed along the line, the line is moved
by them, and so again until it stays. Every figure carries a sigma, scaled by how much neighbouring slices really differ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform

from weldcal.models.errors import InputError, WeldcalError
from weldcal.welding.groove_corner import Corner, round_corners, split_legs
from weldcal.welding.groove_line import Line, smoothing_weights
from weldcal.welding.groove_search import CoarseGroove, SearchConfig, find_grooves
from weldcal.welding.groove_section import BAND_M, Profile, Section, fit_section
from weldcal.welding.planes import Floats, into
from weldcal.welding.seam import SeamCurve

STATION_M = 0.001


class GrooveNotFound(WeldcalError):
    """The cloud shows no V-groove."""


class SeveralGrooves(WeldcalError):
    """The cloud shows more than one V-groove and nothing says which is meant."""


class GrooveTooNarrow(WeldcalError):
    """The scanner's points lie too far apart for this groove."""


class GrooveUncertain(WeldcalError):
    """The groove is there, but not known well enough to weld."""


@dataclass(frozen=True)
class GrooveConfig:
    """Limits of the extraction.

    least_pitches  a groove must be this many point distances wide
    smoothing_m    width of the Gaussian along the seam
    most_sigma_m   a root that is less certain than this, outside gaps, is refused
    longest_gap_m, most_missing   one gap, and the share of the whole seam, that may be bridged
    """

    search: SearchConfig = field(default_factory=SearchConfig)
    least_pitches: float = 3.0
    smoothing_m: float = 0.0045
    most_sigma_m: float = 0.0005
    longest_gap_m: float = 0.090
    most_missing: float = 0.5
    steepest_wall_rad: float = math.radians(82.0)


@dataclass(frozen=True, eq=False)
class GrooveSeam:
    """A V-groove, by arc length from its start, every millimetre; metres and radians, in the cloud's frame A.

    curve                the root as a seam; at a sharp corner it and `root` are rounded with a radius of 0.5 mm
    root, left, right    (N,3) root and shoulder lines, left as one travels; s (N,) arc length of the root
    depth, angle         (N,) of the root below the face, and between the walls
    sigma, sigma_height  (N,) standard deviations of the root sideways and in height
    gaps                 (from, to) arc lengths that were bridged and not seen;
    corners, apexes      arc lengths of tight corners, and (K,3) where the two sides meet there
    ends_seen            whether first and last end lie at the edge of the face, not at the edge of what was seen
    start                in words, which end is the start
    X_AF                 the face: origin on it, z up out of it
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
    X_AF: RigidTransform
    pitch: float
    face_sigma: float
    n_sections: int

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


def extract_groove(
    points_A: npt.NDArray[np.floating],
    *,
    hint_A: npt.ArrayLike | None = None,
    start_A: npt.ArrayLike | None = None,
    config: GrooveConfig | None = None,
) -> GrooveSeam:
    """The V-groove in a cloud (N,3) or (H,W,3), metres, z roughly up out of the face, NaN where unmeasured.

    hint_A (3,): where several grooves are in view, the one nearest to this point. start_A (3,): the seam starts at the
    end nearest to it; without it at the end nearest to the origin of A (the robot, for a cloud in its base).

    Raises:
        GrooveNotFound, SeveralGrooves, GrooveTooNarrow, GrooveUncertain: in a sentence; InputError: wrong shape.
    """
    config = config or GrooveConfig()
    points = np.asarray(points_A, dtype=np.float64)
    if points.ndim < 2 or points.shape[-1] != 3:
        raise InputError(f"A cloud has the shape (N, 3) or (H, W, 3): this one is {points.shape}.")
    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 1000:
        raise GrooveNotFound(f"The cloud has only {len(points)} points: move the workpiece into view.")
    coarse, noise = find_grooves(points, config.search)
    seams: list[GrooveSeam] = []
    failures: list[WeldcalError] = []
    for groove in coarse:
        try:
            seams.append(_measure(points, groove, config, start_A))
        except WeldcalError as error:
            failures.append(error)
    if not seams and failures:
        # A groove that was seen but cannot be used says more than an opening that is none.
        raise next((e for e in failures if not isinstance(e, GrooveNotFound)), failures[0])
    if not seams:
        least = max(4.0 * noise, 0.0008)
        raise GrooveNotFound(
            f"No groove in any flat face: one of at least {1e3 * config.search.shortest_m:.0f} mm length and at most "
            f"{1e3 * config.search.max_width_m:.0f} mm width, deeper than {1e3 * 2.0 * least:.1f} mm, would be seen here."
        )
    if len(seams) == 1:
        return seams[0]
    if hint_A is None:
        where = "; ".join(f"{1e3 * g.s[-1]:.0f} mm long near {_mm(g.root[len(g.root) // 2])}" for g in seams)
        raise SeveralGrooves(f"{len(seams)} grooves are in view ({where}): say which by a point near it.")
    hint = np.asarray(hint_A, dtype=np.float64)
    return min(seams, key=lambda g: float(np.linalg.norm(g.root - hint, axis=1).min()))


def _mm(p: Floats) -> str:
    return "({:.0f}, {:.0f}, {:.0f}) mm".format(*(1e3 * p))


@dataclass(frozen=True, eq=False)
class _Slices:
    """Fitted sections along a line: where, and their sigma sideways and in height (not yet scaled)."""

    s: Floats
    sections: list[Section]
    half_slice: float

    def column(self, name: str) -> Floats:
        return np.array([getattr(section, name) for section in self.sections], dtype=np.float64)

    @property
    def sigma(self) -> Floats:
        return np.sqrt([section.covariance[0, 0] for section in self.sections])

    @property
    def sigma_height(self) -> Floats:
        return np.sqrt([section.covariance[1, 1] for section in self.sections])


def _measure(points: Floats, groove: CoarseGroove, config: GrooveConfig, start_A: npt.ArrayLike | None) -> GrooveSeam:
    """The groove's lines, refined from its coarse centre line."""
    f = into(groove.X_AQ, points)
    low = groove.line_Q.min(axis=0) - 0.03
    high = groove.line_Q.max(axis=0) + 0.03
    near = np.all((f[:, :2] > low) & (f[:, :2] < high), axis=1)
    near &= (f[:, 2] > -config.search.max_depth_m) & (f[:, 2] < max(5.0 * groove.sigma_m, 0.003))
    f = f[near]
    pitch, sigma = groove.pitch_m, groove.sigma_m
    overlap = round(0.030 / STATION_M)
    line = Line(groove.line_Q).even()
    if groove.closed:
        line = Line(np.vstack([groove.line_Q, groove.line_Q[:overlap]])).even()
    else:
        # The farthest cells of an opening are its corners: the coarse line's ends lead there and not along it.
        trim = min(groove.width_m, 0.25 * line.length)
        inner = (line.s >= trim) & (line.s <= line.length - trim)
        line = Line(line.points[inner]).extended(trim + 0.006, trim + 0.006)
    profile = _profile(f, line, groove, config)
    lines, corners = [line], []
    half_slice = max(0.0015, 1.5 * pitch, 0.003 * min(1.0, sigma / 0.0008))
    for step in range(4):
        lines = [_followed(f, one, profile, sigma, pitch, half_slice, config, step > 0) for one in lines]
        if step == 0:
            lines, corners = split_legs(lines[0], profile)
    whole = lines[0]
    if corners:
        whole, corners = round_corners(f, lines, corners, profile, sigma)
    slices = _agreed(_slices(f, whole, profile, sigma, pitch, half_slice, corners))
    return _finish(f, whole, slices, corners, groove, profile, config, start_A)


def _profile(f: Floats, line: Line, groove: CoarseGroove, config: GrooveConfig) -> Profile:
    """The groove's cross-section over its whole length, from the coarse line."""
    _, n, beside = line.coordinates(f[:, :2])
    beside &= np.abs(n) < 0.5 * groove.width_m + BAND_M + 0.003
    n, z = n[beside], f[beside, 2]
    if groove.width_m < config.least_pitches * groove.pitch_m * 0.7:
        raise _too_narrow(groove.width_m, groove.pitch_m, config)
    inner = np.abs(n) < 0.3 * groove.width_m
    if np.count_nonzero(inner) < 20:
        raise GrooveNotFound(
            f"An opening {1e3 * groove.width_m:.1f} mm wide was seen, but nothing in it: look from above."
        )
    depth = -float(np.percentile(z[inner], 10.0))
    slope = depth / (0.5 * groove.width_m)
    guess = Profile((slope, slope), depth, slope_sigma=1.0, depth_sigma=1.0)
    best = fit_section(n, z, (0.0, guess), groove.sigma_m, groove.pitch_m, faces_known=False)
    if (
        best is None
        or best.agreeing < 0.2
        or best.depth < 5.0 * groove.sigma_m
        or max(best.slopes) > math.tan(config.steepest_wall_rad)
    ):
        raise GrooveNotFound(
            f"An opening {1e3 * groove.width_m:.1f} mm wide and {1e3 * depth:.1f} mm deep was seen, but it has no two "
            "sloping walls: it is a gap or a step, not a V-groove."
        )
    if best.width < config.least_pitches * groove.pitch_m:
        raise _too_narrow(best.width, groove.pitch_m, config)
    return Profile(best.slopes, best.depth)


def _too_narrow(width: float, pitch: float, config: GrooveConfig) -> GrooveTooNarrow:
    return GrooveTooNarrow(
        f"The groove is {1e3 * width:.1f} mm wide and the scan's points are {1e3 * pitch:.1f} mm apart: "
        f"{width / pitch:.1f} of the {config.least_pitches:.0f} point distances it takes; move the scanner nearer or use "
        "a finer one."
    )


def _slices(
    f: Floats, line: Line, profile: Profile, sigma: float, pitch: float, half_slice: float, corners: list[Corner]
) -> _Slices:
    """Sections one beside the other along a line, each from points of its own; none within reach of a sharp corner."""
    half_width = profile.depth / min(profile.slopes)
    s, n, beside = line.coordinates(f[:, :2])
    # What lies deeper than the root is the table beyond the plate's edge.
    beside &= (np.abs(n) < half_width + BAND_M + 0.002) & (f[:, 2] > -1.3 * profile.depth - 4.0 * sigma)
    order = np.argsort(s[beside])
    s, n, z = (v[beside][order] for v in (s, n, f[:, 2]))
    centers = np.arange(half_slice, line.length, 2.0 * half_slice)
    bounds = np.searchsorted(s, np.append(centers - half_slice, centers[-1] + half_slice))
    keep, sections = [], []
    for k, center in enumerate(centers):
        if any(abs(center - c.s) < c.blind for c in corners):
            continue
        part = slice(bounds[k], bounds[k + 1])
        section = fit_section(n[part], z[part], (0.0, profile), sigma, pitch)
        if section is None or section.agreeing < 0.4 or not 0.5 < section.depth / profile.depth < 1.6:
            continue
        if abs(section.centre) < half_width and math.sqrt(section.covariance[0, 0]) < 0.4 * half_width:
            keep.append(center)
            sections.append(section)
    return _Slices(np.array(keep), sections, half_slice)


def _agreed(slices: _Slices) -> _Slices:
    """Without the sections that have few points, or that their neighbours deny."""
    if len(slices.s) < 5:
        return slices
    points = np.array([sum(x.on_walls) for x in slices.sections])
    good = points >= max(5.0, 0.35 * float(np.median(points)))
    for name, least in (("centre", 2e-4), ("root", 4e-4)):
        value = slices.column(name)
        # Median of the five before and the five behind: one-sided at an end, where most of the wrong ones are.
        around = np.array([np.median(value[max(0, k - 5) : k + 6]) for k in range(len(value))])
        off = np.abs(value - around)
        good &= off < max(least, 6.0 * float(np.median(off)))
    return _Slices(
        slices.s[good], [x for x, keep in zip(slices.sections, good, strict=True) if keep], slices.half_slice
    )


def _followed(
    f: Floats,
    line: Line,
    profile: Profile,
    sigma: float,
    pitch: float,
    half_slice: float,
    config: GrooveConfig,
    settled: bool,
) -> Line:
    """The line moved to where its sections have their centres, smoothly."""
    slices = _slices(f, line, profile, sigma, pitch, half_slice, [])
    slices = _agreed(slices) if settled else slices
    if len(slices.s) < 5:
        raise GrooveNotFound("An opening was seen whose cross-sections show no V: it is not a groove to weld.")
    r, weight = slices.column("centre"), slices.sigma
    at = np.arange(0.0, line.length + STATION_M, STATION_M)
    # Wider than the last smoothing: moving a line again and again keeps ever more of the noise.
    width = FOLLOW * max(config.smoothing_m, 2.0 * half_slice)
    for _ in range(2):
        smooth = smoothing_weights(slices.s, slices.s, weight, width) @ r
        off = np.abs(r - smooth)
        # A section that its neighbours deny counts for little.
        weight = np.where(off > 4.0 * np.median(off) + 5e-5, 10.0, 1.0) * slices.sigma
    W = smoothing_weights(np.clip(at, slices.s[0], slices.s[-1]), slices.s, weight, width)
    return line.moved(at, W @ r)


def _finish(
    f: Floats,
    line: Line,
    slices: _Slices,
    corners: list[Corner],
    groove: CoarseGroove,
    profile: Profile,
    config: GrooveConfig,
    start_A: npt.ArrayLike | None,
) -> GrooveSeam:
    """Ends, gaps, smoothed lines and their sigmas, in the cloud's frame and in the direction of travel."""
    if len(slices.s) < 5:
        raise GrooveNotFound("An opening was seen whose cross-sections show no V: it is not a groove to weld.")
    pitch = groove.pitch_m
    first, last, gaps = _extent(f, line, profile, slices, groove)
    if groove.closed:
        first, last, gaps = _one_lap(line, gaps)
    missing = sum(b - a for a, b in gaps)
    longest = max((b - a for a, b in gaps), default=0.0)
    if longest > config.longest_gap_m or missing > config.most_missing * (last - first):
        raise GrooveUncertain(
            f"{1e3 * missing:.0f} of {1e3 * (last - first):.0f} mm of the groove are hidden: clear the view or scan again "
            "from elsewhere."
        )
    at = np.linspace(first, last, max(8, round((last - first) / STATION_M) + 1))
    for corner in corners:
        at = np.unique(np.append(at[np.abs(at - corner.s) > 0.0022], corner.s + np.arange(-0.002, 0.0021, 0.00025)))
    at = at[(at >= first) & (at <= last)]
    sigma, sigma_z = slices.sigma, slices.sigma_height
    width = max(config.smoothing_m, 2.0 * slices.half_slice)
    values = {
        "centre": (slices.column("centre"), sigma),
        "root": (slices.column("root"), sigma_z),
        "angle": (slices.column("angle"), sigma_z),
        "left": (np.array([x.shoulders[0] - x.centre for x in slices.sections]), sigma),
        "right": (np.array([x.shoulders[1] - x.centre for x in slices.sections]), sigma),
        "face_left": (np.array([x.faces[0] for x in slices.sections]), np.ones(len(sigma))),
        "face_right": (np.array([x.faces[1] for x in slices.sections]), np.ones(len(sigma))),
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
    for a, b in gaps:
        hidden = (at > a) & (at < b)
        bend = max(float(np.percentile(np.abs(line.curvatures), 95.0)), 2.0)
        errors["centre"][hidden] += 0.25 * bend * (at[hidden] - a) * (b - at[hidden])
    sigma = np.hypot(errors["centre"], SIGMA_FLOOR_PITCHES * pitch)
    seen = ~np.any([(at > a) & (at < b) for a, b in gaps], axis=0) if gaps else np.ones(len(at), dtype=bool)
    if np.sqrt(np.mean(np.square(sigma[seen]))) > config.most_sigma_m:
        raise GrooveUncertain(
            f"The groove's root is only known to {1e3 * np.sqrt(np.mean(np.square(sigma[seen]))):.2f} mm from this scan "
            f"(noise {1e3 * groove.sigma_m:.2f} mm, points {1e3 * pitch:.1f} mm apart) and "
            f"{1e3 * config.most_sigma_m:.2f} mm are required: use a finer scanner or move it nearer."
        )
    base, normal = line.at(at)
    moved = base + smooth["centre"][:, None] * normal
    root = np.column_stack([moved, smooth["root"]])
    left = np.column_stack([moved + smooth["left"][:, None] * normal, smooth["face_left"]])
    right = np.column_stack([moved + smooth["right"][:, None] * normal, smooth["face_right"]])
    depth = 0.5 * (smooth["face_left"] + smooth["face_right"]) - smooth["root"]
    R, p = groove.X_AQ.rotation().matrix(), groove.X_AQ.translation()
    lines = [v @ R.T + p for v in (root, left, right)]
    ends_seen = _ends_seen(f, base, at, line, profile, pitch) if not groove.closed else (True, True)
    corners = [c for c in corners if first < c.s < last]
    corner_s = [c.s - first for c in corners]
    apexes = np.array([[*c.apex, np.interp(c.s, at, smooth["root"])] for c in corners]).reshape(-1, 3) @ R.T + p
    target = np.zeros(3) if start_A is None else np.asarray(start_A, dtype=np.float64)
    what = "the robot" if start_A is None else "the point given"
    word = f"starts at the end nearest to {what}"
    per_station = [sigma, np.hypot(errors["root"], 0.25 * SIGMA_FLOOR_PITCHES * pitch), depth, smooth["angle"]]
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
    curve = SeamCurve.from_points(lines[0], up=R[:, 2])
    return GrooveSeam(
        curve=curve,
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
        X_AF=groove.X_AQ,
        pitch=pitch,
        face_sigma=groove.sigma_m,
        n_sections=len(slices.s),
    )


SIGMA_SCALE = 1.2
FOLLOW = 3.0
SIGMA_FLOOR_PITCHES = 0.02


def _extent(
    f: Floats, line: Line, profile: Profile, slices: _Slices, groove: CoarseGroove
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


def _one_lap(line: Line, gaps: list[tuple[float, float]]) -> tuple[float, float, list[tuple[float, float]]]:
    """From the middle of the overlap round to itself."""
    first = 0.015
    start = line.at(np.array([first]))[0][0]
    late = line.s > 0.5 * line.length
    k = int(np.argmin(np.where(late, np.linalg.norm(line.points - start, axis=1), math.inf)))
    last = float(line.s[k])
    return first, last, [(max(a, first), min(b, last)) for a, b in gaps if b > first and a < last]


def _ends_seen(f: Floats, base: Floats, at: Floats, line: Line, profile: Profile, pitch: float) -> tuple[bool, bool]:
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
        seen.append(bool(np.count_nonzero(strip & out) < 0.25 * max(np.count_nonzero(strip & back), 1)))
    return seen[0], seen[1]
