"""The ring that a part's file shows a scanner: the flat face between an outer circle and a bore, for calibration."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import LARGEST_RING_M, LEAST_RING_M
from weldcal.models.workpieces.reading import read_shape

FLAT_M = 5e-5  # a choice: how far circles of one face may lie off each other, in plane and centre
FACE = 0.6  # a choice: share of the ring that must be there between its holes
BEVEL_M = 0.003  # a choice: a wider or deeper step at the outside is a shoulder
ALONG = 0.9  # a choice: cosine of 25 degrees, beyond which a face does not look along z
ALIKE = 0.99  # of two radii: a choice, they are one


@dataclass(frozen=True, eq=False)
class OwnRing:
    """The ring of a part's file: its name for get_flange, and its pose X_SR in the frame of the file (z out of it)."""

    name: str
    X_SR: RigidTransform


def own_ring(path: Path) -> OwnRing:
    """Return the only ring of a part, or of several, such as front and back, the widest that looks along the file's z.

    Raises:
        InputError: the file cannot be read, or no flat face of it lies between two circles of one centre.
    """
    shape = read_shape(path)
    circles = [_circle(e.points_P) for e in shape.edges if e.closed and e.radius_m is not None and e.kind == "convex"]
    mesh, found = shape.mesh, []
    middles, areas = mesh.vertices[mesh.triangles].mean(axis=1), np.linalg.norm(mesh.area_vectors, axis=1)
    for centre, axis, outer in circles:
        if not LEAST_RING_M <= 2.0 * outer <= LARGEST_RING_M:
            continue
        level = np.abs((mesh.vertices - centre) @ axis)[mesh.triangles].max(axis=1) < FLAT_M
        away = np.linalg.norm(middles - centre, axis=1)
        inside = [r for c, a, r in circles if r < ALIKE * outer and _same(c, a, centre, axis)]
        if not inside:
            continue
        bore = max(inside)
        on = level & (away < outer) & (away > 0.9 * bore)  # a triangle's middle may lie within a coarse bore
        if areas[on].sum() < FACE * np.pi * (outer**2 - bore**2):
            continue
        z = mesh.area_vectors[on].sum(axis=0)
        z = z / np.linalg.norm(z)
        found.append((outer, float(z[2]), bore, centre, z))
    if not found:
        low, high = 1e3 * LEAST_RING_M, 1e3 * LARGEST_RING_M
        raise InputError(
            f"'{path.name}' has no flat face between an outer circle of {low:.0f} to {high:.0f} mm and a bore of one"
            " centre, by which weldcal calibrates. Give a part with one."
        )
    upward = found if len(found) == 1 else [one for one in found if one[1] > ALONG]
    widest = max((one[0] for one in upward), default=0.0)
    alike = [one for one in upward if one[0] > ALIKE * widest]
    if len(alike) != 1:
        raise InputError(
            f"'{path.name}' has {len(found)} rings, and {len(alike) or 'none'} of the widest that look along z. Turn"
            " the part in its file so that the face that the scanner sees looks along z, and is the widest that does."
        )
    outer, _, bore, centre, z = alike[0]
    bevels = [r - outer for c, a, r in circles if outer < r < outer + BEVEL_M and _below(c, a, centre, z)]
    bevel = round(max(bevels, default=0.0), 5)
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x = x / np.linalg.norm(x)
    R = RotationMatrix.ProjectToRotationMatrix(np.column_stack([x, np.cross(z, x), z]))
    name = f"ring-{2e3 * (outer + bevel):.2f}-{2e3 * (bore - bevel):.2f}-c{1e3 * bevel:.2f}"
    return OwnRing(name, RigidTransform(R, centre))


def _circle(points: Array) -> tuple[Array, Array, float]:
    """Centre (3,) m, axis (3,) and radius m of the circle through the points (N, 3) of a closed edge."""
    p = points[:-1]
    middle = p.mean(axis=0)
    _, _, axes = np.linalg.svd(p - middle)
    flat = (p - middle) @ axes[:2].T
    a, b, c = np.linalg.lstsq(np.column_stack([2.0 * flat, np.ones(len(flat))]), (flat**2).sum(axis=1), rcond=None)[0]
    return middle + axes[:2].T @ [a, b], axes[2], float(np.sqrt(c + a * a + b * b))


def _same(centre: Array, axis: Array, other: Array, along: Array) -> bool:
    """Whether two circles have one centre and lie in one plane."""
    return float(np.linalg.norm(centre - other)) < FLAT_M and abs(float(axis @ along)) > ALIKE


def _below(centre: Array, axis: Array, top: Array, z: Array) -> bool:
    """Whether a circle lies a bevel below a face, about the same axis."""
    down = top - centre
    depth = float(down @ z)
    return 0.0 < depth < BEVEL_M and float(np.linalg.norm(down - depth * z)) < FLAT_M and abs(float(axis @ z)) > ALIKE
