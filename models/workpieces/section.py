"""Cuts a part square to a seam and finds, in each cut, the two walls of the joint and the free space between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from weldcal.models.mesh import TriMesh

Floats = npt.NDArray[np.float64]

REACH_M = 0.025  # of a cut, about the seam
PROBES_M = (0.001, 0.002, 0.0032, 0.0045)  # radii at which the free space is looked for
LEAST_FREE_RAD = math.radians(6.0)
_CHUNK = 40  # seam points whose nearby triangles are found together
_NEXT = [1, 2, 0]  # corner after each of a triangle's
_BOTH = np.array([[-1.0], [1.0]])  # signs of a quadratic equation's roots


@dataclass(frozen=True, eq=False)
class Section:
    """The cut of a part by the plane square to a seam at one point, in two dimensions, m.

    The origin is the seam's point; x lies to the right of the travel, y along `up`.

    segments (M,2,2): the part's outline, each segment with its two ends; normals (M,2): unit, out of the material
    """

    segments: Floats
    normals: Floats
    right: Floats
    up: Floats

    def space(self, v: Floats) -> Floats:
        """Return a vector (2,) of the cut as a vector (3,) of the part's frame."""
        return np.asarray(v[0] * self.right + v[1] * self.up)


@dataclass(frozen=True, eq=False)
class Opening:
    """Describe the free space between two walls, from one point of a cut.

    Angles from x towards y, rad, and the walls' normals.
    """

    low_rad: float
    high_rad: float
    normal_right: Floats  # of the wall at `low_rad`
    normal_left: Floats
    point_right: Floats  # where the walls were met
    point_left: Floats

    @property
    def width_rad(self) -> float:
        """Angle of the free space."""
        return self.high_rad - self.low_rad

    @property
    def middle(self) -> Floats:
        """Unit vector (2,) along the bisector."""
        a = 0.5 * (self.low_rad + self.high_rad)
        return np.array([math.cos(a), math.sin(a)])


def cut(mesh: TriMesh, points: Floats, tangents: Floats, ups: Floats, reach_m: float = REACH_M) -> list[Section]:
    """The sections of a mesh at points (N,3), square to unit tangents (N,3); `ups` (N,3) orient them (see Section)."""
    corners = mesh.vertices[mesh.triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    normals = mesh.normals
    up = ups - np.vecdot(ups, tangents)[:, None] * tangents
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    right = np.cross(tangents, up)
    sections: list[Section] = []
    for begin in range(0, len(points), _CHUNK):
        some = slice(begin, begin + _CHUNK)
        box_low, box_high = points[some].min(axis=0) - reach_m, points[some].max(axis=0) + reach_m
        near = np.flatnonzero(((low <= box_high) & (high >= box_low)).all(axis=1))
        near_corners, near_normals = corners[near], normals[near]
        for p, t, x, y in zip(points[some], tangents[some], right[some], up[some], strict=True):
            sections.append(_cut_one(near_corners, near_normals, p, t, x, y, reach_m))
    return sections


def _cut_one(
    corners: Floats, normals: Floats, p: Floats, t: Floats, right: Floats, up: Floats, reach: float
) -> Section:
    height = (corners - p) @ t
    # A corner exactly in the plane counts as before it, so that every crossing is found once.
    side = height > 0.0
    split = side != side[:, _NEXT]
    crossed = np.flatnonzero(split.any(axis=1))
    height, split, corners, normals = height[crossed], split[crossed], corners[crossed], normals[crossed]
    # Two of the three sides of each triangle that is crossed.
    before, after = height[split], height[:, _NEXT][split]
    a, b = corners[split], corners[:, _NEXT][split]
    found = (a + (before / (before - after))[:, None] * (b - a) - p).reshape(-1, 2, 3)
    axes = np.column_stack([right, up])
    segments, flat = found @ axes, normals @ axes
    size = np.hypot(flat[:, 0], flat[:, 1])
    d = segments[:, 1] - segments[:, 0]
    keep = (size > 1e-9) & (np.hypot(d[:, 0], d[:, 1]) > 1e-9)
    keep &= _distance(segments[:, 0], d) <= reach
    return Section(segments[keep], flat[keep] / size[keep, None], right, up)


def _distance(a: Floats, d: Floats) -> Floats:
    """(M,) distance from the origin of each segment from a (M,2) to a + d."""
    share = np.clip(-np.vecdot(a, d) / np.maximum(np.vecdot(d, d), 1e-300), 0.0, 1.0)
    nearest = a + share[:, None] * d
    return np.asarray(np.hypot(nearest[:, 0], nearest[:, 1]))


def crossings(section: Section, radius: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Find where a circle about the origin meets the outline: angles (K,), points (K,2), normals (K,2), signs (K,).

    The angles ascend. A sign is 1 where a turn from x towards y enters the material, else -1.
    """
    a, d = section.segments[:, 0], section.segments[:, 1] - section.segments[:, 0]
    qa, qb, qc = np.vecdot(d, d), np.vecdot(a, d), np.vecdot(a, a) - radius**2
    root = qb * qb - qa * qc
    share = (_BOTH * np.sqrt(np.maximum(root, 0.0)) - qb) / qa
    inside = (root > 0.0) & (share >= 0.0) & (share < 1.0)
    index = np.nonzero(inside)[1]
    points = a[index] + share[inside][:, None] * d[index]
    angle = np.mod(np.arctan2(points[:, 1], points[:, 0]), 2.0 * math.pi)
    order = np.argsort(angle, kind="stable")
    points, index, angle = points[order], index[order], angle[order]
    normals = section.normals[index]
    enters = np.where(normals[:, 1] * points[:, 0] < normals[:, 0] * points[:, 1], 1.0, -1.0)
    return angle, points, normals, enters


def openings(section: Section, radius: float) -> list[Opening]:
    """Return every free space about the seam's point of the cut, between walls met at this distance.

    Material is counted by its surfaces, so bodies may touch or overlap: between two bodies' common faces nothing is
    free.
    """
    angle, points, normals, enters = crossings(section, radius)
    if len(angle) < 2:
        return []
    depth = np.cumsum(enters)
    width = np.mod(np.diff(np.append(angle, angle[0] + 2.0 * math.pi)), 2.0 * math.pi + 1e-12)
    wide = width > LEAST_FREE_RAD
    if not wide.any():
        return []
    free = wide & (depth == depth[wide].min())
    found = []
    for k in np.flatnonzero(free):
        after = (k + 1) % len(angle)
        found.append(
            Opening(float(angle[k]), float(angle[k] + width[k]), normals[k], normals[after], points[k], points[after])
        )
    return found


def opening_angle(opening: Opening) -> float:
    """Angle between the walls through the free space by their normals, rad; more than pi of a convex edge."""
    right, left = opening.normal_right, opening.normal_left
    turn = math.atan2(right[0] * left[1] - right[1] * left[0], float(right @ left))
    return math.pi + turn


def wall_extent(section: Section, root: Floats, direction: Floats, normal: Floats, tolerance_m: float = 4e-4) -> float:
    """How far a wall continues from a point of the cut along its direction, m, at most the cut's reach.

    Segments belong to it that face the same way (15 deg) and lie within a tolerance that grows by a tenth of the
    distance.
    """
    same = section.normals @ normal > math.cos(math.radians(15.0))
    along = (section.segments - root) @ direction
    off = np.abs((section.segments - root) @ normal)
    same &= (off < tolerance_m + 0.1 * np.abs(along)).all(axis=1) & (along.max(axis=1) > 0.0)
    if not same.any():
        return 0.0
    spans = np.sort(along[same], axis=1)
    spans = spans[np.argsort(spans[:, 0])]
    # The wall may begin a little away from the root (a root gap, a small radius), not more.
    reached = max(0.0, float(spans[0, 0])) if spans[0, 0] < 0.003 else -1.0
    for low, high in spans:
        if low > reached + 5e-4:
            break
        reached = max(reached, float(high))
    return max(0.0, reached)
