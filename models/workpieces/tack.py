"""Put tacks on a true part: short beads in the joint, flat on top, with sloped ends."""

from __future__ import annotations

import dataclasses as dc
import math
from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.mesh import TriMesh, extrude, merge
from weldcal.models.workpieces.part import Part, WeldPart, numbered
from weldcal.models.workpieces.plate import Workpiece

IN_WALLS_M = 0.5e-3  # a choice: how far a bead reaches into the walls, so that no slit is left


def tack_mesh(part: WeldPart, start_m: float, end_m: float, height_m: float) -> TriMesh:
    """A bead of a height over the root, between two arc lengths of a part's seam, in its frame P."""
    line = part.seam_P
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    ups = np.broadcast_to(part.up_P, line.shape)
    middle, up = (np.array([np.interp(0.5 * (start_m + end_m), s, v[:, k]) for k in range(3)]) for v in (line, ups))
    ends = [np.array([np.interp(at, s, line[:, k]) for k in range(3)]) for at in (start_m, end_m)]
    x = ends[1] - ends[0]
    x = x - (x @ up) * up / (up @ up)
    R = RotationMatrix.ProjectToRotationMatrix(np.column_stack([x, up, np.cross(x, up)]))
    half, slope = 0.5 * (end_m - start_m), min(height_m, 0.25 * (end_m - start_m))
    outline = np.array([(-half, 0.0), (half, 0.0), (half - slope, height_m), (slope - half, height_m)])
    wide = height_m * math.tan(part.half_angle_rad) + IN_WALLS_M
    return extrude(outline, -wide, wide).transformed(RigidTransform(R, middle))


def tacked(part: WeldPart, tacks: Sequence[tuple[int, float, float, float]]) -> WeldPart:
    """The part with tacks: number of the seam, from 0, start and end along it, and height over its root, m."""
    beads = [tack_mesh(numbered(part, seam), start, end, height) for seam, start, end, height in tacks]
    if not beads:
        return part
    if isinstance(part, Part):
        return dc.replace(part, shape=dc.replace(part.shape, mesh=merge(part.mesh, *beads)))
    assert isinstance(part, Workpiece)
    return dc.replace(part, mesh=merge(part.mesh, *beads), groove_mesh=merge(part.groove_mesh, *beads))
