"""Bends a grooved plate over a cylinder: the same seam in space, with an up-normal that turns along it."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.models.workpieces.plate import Workpiece

Floats = npt.NDArray[np.float64]
LEAST_RADIUS_M = 0.100
SEEN_EDGE_M, FELT_EDGE_M = 0.012, 0.003  # longest edges: over 150 mm their middles are 0.12 mm and 8 um off


def bend(workpiece: Workpiece, radius_m: float) -> Workpiece:
    """The workpiece rolled over a cylinder of that radius (at its top face) whose axis lies along -y below its middle.

    Lengths along x stay what they are in the top face; (x, y, z) comes to ((r + z) sin(x/r), y, (r + z) cos(x/r) - r). The
    groove's walls keep their angle to the surface to within depth / radius.

    Raises:
        InputError: a radius below 100 mm, or a plate that would be bent by more than 60 degrees to either side.
    """
    if not (math.isfinite(radius_m) and radius_m >= LEAST_RADIUS_M):
        raise InputError(f"A plate is bent over at least {1e3 * LEAST_RADIUS_M:.0f} mm, not {1e3 * radius_m:.0f} mm.")
    if 0.5 * workpiece.size_m[0] > math.radians(60.0) * radius_m:
        raise InputError(
            f"A plate {1e3 * workpiece.size_m[0]:.0f} mm long does not go over a radius of {1e3 * radius_m:.0f} mm: "
            "make the seam shorter or the radius larger."
        )
    seam = rolled(workpiece.seam_P, radius_m)
    angle = workpiece.seam_P[:, 0] / radius_m
    t = workpiece.tangents_P
    stretched = t[:, 0] * (1.0 + workpiece.seam_P[:, 2] / radius_m)
    tangents = np.column_stack([stretched * np.cos(angle), t[:, 1], -stretched * np.sin(angle)])
    steps = np.linalg.norm(np.diff(seam, axis=0), axis=1)
    return replace(
        workpiece,
        name=f"{workpiece.name}_bent",
        mesh=_bent(workpiece.mesh, radius_m, SEEN_EDGE_M),
        groove_mesh=_bent(workpiece.groove_mesh, radius_m, FELT_EDGE_M),
        seam_P=seam,
        tangents_P=tangents / np.linalg.norm(tangents, axis=1, keepdims=True),
        arc_length_m=np.concatenate([[0.0], np.cumsum(steps)]),
        bend_radius_m=radius_m,
        up_P=np.column_stack([np.sin(angle), np.zeros(len(angle)), np.cos(angle)]),
    )


def rolled(points: Floats, radius_m: float) -> Floats:
    """Points (N,3) m of the flat plate, on the cylinder."""
    angle, r = points[:, 0] / radius_m, radius_m + points[:, 2]
    return np.column_stack([r * np.sin(angle), points[:, 1], r * np.cos(angle) - radius_m])


def _bent(mesh: TriMesh, radius_m: float, edge_m: float) -> TriMesh:
    fine = divided(mesh, edge_m)
    return TriMesh(rolled(fine.vertices, radius_m), fine.triangles)


def divided(mesh: TriMesh, edge_m: float) -> TriMesh:
    """The same surface with no edge that runs further than `edge_m` along x; closed where it was closed.

    Every edge that is too long is halved, for both of its triangles alike, and each triangle is cut anew.
    """
    points, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    while True:
        ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2)  # (M, 3 edges, 2)
        long = np.abs(points[ends[..., 0], 0] - points[ends[..., 1], 0]) > edge_m
        if not long.any():
            return TriMesh(points, triangles)
        edges, which = np.unique(ends[long], axis=0, return_inverse=True)
        middle = np.full(long.shape, -1, dtype=np.int64)
        middle[long] = len(points) + which.ravel()
        points = np.vstack([points, points[edges].mean(axis=1)])
        pieces = [triangles[~long.any(axis=1)]]
        for cut in range(1, 4):
            some = np.flatnonzero(long.sum(axis=1) == cut)
            # Turned so that the edges to be halved come first, or the one that is not comes last.
            first = np.argmax(long[some], axis=1) if cut < 2 else (np.argmin(long[some], axis=1) + 1) % 3
            turn = (first[:, None] + np.arange(3)) % 3
            a, b, c = np.take_along_axis(triangles[some], turn, axis=1).T
            ab, bc, ca = np.take_along_axis(middle[some], turn, axis=1).T
            new = {
                1: [(a, ab, c), (ab, b, c)],
                2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
                3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
            }[cut]
            pieces += [np.column_stack(t) for t in new]
        triangles = np.vstack(pieces)
