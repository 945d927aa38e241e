"""Reads a part's file of any kind, and checks its unit and its size."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from weldcal.models.errors import InputError
from weldcal.models.workpieces.shape import UNITS_M, PartShape
from weldcal.models.workpieces.step import read_step, referenced

LEAST_SIZE_M, LARGEST_SIZE_M = 0.005, 10.0
STEP_SUFFIXES = (".step", ".stp")
MESH_SUFFIXES = (".stl", ".obj", ".ply")


def read_shape(path: Path, units: str | None = None) -> PartShape:
    """Read a part from STEP (OpenCascade), STL, OBJ or PLY.

    Args:
        units: mm, m or inch. A STEP file states its own, which must agree; a mesh has none, and without this it is mm.

    Raises:
        InputError: a file that is missing, empty, malformed or no solid; an unknown unit; a size that no weld cell
            holds.
    """
    if units is not None and units not in UNITS_M:
        raise InputError(f"units must be {', '.join(UNITS_M)}, not '{units}'.")
    files = (path, *referenced(path)) if path.is_file() else (path,)
    return _read(path, units, tuple(_stamp(file) for file in files))


def _stamp(file: Path) -> tuple[Path, int, int]:
    found = file.stat() if file.is_file() else None
    return (file, 0, 0) if found is None else (file, found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=1)
def _read(path: Path, units: str | None, written: tuple[tuple[Path, int, int], ...]) -> PartShape:
    """Read a part once while its files, with their times and sizes, stay as they are: each seam that is planned asks
    for it."""
    suffix = path.suffix.lower()
    if suffix in STEP_SUFFIXES:
        shape = read_step(path, units)
    elif suffix in MESH_SUFFIXES:
        from weldcal.models.workpieces.mesh_files import read_mesh_shape

        shape = read_mesh_shape(path, UNITS_M[units or "mm"])
    else:
        kinds = ", ".join((*STEP_SUFFIXES, *MESH_SUFFIXES))
        raise InputError(f"'{path.name}' is no part that can be read: give a file that ends in {kinds}.")
    _check_size(path, shape)
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
