"""Fits V-shaped cross-sections to slices of a groove and moves a coarse line onto their centres.

The profile is z(n) = min(face, root + slope_side |n - centre|), n to the left of the seam. The noise of a scanner that
looks down is in z, so z is regressed on n and no point is selected by its depth: on walls this steep, selecting by
depth would bias their slopes.
"""

import math
from dataclasses import dataclass

import numpy as np

from weldcal.welding.locate.groove.line import Corner, SmoothLine, smoothing_weights
from weldcal.welding.locate.groove.seam import GrooveConfig, GrooveNotFound, GrooveTooNarrow, Profile
from weldcal.welding.locate.groove.search import CoarseGroove
from weldcal.welding.locate.planes import Floats

ITERATIONS = 12
ENOUGH = 3  # fewest points on a measured wall
WIDE_M = 0.0015  # initial scale of the residuals in z, while the line is still off the groove
SHOULDER_PITCHES = 1.5  # largest distance between the end of the face and the shoulder
BAND_M = 0.006  # width of the face used beyond each shoulder
STATION_M = 0.001  # between sections: some pitches of a scanner, and short against any bend
FOLLOW = 3.0  # width relative to the last smoothing: repeated moves accumulate noise
SLOPE_SIGMA = 0.06  # relative, of a slice about the common profile: 2 deg between the walls of a 45 deg groove
DEPTH_SIGMA = 0.10  # relative, as SLOPE_SIGMA: a root face that is 10 % off its depth


@dataclass(frozen=True, eq=False, kw_only=True)
class GrooveSection:
    """A fitted cross-section; metres, slopes as rise over run, left then right where there are two.

    Attributes:
        centre, root: where the walls meet: n and z.
        covariance: (2,2) of the two.
        slopes, faces: of the walls, and the heights of the face beside them.
        on_walls: points on each wall that agree.
        agreeing: share of the points that do.
        spread: the walls' points about the profile, in z.
    """

    centre: float
    root: float
    slopes: tuple[float, float]
    faces: tuple[float, float]
    covariance: Floats
    on_walls: tuple[int, int]
    agreeing: float
    spread: float

    @property
    def shoulders(self) -> tuple[float, float]:
        """Offsets n of the left and the right edge of the opening."""
        left, right = ((face - self.root) / slope for face, slope in zip(self.faces, self.slopes, strict=True))
        return self.centre + left, self.centre - right

    @property
    def depth(self) -> float:
        """Mean depth of the root below the face on its two sides."""
        return 0.5 * (self.faces[0] + self.faces[1]) - self.root

    @property
    def width(self) -> float:
        """Width of the opening."""
        return self.shoulders[0] - self.shoulders[1]

    @property
    def angle(self) -> float:
        """Angle between the walls, rad."""
        return math.atan(1.0 / self.slopes[0]) + math.atan(1.0 / self.slopes[1])


def fit_section(
    n: Floats, z: Floats, guess: tuple[float, Profile], sigma: float, pitch: float, faces_known: bool = True
) -> GrooveSection | None:
    """Fit a V to the points of one slice at n and z, each (N,); None where they show none.

    `guess`: the centre's n and the expected profile; `sigma` the noise of the face, `pitch` the distance of points.
    Where one wall was hardly measured the edge of the face there and the expected slope replace it, and the
    covariance includes their uncertainty.
    """
    centre, profile = guess
    slopes = np.array(profile.slopes)
    half = profile.depth / float(slopes.min())
    faces = _faces(n - centre, z, half, sigma) if faces_known else (0.0, 0.0)
    near = np.abs(n - centre) < half + BAND_M
    n, z = n[near], z[near]
    if len(n) < 6:
        return None
    x = np.array([centre, 0.5 * (faces[0] + faces[1]) - profile.depth, *slopes])
    prior = x.copy()
    prior_sigma = np.array([2.0 * half, profile.depth_sigma * profile.depth, *(profile.slope_sigma * slopes)])
    edges = _edges(n - centre, z, faces, half, sigma)
    scale = max(2.5 * sigma, WIDE_M)
    floor = max(sigma, 1e-5)
    weights = np.ones(len(n))
    information = np.eye(4)
    known = np.diag(1.0 / prior_sigma**2)
    lever = float(np.mean(slopes))
    for step in range(ITERATIONS):
        left = n > x[0]
        run = np.abs(n - x[0])
        slope = np.where(left, x[2], x[3])
        wall = x[1] + slope * run
        face = np.where(left, faces[0], faces[1])
        on_wall = wall < face
        residual = z - np.where(on_wall, wall, face)
        J = np.stack([np.where(left, -slope, slope), np.ones(len(n)), run * left, run * ~left]) * on_wall
        if np.count_nonzero(on_wall) >= 6:
            spread = 1.4826 * float(np.median(np.abs(residual[on_wall])))
            # The scale shrinks slowly, because the first residuals come from a wrong centre.
            scale = max(min(scale, 3.0 * spread if step > 1 else scale), 2.5 * floor)
        sigma_point = np.where(on_wall, max(scale / 2.5, floor), floor)
        u = residual / (sigma_point * 2.5)
        weights = 1.0 / (1.0 + u * u) ** 2 / sigma_point**2
        A = (J * weights) @ J.T + known
        b = J @ (weights * residual) + (prior - x) / prior_sigma**2
        for side, edge in enumerate(edges):
            enough = np.count_nonzero(on_wall & (left == (side == 0))) >= ENOUGH
            if edge is None or enough:
                continue
            # The shoulder is where the face was seen to end.
            sign = 1.0 if side == 0 else -1.0
            rise = faces[side] - x[1]
            row = np.zeros(4)
            row[0], row[1], row[2 + side] = 1.0, -sign / x[2 + side], -sign * rise / x[2 + side] ** 2
            off = centre + edge - (x[0] + sign * rise / x[2 + side])
            # Where something hides the groove the face ends at its shadow, not at the shoulder.
            belief = 1.0 if step < 3 else 1.0 / (1.0 + (off / (SHOULDER_PITCHES * pitch)) ** 2) ** 2
            A += belief * np.outer(row, row) / (0.5 * pitch) ** 2
            b += belief * row * off / (0.5 * pitch) ** 2
        information = A
        change = np.linalg.solve(A, b)
        change[0] = np.clip(change[0], -0.5 * half, 0.5 * half)
        x = x + change
        x[2:] = np.clip(x[2:], 0.4 * slopes, 2.5 * slopes)
        if abs(change[0]) + abs(change[1]) / lever < 1e-6:
            break
    good = weights * sigma_point**2 > 0.25
    counted = max(1, int(np.count_nonzero(on_wall)))
    on_left, on_right = (int(np.count_nonzero(good & on_wall & (left == side))) for side in (True, False))
    if x[1] >= min(faces) or on_left + on_right < 5:
        return None
    spread = float(np.sqrt(np.mean(np.square(residual[good & on_wall]))))
    return GrooveSection(
        centre=float(x[0]),
        root=float(x[1]),
        slopes=(float(x[2]), float(x[3])),
        faces=faces,
        covariance=np.asarray(np.linalg.inv(information)[:2, :2], dtype=np.float64),
        on_walls=(on_left, on_right),
        agreeing=float(np.count_nonzero(good & on_wall) / counted),
        spread=spread,
    )


def _faces(n: Floats, z: Floats, half: float, sigma: float) -> tuple[float, float]:
    """Height of the face on the left and on the right, 0 where too little of it is in view."""
    heights = []
    for sign in (1.0, -1.0):
        beside = (sign * n > half + 0.5e-3) & (sign * n < half + BAND_M) & (np.abs(z) < max(5.0 * sigma, 0.002))
        heights.append(float(np.median(z[beside])) if np.count_nonzero(beside) >= 10 else 0.0)
    return heights[0], heights[1]


def _edges(n: Floats, z: Floats, faces: tuple[float, float], half: float, sigma: float) -> list[float | None]:
    """n at which the face ends on the left and on the right, where it was seen at all."""
    edges: list[float | None] = []
    for sign, face in zip((1.0, -1.0), faces, strict=True):
        level = (np.abs(z - face) < 2.5 * sigma) & (sign * n > 0.3 * half)
        edges.append(float(sign * np.min(sign * n[level])) if np.count_nonzero(level) >= 10 else None)
    return edges


@dataclass(frozen=True, eq=False)
class Slices:
    """Fitted sections along a line: where, and their sigma sideways and in height (not yet scaled)."""

    s: Floats
    sections: list[GrooveSection]
    half_slice: float

    def column(self, name: str) -> Floats:
        return np.array([getattr(section, name) for section in self.sections], dtype=np.float64)

    @property
    def sigma(self) -> Floats:
        return np.sqrt([section.covariance[0, 0] for section in self.sections])

    @property
    def sigma_height(self) -> Floats:
        return np.sqrt([section.covariance[1, 1] for section in self.sections])


def measured_profile(f: Floats, line: SmoothLine, groove: CoarseGroove, config: GrooveConfig) -> Profile:
    """Fit the groove's cross-section over its whole length, about the coarse line."""
    _, n, beside = line.coordinates(f[:, :2])
    beside &= np.abs(n) < 0.5 * groove.width_m + BAND_M + 0.003
    n, z = n[beside], f[beside, 2]
    if groove.width_m < config.least_pitches * groove.pitch_m * 0.7:
        raise _too_narrow(groove.width_m, groove.pitch_m, config)
    inner = np.abs(n) < 0.3 * groove.width_m
    if np.count_nonzero(inner) < 20:
        raise GrooveNotFound(
            f"An opening {1e3 * groove.width_m:.1f} mm wide was found, but no points inside it: scan from above."
        )
    depth = -float(np.percentile(z[inner], 10.0))
    slope = depth / (0.5 * groove.width_m)
    guess = Profile((slope, slope), depth, slope_sigma=1.0, depth_sigma=1.0)
    # The coarse line deviates by a fraction of a millimetre, which looks like noise on the walls.
    best = fit_section(n, z, (0.0, guess), max(groove.sigma_m, 2e-4), groove.pitch_m, faces_known=False)
    if (
        best is None
        or best.agreeing < 0.2
        or best.depth < 5.0 * groove.sigma_m
        or max(best.slopes) > math.tan(config.steepest_wall_rad)
    ):
        raise GrooveNotFound(
            f"An opening {1e3 * groove.width_m:.1f} mm wide and {1e3 * depth:.1f} mm deep was found, but it has no two "
            "sloping walls: it is a gap or a step, not a V-groove."
        )
    if best.width < config.least_pitches * groove.pitch_m:
        raise _too_narrow(best.width, groove.pitch_m, config)
    # About an inaccurate line one wall looks steeper than the other; their mean is more accurate.
    slope = float(np.mean(best.slopes))
    return Profile((slope, slope), best.depth)


def common_profile(
    f: Floats, line: SmoothLine, slices: Slices, profile: Profile, sigma: float, pitch: float
) -> Profile:
    """Fit one profile to all points about the slices' centres; it is accurate enough to constrain the next slices."""
    if len(slices.s) < 5:
        return profile
    s, n, beside = line.coordinates(f[:, :2])
    half_width = profile.depth / min(profile.slopes)
    beside &= (s > slices.s[0]) & (s < slices.s[-1]) & (np.abs(n) < half_width + BAND_M)
    beside &= f[:, 2] > -1.3 * profile.depth - 4.0 * sigma
    n = n - np.interp(s, slices.s, slices.column("centre"))
    # Slices constrained by the last profile would only repeat it, so the points are fitted again without it.
    slope = float(np.mean(profile.slopes))
    loose = Profile((slope, slope), profile.depth, slope_sigma=0.5, depth_sigma=0.5)
    whole = fit_section(n[beside], f[beside, 2], (0.0, loose), sigma, pitch)
    return profile if whole is None else Profile(whole.slopes, whole.depth, SLOPE_SIGMA, DEPTH_SIGMA)


def _too_narrow(width: float, pitch: float, config: GrooveConfig) -> GrooveTooNarrow:
    return GrooveTooNarrow(
        f"The groove is {1e3 * width:.1f} mm wide and the scan's points are {1e3 * pitch:.1f} mm apart:"
        f" {width / pitch:.1f} of the {config.least_pitches:.0f} point distances it takes; move the scanner nearer or"
        " use a finer one."
    )


def cut_slices(
    f: Floats, line: SmoothLine, profile: Profile, sigma: float, pitch: float, half_slice: float, corners: list[Corner]
) -> Slices:
    """Fit consecutive sections along a line, each to points of its own; none within reach of a sharp corner."""
    half_width = profile.depth / min(profile.slopes)
    s, n, beside = line.coordinates(f[:, :2])
    # Points deeper than the root belong to the table beyond the plate's edge.
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
    return Slices(np.array(keep), sections, half_slice)


def agreed(slices: Slices) -> Slices:
    """The slices without sections that have few points or disagree with their neighbours."""
    if len(slices.s) < 5:
        return slices
    points = np.array([sum(x.on_walls) for x in slices.sections])
    good = points >= max(5.0, 0.35 * float(np.median(points)))
    for name, least in (("centre", 3e-4), ("root", 6e-4)):
        value = slices.column(name)
        # Compared with a smooth curve through its neighbours, so that a bend is not an outlier.
        W = smoothing_weights(slices.s, slices.s, np.ones(len(value)), 3.0 * slices.half_slice)
        own = np.diag(W)
        off = np.abs(value - W @ value) / np.maximum(1.0 - own, 0.2)
        good &= off < max(least, 6.0 * float(np.median(off)))
    return Slices(slices.s[good], [x for x, keep in zip(slices.sections, good, strict=True) if keep], slices.half_slice)


def followed(
    f: Floats,
    line: SmoothLine,
    profile: Profile,
    sigma: float,
    pitch: float,
    half_slice: float,
    config: GrooveConfig,
    settled: bool,
) -> SmoothLine:
    """Move the line smoothly onto the centres of its sections."""
    slices = cut_slices(f, line, profile, sigma, pitch, half_slice, [])
    slices = agreed(slices) if settled else slices
    if len(slices.s) < 5:
        raise GrooveNotFound("An opening was found whose cross-sections show no V: it is not a groove to weld.")
    r, weight = slices.column("centre"), slices.sigma
    at = np.arange(0.0, line.length + STATION_M, STATION_M)
    # Wider than the last smoothing, because repeated moves accumulate noise.
    width = FOLLOW * max(config.smoothing_m, 2.0 * half_slice)
    for _ in range(2):
        smooth = smoothing_weights(slices.s, slices.s, weight, width) @ r
        off = np.abs(r - smooth)
        # A section that disagrees with its neighbours gets a small weight.
        weight = np.where(off > 4.0 * np.median(off) + 5e-5, 10.0, 1.0) * slices.sigma
    W = smoothing_weights(np.clip(at, slices.s[0], slices.s[-1]), slices.s, weight, width)
    moved = line.moved(at, W @ r)
    # Where nothing was seen the coarse line is not reliable: it is replaced by a bridge between the sides that were
    # seen.
    stretch = moved.length / line.length
    for k in np.flatnonzero(np.diff(slices.s) > 0.010)[::-1]:
        a, b = stretch * float(slices.s[k]), stretch * float(slices.s[k + 1])
        if a > 0.005 and b < moved.length - 0.005:
            moved = moved.bridged(a, b)
    return moved
