"""The shape of a part as its file has it: a closed mesh in metres and the numbered edges at which faces meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh

Floats = npt.NDArray[np.float64]

UNITS_M = {"mm": 1e-3, "m": 1.0, "inch": 0.0254}


@dataclass(frozen=True, eq=False)
class PartEdge:
    """An edge of a part in its frame P.

    Attributes:
        id: the number by which a scenario names it, from 1.
        kind: concave: the free space between the faces is less than pi; flush: the faces of two bodies lie in one
            plane; convex; smooth: the faces are tangent; boundary: only one face ends here.
        points_P: (N,3) m, N >= 2, along the edge; a closed edge repeats its first point.
        angle_rad: between the two faces: through the free space of a concave edge, through the material of a convex
            one; pi of a smooth edge, nan of a boundary.
        radius_m: of a circular edge; None of any other.
        up_P: (3,) unit, out of the joint at the middle of the edge, where it belongs to one.
    """

    id: int
    kind: str
    points_P: Floats
    angle_rad: float
    radius_m: float | None = None
    up_P: Floats | None = None

    @property
    def length_m(self) -> float:
        """Arc length, m."""
        return float(np.linalg.norm(np.diff(self.points_P, axis=0), axis=1).sum())

    @property
    def closed(self) -> bool:
        """Whether the edge ends where it starts."""
        return len(self.points_P) > 2 and bool(np.linalg.norm(self.points_P[0] - self.points_P[-1]) < 1e-6)


@dataclass(frozen=True, eq=False, kw_only=True)
class PartJoint:
    """A place at which a part can be welded: one seam along edges that follow each other.

    Attributes:
        type: T, lap, corner, V, HV, butt, edge, pipe on plate, pipe on pipe or flange on pipe.
        edges: their numbers in the order of travel.
        length_m: along all of them.
        angle_rad: through the free space; pi where the faces are flush.
        gap_m: largest gap between the bodies.
        walls_m: extent of the two walls from the root; of flush faces their depth.
        thick_m: of the two bodies at the root, under these walls.
        up_P: (3,) unit, out of the joint, in the middle of its longest edge.
        side: left or right of a web, inside or outside of a corner; else "".
        closed: it ends where it begins.
        bodies: names of the two bodies in the file, as far as it has them.
    """

    type: str
    edges: tuple[int, ...]
    length_m: float
    angle_rad: float
    gap_m: float = 0.0
    walls_m: tuple[float, float] = (0.0, 0.0)
    thick_m: tuple[float, float] = (0.0, 0.0)
    up_P: Floats
    side: str = ""
    closed: bool = False
    bodies: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class PartShape:
    """A part in its frame P, m.

    Its mesh, its edges by ascending id, the file's unit in m, its bodies, its joints, and in notes what its reader
    changed or left out, in sentences.
    """

    name: str
    mesh: TriMesh
    edges: tuple[PartEdge, ...]
    unit_m: float
    bodies: int = 1
    joints: tuple[PartJoint, ...] = ()
    notes: tuple[str, ...] = ()

    def edge(self, id: int) -> PartEdge:
        """Return the edge with this number.

        Raises:
            InputError: there is none.
        """
        found = next((e for e in self.edges if e.id == id), None)
        if found is None:
            raise InputError(
                f"'{self.name}' has no edge {id}: its edges are 1 to {len(self.edges)}; 'weldcal part' with its file"
                " lists them."
            )
        return found
