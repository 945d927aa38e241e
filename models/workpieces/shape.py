"""The shape of a part as its file has it: a closed mesh in metres and the numbered edges at which faces meet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh

Floats = npt.NDArray[np.float64]

UNITS_M = {"mm": 1e-3, "m": 1.0, "inch": 0.0254}
LEAST_SIZE_M, LARGEST_SIZE_M = 0.005, 10.0
STEP_SUFFIXES = (".step", ".stp")
MESH_SUFFIXES = (".stl", ".obj", ".ply")
KINDS = ("concave", "convex", "smooth", "boundary")


@dataclass(frozen=True, eq=False)
class PartEdge:
    """An edge of a part in its frame P.

    id        the number by which a scenario names it, from 1
    kind      concave: the free space between the faces is less than pi; convex; smooth: the faces are tangent; boundary:
              only one face ends here
    points_P  (N,3) m, N >= 2, along the edge; a closed edge repeats its first point
    angle_rad between the two faces: through the free space of a concave edge, through the material of a convex one;
              pi of a smooth edge, nan of a boundary
    radius_m  of a circular edge; None of any other
    """

    id: int
    kind: str
    points_P: Floats
    angle_rad: float
    radius_m: float | None = None

    @property
    def length_m(self) -> float:
        """Arc length, m."""
        return float(np.linalg.norm(np.diff(self.points_P, axis=0), axis=1).sum())

    @property
    def closed(self) -> bool:
        """Whether the edge ends where it starts."""
        return len(self.points_P) > 2 and bool(np.linalg.norm(self.points_P[0] - self.points_P[-1]) < 1e-6)


@dataclass(frozen=True, eq=False)
class PartShape:
    """A part in its frame P, m: its mesh, its edges by ascending id, the file's unit in m, and the number of its bodies."""

    name: str
    mesh: TriMesh
    edges: tuple[PartEdge, ...]
    unit_m: float
    bodies: int = 1

    def edge(self, id: int) -> PartEdge:
        """The edge with this number.

        Raises:
            InputError: there is none.
        """
        found = next((e for e in self.edges if e.id == id), None)
        if found is None:
            raise InputError(
                f"'{self.name}' has no edge {id}: its edges are 1 to {len(self.edges)}; weldcal part {self.name} lists them."
            )
        return found


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
