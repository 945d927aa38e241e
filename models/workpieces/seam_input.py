"""Reads what a user says of a seam.

A polyline in a CSV file or numbered edges of the part, its direction and its ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER, read_text
from weldcal.models.text_tables import cells_of, lines_of, separator_of
from weldcal.models.workpieces.drawing import draw_seam
from weldcal.models.workpieces.seams import JOINTS, DrawnSeam
from weldcal.models.workpieces.shape import PartShape

Floats = npt.NDArray[np.float64]

DIRECTIONS = ("forward", "reverse")
CHAINED_M = 0.0005  # between the ends of edges that follow each other
LARGEST_SEAM_FILE = 16 * 1024**2
MOST_SEAM_POINTS = 200_000


@dataclass(frozen=True)
class SeamSource:
    """Where a seam comes from: `polyline`, a CSV file, or `edges`, numbers of the part.

    Its direction and its ends, m.
    """

    polyline: Path | None = None
    edges: tuple[int, ...] = ()
    direction: str = "forward"
    start_m: float = 0.0
    end_m: float = 0.0

    def __post_init__(self) -> None:
        if (self.polyline is None) == (not self.edges):
            raise InputError("A seam needs either polyline: FILE.csv or edges: [NUMBER, ...], and not both.")
        if self.direction not in DIRECTIONS:
            raise InputError(f"A seam's direction must be forward or reverse, not '{self.direction}'.")
        if self.start_m < 0.0:
            raise InputError("A seam's start_mm is cut off its start: give 0 or more.")


def seam_of(shape: PartShape, source: SeamSource, joint: str) -> DrawnSeam:
    """Return the seam on the part.

    Raises:
        InputError: a file that cannot be read, edges that do not follow each other, a joint that is not there.
    """
    if joint not in JOINTS:
        raise InputError(f"joint must be one of {', '.join(JOINTS)}, not '{joint}'.")
    if source.polyline is not None:
        line, normals = read_polyline(source.polyline)
        line = line * shape.unit_m
        closed = len(line) > 3 and bool(np.linalg.norm(line[0] - line[-1]) < 1e-6)
        drawn = draw_seam(shape.mesh, line, joint, normals, closed)
    else:
        drawn = _along_edges(shape, tuple(source.edges), joint)
    if source.direction == "reverse":
        drawn = drawn.reversed()
    if source.end_m < 0.0 and not (drawn.closed and source.end_m >= -drawn.length_m):
        raise InputError(
            "A seam's end_mm is cut off its end: give 0 or more. Below 0, at most once around, a closed seam "
            "goes on over its start."
        )
    if source.start_m or source.end_m:
        drawn = drawn.between(source.start_m, drawn.length_m - source.end_m)
    return drawn


@lru_cache(64)  # a check, a cell and a plan ask for the same seam
def _along_edges(shape: PartShape, edges: tuple[int, ...], joint: str) -> DrawnSeam:
    line, closed = chained(shape, edges)
    ups = [shape.edge(id).up_P for id in edges if len(shape.edge(id).points_P) == 2]
    normals = np.broadcast_to(ups[0], line.shape) if len(ups) == len(edges) == 1 and ups[0] is not None else None
    return draw_seam(shape.mesh, line, joint, normals, closed)


def chained(shape: PartShape, ids: Sequence[int]) -> tuple[Floats, bool]:
    """The edges one after the other, (N,3) m, in the order given, and whether they close; each is turned as needed.

    Raises:
        InputError: an unknown or repeated number, or edges that do not follow each other.
    """
    if len(set(ids)) != len(ids):
        raise InputError(f"The seam's edges {list(ids)} name one of them twice.")
    pieces = [np.asarray(shape.edge(id).points_P) for id in ids]
    line = pieces[0]
    if len(pieces) > 1 and _apart(line[-1], pieces[1]) > _apart(line[0], pieces[1]):
        line = line[::-1]
    for k, piece in enumerate(pieces[1:], start=1):
        gap = _apart(line[-1], piece)
        if gap > CHAINED_M:
            raise InputError(
                f"Edge {ids[k]} does not follow edge {ids[k - 1]}: their ends are {1e3 * gap:.2f} mm apart; give the"
                " edges in order."
            )
        if np.linalg.norm(piece[-1] - line[-1]) < np.linalg.norm(piece[0] - line[-1]):
            piece = piece[::-1]
        line = np.vstack([line, piece[1:]])
    return line, len(line) > 3 and bool(np.linalg.norm(line[0] - line[-1]) < CHAINED_M)


def _apart(point: Floats, piece: Floats) -> float:
    return float(np.linalg.norm(piece[[0, -1]] - point, axis=1).min())


def read_polyline(path: Path) -> tuple[Floats, Floats | None]:
    """Points (N,3) in the file's unit, and the directions (N,3) out of the joint where the file has them.

    Rows x, y, z or x, y, z, nx, ny, nz, separated by commas, semicolons or spaces; one header line is allowed; # starts
    a comment.

    Raises:
        InputError: naming the line that is at fault.
    """
    rows: list[list[float]] = []
    first = True
    lines = [(k, s.split("#")[0].strip(" \t,;")) for k, s in lines_of(read_text(path, LARGEST_SEAM_FILE), ("#",))]
    separator = separator_of([text for _, text in lines])
    for number, text in lines:
        cells = cells_of(text, separator)
        try:
            row = [float(c) for c in cells]
        except ValueError:
            if first:
                first = False
                continue
            raise InputError(f"'{path.name}' line {number} is not numbers: {text[:60]!r}.") from None
        first = False
        if len(row) not in (3, 6) or (rows and len(row) != len(rows[0])):
            raise InputError(
                f"'{path.name}' line {number} has {len(row)} numbers: each row is x,y,z or x,y,z,nx,ny,nz."
            )
        if not np.isfinite(row).all() or max(map(abs, row)) > LARGEST_NUMBER:
            raise InputError(f"'{path.name}' line {number} holds a number that is not finite or too large.")
        rows.append(row)
        if len(rows) > MOST_SEAM_POINTS:
            raise InputError(f"'{path.name}' has more than {MOST_SEAM_POINTS} points: thin it out.")
    if len(rows) < 2:
        raise InputError(f"'{path.name}' holds {len(rows)} points: a seam needs at least two.")
    table = np.array(rows)
    if table.shape[1] == 3:
        return table, None
    length = np.linalg.norm(table[:, 3:], axis=1)
    if (length < 1e-6).any():
        raise InputError(f"'{path.name}' has a direction nx,ny,nz of no length in row {int(np.argmin(length)) + 1}.")
    return table[:, :3], table[:, 3:] / length[:, None]
