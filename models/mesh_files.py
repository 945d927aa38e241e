"""Reads a surface from an STL, OBJ or PLY file, in metres."""

from pathlib import Path

import numpy as np

from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh

SUFFIXES = (".stl", ".obj", ".ply")
UNITS_M = {"m": 1.0, "mm": 1e-3, "inch": 0.0254}


def read_mesh(path: Path, unit: str) -> TriMesh:
    """The triangles of a file, in the file's own frame; equal vertices are merged.

    Raises:
        InputError: no such file, another format, an unknown unit, or no triangles in it.
    """
    if unit not in UNITS_M:
        raise InputError(f"The unit of {path.name} must be one of {', '.join(UNITS_M)}, not '{unit}'.")
    if not path.is_file():
        raise InputError(f"There is no mesh file '{path}'.")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path.name} is no mesh that can be read: give one of {', '.join(SUFFIXES)}.")
    import open3d as o3d  # slow to import

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(path)
    mesh.remove_duplicated_vertices()
    if not len(mesh.triangles):
        raise InputError(f"{path.name} has no triangles: export the surface again, as STL, OBJ or PLY.")
    return TriMesh(UNITS_M[unit] * np.asarray(mesh.vertices), np.asarray(mesh.triangles))
