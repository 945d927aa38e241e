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
        """A vector (2,) of the cut as a vector (3,) of the part's frame."""
        return np.asarray(v[0] * self.right + v[1] * self.up)


@dataclass(frozen=True, eq=False)
class Opening:
    """The free space between two walls, seen from one point of a cut: angles from x towards y, rad, and the walls' normals."""

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
    sections: list[Section] = []
    for begin in range(0, len(points), _CHUNK):
        some = slice(begin, begin + _CHUNK)
        box_low, box_high = points[some].min(axis=0) - reach_m, points[some].max(axis=0) + reach_m
        near = np.flatnonzero(((low <= box_high) & (high >= box_low)).all(axis=1))
        for p, t, u in zip(points[some], tangents[some], ups[some], strict=True):
            sections.append(_cut_one(corners[near], normals[near], p, t, u, reach_m))
    return sections


def _cut_one(corners: Floats, normals: Floats, p: Floats, t: Floats, u: Floats, reach: float) -> Section:
    up = u - (u @ t) * t
    up = up / np.linalg.norm(up)
    right = np.cross(t, up)
    height = (corners - p) @ t
    # A corner exactly in the plane counts as before it, so that every crossing is found once.
    side = height > 0.0
    crossed = np.flatnonzero(side.any(axis=1) & ~side.all(axis=1))
    height, side, corners, normals = height[crossed], side[crossed], corners[crossed], normals[crossed]
    ends = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        share = height[:, a] / np.where(side[:, a] != side[:, b], height[:, a] - height[:, b], 1.0)
        ends.append(corners[:, a] + share[:, None] * (corners[:, b] - corners[:, a]))
    split = np.stack([side[:, 0] != side[:, 1], side[:, 1] != side[:, 2], side[:, 2] != side[:, 0]], axis=1)
    order = np.argsort(~split, axis=1, kind="stable")[:, :2]
    found = np.stack(ends, axis=1)[np.arange(len(crossed))[:, None], order] - p if len(crossed) else np.zeros((0, 2, 3))
    segments = np.stack([found @ right, found @ up], axis=2)
    flat = np.column_stack([normals @ right, normals @ up])
    size = np.linalg.norm(flat, axis=1)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    keep = (size > 1e-9) & (length > 1e-9)
    keep &= _distance(segments) <= reach
    return Section(segments[keep], flat[keep] / size[keep, None], right, up)


def _distance(segments: Floats) -> Floats:
    """(M,) distance of each segment from the origin."""
    a, d = segments[:, 0], segments[:, 1] - segments[:, 0]
    share = np.clip(-np.sum(a * d, axis=1) / np.maximum(np.sum(d * d, axis=1), 1e-300), 0.0, 1.0)
    return np.asarray(np.linalg.norm(a + share[:, None] * d, axis=1))


def crossings(section: Section, centre: Floats, radius: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Where a circle meets the outline: angles (K,) ascending, points (K,2), normals (K,2), and -1 or 1 (K,).

    The last is 1 where a turn from x towards y enters the material.
    """
    a, d = section.segments[:, 0] - centre, section.segments[:, 1] - section.segments[:, 0]
    qa, qb, qc = np.sum(d * d, axis=1), np.sum(a * d, axis=1), np.sum(a * a, axis=1) - radius**2
    root = qb * qb - qa * qc
    hit = root > 0.0
    at, which = [], []
    for sign in (-1.0, 1.0):
        share = (-qb + sign * np.sqrt(np.maximum(root, 0.0))) / qa
        inside = hit & (share >= 0.0) & (share < 1.0)
        at.append((a + share[:, None] * d)[inside])
        which.append(np.flatnonzero(inside))
    points, index = np.concatenate(at), np.concatenate(which)
    angle = np.mod(np.arctan2(points[:, 1], points[:, 0]), 2.0 * math.pi)
    order = np.argsort(angle, kind="stable")
    points, index, angle = points[order], index[order], angle[order]
    normals = section.normals[index]
    turning = np.column_stack([-points[:, 1], points[:, 0]]) / radius
    enters = np.where(np.sum(normals * turning, axis=1) < 0.0, 1.0, -1.0)
    return angle, points + centre, normals, enters


def openings(section: Section, radius: float, centre: Floats | None = None) -> list[Opening]:
    """Every free space about a point of the cut (the seam's own where None), between walls met at this distance.

    Material is counted by its surfaces, so bodies may touch or overlap: between two bodies' common faces nothing is free.
    """
    middle = np.zeros(2) if centre is None else centre
    angle, points, normals, enters = crossings(section, middle, radius)
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
            Opening(
                float(angle[k]),
                float(angle[k] + width[k]),
                normals[k],
                normals[after],
                points[k],
                points[after],
            )
        )
    return found


def opening_angle(opening: Opening) -> float:
    """Angle between the walls through the free space by their normals, rad; more than pi of a convex edge."""
    right, left = opening.normal_right, opening.normal_left
    turn = math.atan2(right[0] * left[1] - right[1] * left[0], float(right @ left))
    return math.pi + turn


def wall_extent(section: Section, root: Floats, direction: Floats, normal: Floats, tolerance_m: float = 4e-4) -> float:
    """How far a wall continues from a point of the cut along its direction, m, at most the cut's reach.

    Segments belong to it that face the same way (15 deg) and lie within a tolerance that grows by a tenth of the distance.
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
