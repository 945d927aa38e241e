"""Reads a part's file of any kind, and checks its unit and its size."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.models.workpieces.drawing import directions
from weldcal.models.workpieces.section import cut, opening_angle, openings
from weldcal.models.workpieces.shape import UNITS_M, PartEdge, PartShape

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


LEAST_SIZE_M, LARGEST_SIZE_M = 0.005, 10.0
STEP_SUFFIXES = (".step", ".stp")
MESH_SUFFIXES = (".stl", ".obj", ".ply")


def read_shape(path: Path, units: str | None = None) -> PartShape:
    """Read a part from STEP (OpenCascade), STL, OBJ or PLY.

    Args:
        units: mm, m or inch. A STEP file states its own, which must agree; a mesh has none, and without this it is mm.

    Raises:
        InputError: a file that is missing, empty, malformed or no solid; an unknown unit; a size that no weld cell holds.
    """
    if units is not None and units not in UNITS_M:
        raise InputError(f"units must be {', '.join(UNITS_M)}, not '{units}'.")
    suffix = path.suffix.lower()
    if suffix in STEP_SUFFIXES:
        from weldcal.models.workpieces.step import read_step

        shape = read_step(path, units)
    elif suffix in MESH_SUFFIXES:
        from weldcal.models.workpieces.mesh_files import read_mesh_shape

        shape = read_mesh_shape(path, UNITS_M[units or "mm"])
    else:
        kinds = ", ".join((*STEP_SUFFIXES, *MESH_SUFFIXES))
        raise InputError(f"'{path.name}' is no part that can be read: give a file that ends in {kinds}.")
    _check_size(path, shape)
    if shape.bodies > 1:
        shape = replace(shape, edges=with_joints(shape.mesh, shape.edges))
    return shape


def _check_size(path: Path, shape: PartShape) -> None:
    """Raise InputError for a part that no weld cell holds, with the unit that would make it fit."""
    size = float(np.ptp(shape.mesh.vertices, axis=0).max())
    if LEAST_SIZE_M <= size <= LARGEST_SIZE_M:
        return
    in_file = size / shape.unit_m
    likely = [unit for unit, scale in UNITS_M.items() if 0.02 <= in_file * scale <= 3.0]
    hint = f" Its unit may be {' or '.join(likely)}." if likely else ""
    large = f"{size:.3g} m" if size >= 1.0 else f"{1e3 * size:.3g} mm"
    raise InputError(f"'{path.name}' is {large} long, which is no part of a weld cell (5 mm to 10 m).{hint}")
