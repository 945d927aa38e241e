"""Lines in the plane of a face.

Arc length and lateral offset of points, smoothing, and sharp corners with their radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from weldcal.welding.locate.groove.seam import Profile
from weldcal.welding.locate.planes import Floats, Mask

# About a scanner's pitch or less; the curve between two places of an R5 bend is then 6 um off its chord.
STEP_M = 0.0005
SIDE_M = 0.015  # length of a side that is extended
LEAST_RADIUS_M = 0.0005  # a seam curve needs a radius: at a right angle its apex is then 0.2 mm off
RADII_M = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 25.0]) * 1e-3
CROWD = 4.0  # number of points near a corner whose errors are correlated
# A radius is not known better than the grid shows an apex: standard deviation of a uniform pitch, 1 / sqrt(12).
LEAST_SPREAD_PITCHES = 0.3
WIDE_M = 0.010  # a bend of a larger radius is not a corner: the cross-sections follow it


@dataclass(frozen=True, eq=False)
class SmoothLine:
    """A smooth line through points (N,2) m, about evenly spaced; s = 0 at its first point."""

    points: Floats

    @cached_property
    def s(self) -> Floats:
        """Arc length (N,) m at the points."""
        steps = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length(self) -> float:
        """Length of the line, m."""
        return float(self.s[-1])

    @cached_property
    def tangents(self) -> Floats:
        """Unit tangents (N,2)."""
        t = np.gradient(self.points, self.s, axis=0)
        return np.asarray(t / np.linalg.norm(t, axis=1, keepdims=True))

    @cached_property
    def normals(self) -> Floats:
        """Unit normals (N,2), to the left."""
        return np.column_stack([-self.tangents[:, 1], self.tangents[:, 0]])

    @cached_property
    def curvatures(self) -> Floats:
        """Curvatures (N,) 1/m, positive to the left."""
        return np.asarray(np.sum(np.gradient(self.tangents, self.s, axis=0) * self.normals, axis=1))

    def tightest_bend(self, gap: tuple[float, float], over_m: float = 0.016) -> float:
        """Compute the largest curvature of the line's chords outside a gap.

        The turn from one side of the gap to the other counts too.
        """
        step = max(1, round(over_m / (self.length / (len(self.points) - 1))))
        chords = self.points[step:] - self.points[:-step]
        heading = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
        turn = np.abs(heading[step:] - heading[:-step]) / over_m
        start = self.s[: len(turn)]
        clear = (start + 2.0 * over_m < gap[0]) | (start > gap[1])
        a, b = np.searchsorted(self.s, [gap[0] - over_m, gap[1]])
        across = abs(heading[min(b, len(heading) - 1)] - heading[max(a, 0)]) / (gap[1] - gap[0] + over_m)
        return max(float(across), float(np.max(turn[clear], initial=0.0)))

    def at(self, s: Floats) -> tuple[Floats, Floats]:
        """Points (M,2) and left normals (M,2) at arc lengths (M,); straight on beyond the ends."""
        inside = np.clip(s, 0.0, self.length)
        points = np.column_stack([np.interp(inside, self.s, self.points[:, k]) for k in range(2)])
        normals = np.column_stack([np.interp(inside, self.s, self.normals[:, k]) for k in range(2)])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        along = np.column_stack([normals[:, 1], -normals[:, 0]])
        return points + (s - inside)[:, None] * along, normals

    def extended(self, before: float, after: float) -> SmoothLine:
        """The line extended straight beyond both ends, in the direction of its last 10 mm."""
        points = self.points
        for distance, end in ((before, 0), (after, -1)):
            if distance <= 0.0:
                continue
            k = max(1, min(len(points) - 1, round(0.010 / (self.length / (len(points) - 1)))))
            tip = points[end]
            heading = tip - points[k if end == 0 else -1 - k]
            heading /= np.linalg.norm(heading)
            more = tip + np.arange(STEP_M, distance + STEP_M, STEP_M)[:, None] * heading
            points = np.vstack([more[::-1], points]) if end == 0 else np.vstack([points, more])
        return SmoothLine(points).even()

    def even(self, step: float = STEP_M) -> SmoothLine:
        """The same line, sampled evenly."""
        s = np.linspace(0.0, self.length, max(4, round(self.length / step) + 1))
        return SmoothLine(np.column_stack([np.interp(s, self.s, self.points[:, k]) for k in range(2)]))

    def coordinates(self, xy: Floats) -> tuple[Floats, Floats, Mask]:
        """Compute arc length and offset (s, n) of points (M,2) by the nearest point on the line.

        With a mask of those within 30 mm.
        """
        nearest = np.asarray(cKDTree(self.points).query(xy, distance_upper_bound=0.03)[1])
        far = nearest == len(self.points)
        nearest = np.where(far, 0, nearest)
        gap = xy - self.points[nearest]
        along = np.vecdot(gap, self.tangents[nearest])
        n = np.vecdot(gap, self.normals[nearest])
        # On the inside of a bend a step along the line is longer than the step of the point.
        along = np.clip(along / np.maximum(1.0 - n * self.curvatures[nearest], 0.3), -2.0 * STEP_M, 2.0 * STEP_M)
        beside = ~far & (((nearest > 0) & (nearest < len(self.points) - 1)) | (np.abs(along) < STEP_M))
        return self.s[nearest] + along, n, beside

    def rolled(self) -> SmoothLine:
        """The closed line with its start moved half-way round; its former joint is closed to the mean of both ends."""
        points = self.points.copy()
        gap, over = points[0] - points[-1], min(20, len(points) // 4)
        share = np.linspace(0.5, 0.0, over)[:, None]
        points[:over] -= share * gap
        points[-over:] += share[::-1] * gap
        half = len(points) // 2
        return SmoothLine(np.vstack([points[half:-1], points[: half + 1]])).even()

    def bridged(self, a: float, b: float, side: float = 0.015) -> SmoothLine:
        """The line with its stretch from a to b replaced by a smooth curve that continues both sides, m."""
        (p, before, q, after), _ = self.at(np.array([a, max(a - side, 0.0), b, min(b + side, self.length)]))
        reach = float(np.linalg.norm(q - p))
        u, v = p - before, after - q
        u, v = reach * u / np.linalg.norm(u), reach * v / np.linalg.norm(v)
        t = np.linspace(0.0, 1.0, max(4, round(reach / STEP_M)))[1:-1, None]
        curve = (
            (2 * t**3 - 3 * t**2 + 1) * p + (t**3 - 2 * t**2 + t) * u + (3 * t**2 - 2 * t**3) * q + (t**3 - t**2) * v
        )
        return SmoothLine(np.vstack([self.points[self.s <= a], curve, self.points[self.s >= b]])).even()

    def moved(self, s: Floats, left: Floats) -> SmoothLine:
        """The line moved to its left by amounts (M,) at arc lengths (M,), in between linearly."""
        amount = np.interp(self.s, s, left)
        return SmoothLine(self.points + amount[:, None] * self.normals).even()


def smoothing_weights(at: Floats, s: Floats, sigma: Floats, width: float) -> Floats:
    """(M,N) weights that turn values at s (N,) into smoothed values at `at` (M,): local parabolas under a Gaussian.

    The Gaussian is `width` m wide, wider where fewer than four values are near; a straight line where they are all on
    one side (an end), so that nothing is extrapolated by its curvature.
    """
    distance = s - at[:, None]
    near = min(4, len(s) - 1)
    h = np.maximum(width, np.partition(np.abs(distance), near, axis=1)[:, near] / 1.5)[:, None]
    x = distance / h
    weight = np.exp(-0.5 * np.square(x)) / np.square(sigma)
    curved = (np.sum(x < -0.3, axis=1) >= 2) & (np.sum(x > 0.3, axis=1) >= 2) & (len(s) >= 5)
    rows = np.zeros(x.shape)
    for some, degree in ((~curved, 1), (curved, 2)):
        D = x[some][:, None] ** np.arange(degree + 1)[:, None]
        DW = D * weight[some][:, None]
        A = DW @ np.swapaxes(D, 1, 2)
        A += 1e-9 * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(degree + 1)
        rows[some] = np.linalg.solve(A, DW)[:, 0]
    return rows


def tight_turns(line: SmoothLine, turn_rad: float = math.radians(40.0), within_m: float = 0.010) -> list[float]:
    """Arc lengths m where a line turns by more than an angle within a short length."""
    heading = np.unwrap(np.arctan2(line.tangents[:, 1], line.tangents[:, 0]))
    step = max(1, round(within_m / (line.length / (len(line.points) - 1))))
    if len(heading) <= step:
        return []
    turn = np.abs(heading[step:] - heading[:-step])
    corners = []
    while len(turn) and turn.max() > turn_rad:
        k = int(np.argmax(turn))
        corners.append(float(line.s[k + step // 2]))
        turn[max(0, k - 2 * step) : k + 2 * step] = 0.0
    return sorted(corners)


def filleted(a: Floats, apex: Floats, b: Floats, radius: float) -> Floats:
    """Points (N,2) from a to b over a corner rounded with a radius (0: sharp), spaced 0.25 mm round it, m."""
    u, v = (a - apex) / np.linalg.norm(a - apex), (b - apex) / np.linalg.norm(b - apex)
    half = 0.5 * math.acos(float(np.clip(u @ v, -1.0, 1.0)))
    tangent = min(radius / math.tan(half), 0.9 * float(np.linalg.norm(a - apex)), 0.9 * float(np.linalg.norm(b - apex)))
    radius = tangent * math.tan(half)
    if radius < 1e-5:
        return np.vstack([a, apex, b])
    middle = u + v
    centre = apex + middle / np.linalg.norm(middle) * radius / math.sin(half)
    start, stop = apex + tangent * u - centre, apex + tangent * v - centre
    turn = math.pi - 2.0 * half
    share = np.linspace(0.0, 1.0, max(3, math.ceil(radius * turn / 0.00025)))[:, None]
    arc = (np.sin((1.0 - share) * turn) * start + np.sin(share * turn) * stop) / math.sin(turn)
    return np.vstack([a, centre + arc, b])


def meeting_point(p: Floats, t: Floats, q: Floats, w: Floats) -> Floats:
    """Intersection of the lines p + a t and q + b w in the plane."""
    a, _ = np.linalg.solve(np.column_stack([t, -w]), q - p)
    return np.asarray(p + a * t)


@dataclass(frozen=True, eq=False)
class Corner:
    """Describe a corner of the whole line.

    Its arc length s m, its apex (2,) m, its radius m, and how far to each side of s no cross-section has points of its
    own, m; sigma: of the line sideways at s, m, as far as the radius is not known; wide: it is certainly a bend.
    """

    s: float
    apex: Floats
    radius: float
    blind: float
    sigma: float = 0.0
    wide: bool = False


def split_legs(line: SmoothLine, profile: Profile, wide: list[Floats]) -> tuple[list[SmoothLine], list[Corner]]:
    """Split the line at its tight turns into straight legs, and return the corners between them.

    Turns near the places (2,) in `wide` are not corners.
    """
    turns = [
        s for s in tight_turns(line) if all(np.linalg.norm(line.at(np.array([s]))[0][0] - p) > SIDE_M for p in wide)
    ]
    if not turns:
        return [line], []
    half_width = profile.depth / min(profile.slopes)
    blind = 2.0 * half_width + 0.002
    bounds = [0.0, *turns, line.length]
    legs, corners = [], []
    for k, (a, b) in enumerate(pairwise(bounds)):
        low = a + blind if k > 0 else a
        high = b - blind if k < len(turns) else b
        inside = (line.s >= low) & (line.s <= high)
        if np.count_nonzero(inside) * line.length / len(line.s) < SIDE_M:
            return [line], []
        legs.append(SmoothLine(line.points[inside]).even())
    for turn in turns:
        corners.append(Corner(turn, line.at(np.array([turn]))[0][0], 0.0, blind))
    return legs, corners


def round_corners(
    f: Floats, legs: list[SmoothLine], corners: list[Corner], profile: Profile, sigma: float, pitch: float
) -> tuple[SmoothLine, list[Corner]]:
    """Join the legs over their corners, each with the radius that fits the points (N,3) m near it best."""
    half_width = profile.depth / min(profile.slopes)
    whole = legs[0].points
    met: list[tuple[Floats, Floats, float, float, bool]] = []
    for leg in legs[1:]:
        apex = meeting_point(*_side(whole[::-1]), *_side(leg.points))
        radius, spread = _radius(f, whole, apex, leg.points, profile, sigma, pitch)
        u, v = (p - apex for p in (whole[-1], leg.points[0]))
        half = 0.5 * np.arccos(np.clip(u @ v / np.linalg.norm(u) / np.linalg.norm(v), -1.0, 1.0))
        bend = filleted(whole[-1], apex, leg.points[0], max(radius, LEAST_RADIUS_M))
        # How far the bend's middle moves with the radius.
        met.append(
            (apex, bend[len(bend) // 2], radius, spread * (1.0 / np.sin(half) - 1.0), radius - 2.0 * spread > WIDE_M)
        )
        whole = np.vstack([whole[:-1], bend, leg.points[1:]])
    line = SmoothLine(whole).even(0.00025)
    out = []
    for (apex, place, radius, aside, wide), corner in zip(met, corners, strict=True):
        s = float(line.s[int(np.argmin(np.linalg.norm(line.points - place, axis=1)))])
        # Coordinates along and across the line are valid round a bend this wide, so sections may be cut there.
        blind = 0.0 if radius > 1.3 * half_width else min(corner.blind, 1.5 * half_width + radius)
        out.append(Corner(s, apex, radius, blind, float(aside), bool(wide)))
    return line, out


def _side(points: Floats) -> tuple[Floats, Floats]:
    """A point and the direction of the straight line through the first part of points (N,2)."""
    reach = np.cumsum(np.append(0.0, np.linalg.norm(np.diff(points, axis=0), axis=1)))
    some = points[reach <= SIDE_M]
    middle = some.mean(axis=0)
    return middle, np.linalg.svd(some - middle, full_matrices=False)[2][0]


def _radius(
    f: Floats, before: Floats, apex: Floats, after: Floats, profile: Profile, sigma: float, pitch: float
) -> tuple[float, float]:
    """Estimate the corner radius from the points near it, and its sigma, m.

    Both are the mean and the spread of the candidates by their likelihood: few or noisy points fit many radii
    equally well.
    """
    near = f[np.linalg.norm(f[:, :2] - apex, axis=1) < SIDE_M]
    if len(near) < 40:
        return 0.0, float(RADII_M[-1]) / 4.0
    slope = float(np.mean(profile.slopes))
    scale = 2.5 * max(2.0 * sigma, 5e-5)
    costs = []
    for radius in RADII_M:
        bend = filleted(before[-1], apex, after[0], float(radius))
        path = SmoothLine(np.vstack([before[:-1], bend, after[1:]])).even(0.0001)
        away = np.asarray(cKDTree(path.points).query(near[:, :2])[0])
        off = near[:, 2] - np.minimum(0.0, slope * away - profile.depth)
        costs.append(float(np.mean(np.square(off) / (np.square(off) + scale**2))))
    # The cost is a share of c^2 = 2.5^2 sigma^2: where it is small, half the sum of squares over sigma^2 is 3.125 n of
    # it.
    fine = np.arange(0.0, RADII_M[-1] + 1e-9, 0.00025)
    log_likelihood = -0.5 * 2.5**2 * len(near) / CROWD * np.interp(fine, RADII_M, costs)
    weight = np.exp(log_likelihood - log_likelihood.max())
    weight /= weight.sum()
    mean = float(weight @ fine)
    return mean, float(np.hypot(np.sqrt(weight @ np.square(fine - mean)), LEAST_SPREAD_PITCHES * pitch))
