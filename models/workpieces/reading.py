"""Reads a part's file of any kind, and checks its unit and its size."""

from __future__ import annotations

import pickle
import resource
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import file_digest
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from weldcal.models.errors import InputError
from weldcal.models.workpieces.shape import UNITS_M, PartShape
from weldcal.models.workpieces.step import read_step, referenced

LEAST_SIZE_M, LARGEST_SIZE_M = 0.005, 10.0
STEP_SUFFIXES = (".step", ".stp")
MESH_SUFFIXES = (".stl", ".obj", ".ply")
LARGE_BYTES = 250_000  # a file from here on is read in a process of its own
MOST_S = 45  # of processor time for it: OpenCascade may go on for ever, and answers no signal then


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
    return _read(tuple(_Written(file, file.name, *_content(file)) for file in files), units)


@dataclass(frozen=True)
class _Written:
    """A file by its name and content: a copy of it, as in a cell's folder, is the same."""

    path: Path = field(compare=False)
    name: str
    size: int
    digest: bytes


def _content(file: Path) -> tuple[int, bytes]:
    if not file.is_file():
        return 0, b""
    with file.open("rb") as content:
        return file.stat().st_size, file_digest(content, "sha256").digest()


@lru_cache(maxsize=1)
def _read(files: tuple[_Written, ...], units: str | None) -> PartShape:
    """Read a part once while its files stay as they are; each plan asks for it."""
    path = files[0].path
    shape = _bounded(path, units) if sum(file.size for file in files) > LARGE_BYTES else _sure(path, units)
    _check_size(path, shape)
    return shape


def _parsed(path: Path, units: str | None) -> PartShape:
    suffix = path.suffix.lower()
    if suffix in STEP_SUFFIXES:
        return read_step(path, units)
    if suffix in MESH_SUFFIXES:
        from weldcal.models.workpieces.mesh_files import read_mesh_shape

        return read_mesh_shape(path, UNITS_M[units or "mm"])
    kinds = ", ".join((*STEP_SUFFIXES, *MESH_SUFFIXES))
    raise InputError(f"'{path.name}' is no part that can be read: give a file that ends in {kinds}.")


def _sure(path: Path, units: str | None) -> PartShape:
    """Read a part. Raises InputError also where OpenCascade ends with an exception of its own."""
    try:
        return _parsed(path, units)
    except Exception as error:
        if type(error).__module__.split(".")[0] != "OCP":
            raise
        what = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise InputError(
            f"OpenCascade cannot evaluate '{path.name}' ({what}): repair the part in the CAD program, as by exporting"
            " only the bodies that are welded."
        ) from error


def _bounded(path: Path, units: str | None) -> PartShape:
    """Read a part in a process that ends after MOST_S of processor time.

    Raises:
        InputError: as read_shape; or it did not come to an end.
    """
    with TemporaryDirectory() as folder:
        result = Path(folder) / "shape"
        code = f"from weldcal.models.workpieces.reading import send; send({str(path)!r}, {units!r}, {str(result)!r})"
        quiet = subprocess.DEVNULL
        ended = subprocess.run([sys.executable, "-c", code], check=False, stdout=quiet, stderr=quiet).returncode
        found = pickle.loads(result.read_bytes()) if result.is_file() else None
    if isinstance(found, InputError):
        raise found
    if not isinstance(found, PartShape):
        lighter = "without threads, holes and purchased parts"
        if path.suffix.lower() in MESH_SUFFIXES:
            lighter = f"as a STEP file or with fewer triangles, {lighter}"
        late = ended in (-signal.SIGXCPU, -signal.SIGKILL)
        why = f"cannot be read within {MOST_S} s of processor time" if late else "makes its reader crash"
        raise InputError(
            f"'{path.name}' {why}: it has too many faces, or damaged ones. Export only the bodies that are welded,"
            f" {lighter}."
        )
    return found


def send(path: str, units: str | None, result: str) -> None:
    """Read a part within MOST_S, and write its shape, or the error, to a file."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_S, MOST_S + 1))
    try:
        found: PartShape | InputError = _sure(Path(path), units)
    except InputError as error:
        found = error
    Path(result).write_bytes(pickle.dumps(found))


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
