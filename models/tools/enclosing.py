"""Capsules that enclose a tool's shapes, and the vertices of its meshes."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.models.tool import LAST_LINK, ToolShape

MOST_TRIANGLES = 200_000


def enclosing_capsule(shape: ToolShape) -> Capsule:
    """Return a capsule in F that holds the whole shape: about its longest direction."""
    X = shape.place.pose
    size = shape.size
    if shape.kind == "sphere":
        p = np.array(X.translation())
        return Capsule(LAST_LINK, p, p, size[0])
    if shape.kind == "capsule":
        half = np.array([0.0, 0.0, 0.5 * size[1]])
        return Capsule(LAST_LINK, np.array(X @ -half), np.array(X @ half), size[0])
    if shape.kind == "mesh":
        points = shape_mesh(shape).vertices
    elif shape.kind == "cylinder":
        r, h = size[0], 0.5 * size[1]
        angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
        rim = np.column_stack([r * np.cos(angle), r * np.sin(angle)]) / np.cos(np.pi / 24)
        points = np.vstack([np.column_stack([rim, np.full(24, z)]) for z in (-h, h)])
    else:
        signs = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, 8).T
        points = signs * np.array(size)
    start, end, radius = _capsule_about(np.asarray(points, dtype=np.float64))
    return Capsule(LAST_LINK, np.array(X @ start), np.array(X @ end), radius)


def _capsule_about(points: Array) -> tuple[Array, Array, float]:
    """Ends (3,) and radius of a capsule about points (N, 3): its axis along their longest direction."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, extent = 0.5 * (low + high), high - low
    k = int(np.argmax(extent))
    axis = np.eye(3)[k]
    off = points - middle
    radius = float(np.linalg.norm(off - np.outer(off @ axis, axis), axis=1).max())
    # the ends may stand back from the outermost points by as much as these lie within the radius
    across = np.linalg.norm(off - np.outer(off @ axis, axis), axis=1)
    need = np.abs(off @ axis) - np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    half = max(float(need.max()), 0.0)
    return middle - half * axis, middle + half * axis, radius


@lru_cache(maxsize=8)
def _read(path: str, unit_m: float, changed: int) -> TriMesh:
    from weldcal.models.mesh import o3d

    found = o3d.io.read_triangle_mesh(Path(path))
    vertices, triangles = np.asarray(found.vertices), np.asarray(found.triangles)
    if not len(triangles) or not np.isfinite(vertices).all():
        raise InputError(f"'{path}' holds no triangles: give an STL, OBJ or PLY mesh.")
    if len(triangles) > MOST_TRIANGLES:
        raise InputError(f"'{path}' has {len(triangles)} triangles, more than {MOST_TRIANGLES}: simplify the mesh.")
    scaled = vertices * unit_m
    if (reach := float(np.abs(scaled).max())) > 2.0:
        raise InputError(f"'{path}' reaches {reach:.3g} m: check units of the shape (mm, cm, m or inch).")
    return TriMesh(scaled, triangles.astype(np.int64))


def shape_mesh(shape: ToolShape) -> TriMesh:
    """Return the mesh of a shape's file, in its own frame, m. Raises InputError where the file holds none."""
    return _read(shape.mesh, shape.unit_m, Path(shape.mesh).stat().st_mtime_ns)
