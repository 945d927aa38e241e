"""Sharp corners of a groove: the sides fitted apart from the corner, met, and rounded as far as the points say so."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from weldcal.welding.groove_line import Line, filleted, meeting_point, tight_turns
from weldcal.welding.groove_section import Profile
from weldcal.welding.planes import Floats

SIDE_M = 0.015  # length of a side that is prolonged
LEAST_RADIUS_M = 0.0005  # a seam curve cannot turn on the spot: its apex is then 0.2 mm off at a right angle
RADII_M = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0]) * 1e-3


@dataclass(frozen=True, eq=False)
class Corner:
    """A corner at arc length s m of the whole line, its apex (2,) m, its radius m, and how far to each side of s no
    cross-section has points of its own, m."""

    s: float
    apex: Floats
    radius: float
    blind: float


def split_legs(line: Line, profile: Profile) -> tuple[list[Line], list[Corner]]:
    """The line cut at its tight turns into legs that run straight on to where the corner is, and the corners."""
    turns = tight_turns(line)
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
    f: Floats, legs: list[Line], corners: list[Corner], profile: Profile, sigma: float
) -> tuple[Line, list[Corner]]:
    """The legs joined over their corners, each with the radius that agrees best with the points near it (N,3) m."""
    half_width = profile.depth / min(profile.slopes)
    whole = legs[0].points
    met: list[tuple[Floats, Floats, float]] = []
    for leg in legs[1:]:
        apex = meeting_point(*_side(whole[::-1]), *_side(leg.points))
        radius = _radius(f, whole, apex, leg.points, profile, sigma)
        bend = filleted(whole[-1], apex, leg.points[0], max(radius, LEAST_RADIUS_M))
        met.append((apex, bend[len(bend) // 2], radius))
        whole = np.vstack([whole[:-1], bend, leg.points[1:]])
    line = Line(whole).even(0.00025)
    out = []
    for (apex, place, radius), corner in zip(met, corners, strict=True):
        s = float(line.s[int(np.argmin(np.linalg.norm(line.points - place, axis=1)))])
        # Round a wide enough bend the coordinates along and across the line are sound, and sections may be cut.
        blind = 0.0 if radius > 1.3 * half_width else min(corner.blind, 1.5 * half_width + radius)
        out.append(Corner(s, apex, radius, blind))
    return line, out


def _side(points: Floats) -> tuple[Floats, Floats]:
    """A point and the direction of the straight line through the first part of points (N,2)."""
    reach = np.cumsum(np.append(0.0, np.linalg.norm(np.diff(points, axis=0), axis=1)))
    some = points[reach <= SIDE_M]
    middle = some.mean(axis=0)
    return middle, np.linalg.svd(some - middle, full_matrices=False)[2][0]


def _radius(f: Floats, before: Floats, apex: Floats, after: Floats, profile: Profile, sigma: float) -> float:
    """Of the candidates and what lies between them, the radius with which the points near the corner make a groove."""
    near = f[np.linalg.norm(f[:, :2] - apex, axis=1) < SIDE_M]
    if len(near) < 40:
        return 0.0
    slope = float(np.mean(profile.slopes))
    scale = 2.5 * max(2.0 * sigma, 5e-5)
    costs = []
    for radius in RADII_M:
        bend = filleted(before[-1], apex, after[0], float(radius))
        path = Line(np.vstack([before[:-1], bend, after[1:]])).even(0.0001)
        away = np.asarray(cKDTree(path.points).query(near[:, :2])[0])
        off = near[:, 2] - np.minimum(0.0, slope * away - profile.depth)
        costs.append(float(np.mean(np.square(off) / (np.square(off) + scale**2))))
    k = int(np.argmin(costs))
    if k in (0, len(RADII_M) - 1):
        return float(RADII_M[k])
    # The lowest point of the parabola through the best candidate and its neighbours.
    a, b, _ = np.polyfit(RADII_M[k - 1 : k + 2], costs[k - 1 : k + 2], 2)
    return float(np.clip(-b / (2.0 * a), RADII_M[k - 1], RADII_M[k + 1]))
