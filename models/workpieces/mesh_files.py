"""Reads a part from an STL, OBJ or PLY file as a closed mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from weldcal.models.errors import InputError
from weldcal.models.files import file_size
from weldcal.models.limits import LARGEST_NUMBER
from weldcal.models.mesh import TriMesh, merge
from weldcal.models.workpieces.mesh_edges import mesh_edges
from weldcal.models.workpieces.shape import PartShape

LARGEST_MESH = 256 * 1024**2
MOST_TRIANGLES = 2_000_000
_MERGED = 1e-6  # of the part's size: corners that a file repeats for each triangle


def read_mesh_shape(path: Path, unit_m: float) -> PartShape:
    """Read a closed mesh and find its sharp edges.

    Raises:
        InputError: the file is missing, empty, malformed, too large or has holes.
    """
    mesh = read_surface(path, unit_m)
    if not mesh.watertight():
        raise InputError(
            f"'{path.name}' is not a closed surface (a hole, or triangles that face different ways): close it to a solid."
        )
    if mesh.volume < 0.0:
        mesh = mesh.flipped()
    return PartShape(path.name, mesh, mesh_edges(mesh), unit_m)


def read_surface(path: Path, unit_m: float) -> TriMesh:
    """Read a mesh, closed or open, in metres, and join its repeated corners.

    Raises:
        InputError: the file is missing, empty, malformed or too large.
    """
    if file_size(path, LARGEST_MESH) == 0:
        raise InputError(f"'{path.name}' is empty.")
    vertices, triangles = _read(path)
    if not len(triangles):
        raise InputError(f"'{path.name}' holds no triangles that can be read: export the part again as a mesh.")
    if len(triangles) > MOST_TRIANGLES:
        raise InputError(
            f"'{path.name}' has {len(triangles)} triangles, more than {MOST_TRIANGLES}: export it coarser."
        )
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > LARGEST_NUMBER:
        raise InputError(f"'{path.name}' holds a coordinate that is not finite or too large: export the part again.")
    size = float(np.ptp(vertices, axis=0).max())
    if size <= 0.0:
        raise InputError(f"'{path.name}' has no extent: all its corners are one point.")
    return merge(TriMesh(vertices * unit_m, triangles), tolerance_m=_MERGED * size * unit_m)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N,3) in the file's unit and triangles (M,3), by Open3D."""
    from weldcal.models.open3d_core import o3d

    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    try:
        with quiet:
            found = o3d.io.read_triangle_mesh(path, enable_post_processing=False)
    except Exception as error:  # Open3D raises several types for malformed files
        raise InputError(f"'{path.name}' cannot be read: {str(error)[:120]}.") from error
    return np.asarray(found.vertices, dtype=np.float64), np.asarray(found.triangles, dtype=np.int64)
