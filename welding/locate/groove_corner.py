"""Sharp corners of a groove: the sides fitted apart from the corner, met, and rounded as far as the points say so."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from weldcal.welding.locate.groove_line import Line, filleted, meeting_point, tight_turns
from weldcal.welding.locate.groove_section import Profile
from weldcal.welding.locate.planes import Floats

SIDE_M = 0.015  # length of a side that is prolonged
LEAST_RADIUS_M = 0.0005  # a seam curve cannot turn on the spot: its apex is then 0.2 mm off at a right angle
RADII_M = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 25.0]) * 1e-3
CROWD = 4.0  # points near a corner that err together
LEAST_SPREAD_PITCHES = 0.3
WIDE_M = 0.010  # a bend of a larger radius is no corner: the cross-sections follow it


@dataclass(frozen=True, eq=False)
class Corner:
    """A corner at arc length s m of the whole line, its apex (2,) m, its radius m, and how far to each side of s no
    cross-section has points of its own, m; sigma: of the line sideways at s, m, as far as the radius is not known; wide: it is a
    bend for sure."""

    s: float
    apex: Floats
    radius: float
    blind: float
    sigma: float = 0.0
    wide: bool = False


def split_legs(line: Line, profile: Profile, wide: list[Floats]) -> tuple[list[Line], list[Corner]]:
    """The line cut at its tight turns into legs that run straight on to where the corner is, and the corners; turns near
    the places (2,) in `wide` are known to be none."""
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
        legs.append(Line(line.points[inside]).even())
    for turn in turns:
        corners.append(Corner(turn, line.at(np.array([turn]))[0][0], 0.0, blind))
    return legs, corners


def round_corners(
    f: Floats, legs: list[Line], corners: list[Corner], profile: Profile, sigma: float, pitch: float
) -> tuple[Line, list[Corner]]:
    """The legs joined over their corners, each with the radius that agrees best with the points near it (N,3) m."""
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
    line = Line(whole).even(0.00025)
    out = []
    for (apex, place, radius, aside, wide), corner in zip(met, corners, strict=True):
        s = float(line.s[int(np.argmin(np.linalg.norm(line.points - place, axis=1)))])
        # Round a wide enough bend the coordinates along and across the line are sound, and sections may be cut.
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
    """The radius with which the points near the corner make a groove, and its sigma, m.

    Both are the mean and the spread of the candidates by their likelihood: of points that are few or noisy many radii
    are as good.
    """
    near = f[np.linalg.norm(f[:, :2] - apex, axis=1) < SIDE_M]
    if len(near) < 40:
        return 0.0, float(RADII_M[-1]) / 4.0
    slope = float(np.mean(profile.slopes))
    scale = 2.5 * max(2.0 * sigma, 5e-5)
    costs = []
    for radius in RADII_M:
        bend = filleted(before[-1], apex, after[0], float(radius))
        path = Line(np.vstack([before[:-1], bend, after[1:]])).even(0.0001)
        away = np.asarray(cKDTree(path.points).query(near[:, :2])[0])
        off = near[:, 2] - np.minimum(0.0, slope * away - profile.depth)
        costs.append(float(np.mean(np.square(off) / (np.square(off) + scale**2))))
    # The cost is a share of c^2 = 2.5^2 sigma^2: where it is small, half the sum of squares over sigma^2 is 3.125 n of it.
    fine = np.arange(0.0, RADII_M[-1] + 1e-9, 0.00025)
    log_likelihood = -0.5 * 2.5**2 * len(near) / CROWD * np.interp(fine, RADII_M, costs)
    weight = np.exp(log_likelihood - log_likelihood.max())
    weight /= weight.sum()
    mean = float(weight @ fine)
    return mean, float(np.hypot(np.sqrt(weight @ np.square(fine - mean)), LEAST_SPREAD_PITCHES * pitch))
