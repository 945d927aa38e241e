"""Finds the edges at which two bodies of an assembly meet: convex on their own body, with a joint's free space at the other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from weldcal.models.mesh import TriMesh
from weldcal.models.workpieces.drawing import directions
from weldcal.models.workpieces.section import cut, opening_angle, openings
from weldcal.models.workpieces.shape import PartEdge

PROBE_M = 0.001
NARROWEST_RAD, WIDEST_RAD = math.radians(10.0), math.radians(170.0)


def with_joints(mesh: TriMesh, edges: tuple[PartEdge, ...]) -> tuple[PartEdge, ...]:
    """The edges of an assembly, those that lie in the corner between two bodies as concave with the angle of the free space.

    An edge is looked at in its middle; where free spaces lie on both sides the narrower one counts.
    """
    found = []
    for edge in edges:
        if edge.kind == "convex" and len(edge.points_P) >= 2:
            edge = _seen_whole(mesh, edge)
        found.append(edge)
    return tuple(found)


def _seen_whole(mesh: TriMesh, edge: PartEdge) -> PartEdge:
    points = edge.points_P
    # Off the middle, where a neighbour's corner often lies.
    k = max(0, int(0.47 * (len(points) - 1)))
    share = 0.47 * (len(points) - 1) - k
    at = (1.0 - share) * points[k] + share * points[min(k + 1, len(points) - 1)]
    tangent = points[min(k + 1, len(points) - 1)] - points[k]
    length = float(np.linalg.norm(tangent))
    if length < 1e-9:
        return edge
    t = tangent[None] / length if len(points) < 9 else directions(points, False)[k : k + 1]
    helper = np.array([[0.0, 0.0, 1.0]]) if abs(t[0, 2]) < 0.9 else np.array([[1.0, 0.0, 0.0]])
    (section,) = cut(mesh, at[None], t, helper)
    angles = [opening_angle(o) for o in openings(section, PROBE_M)]
    concave = [a for a in angles if NARROWEST_RAD < a < WIDEST_RAD]
    if not concave:
        return edge
    return replace(edge, kind="concave", angle_rad=min(concave))
