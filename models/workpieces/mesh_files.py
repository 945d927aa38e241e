"""Reads a part from an STL, OBJ or PLY file as a closed mesh."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER, file_size
from weldcal.models.mesh import TriMesh, merge
from weldcal.models.workpieces.shape import PartEdge, PartShape

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

SHARP_RAD = math.radians(20.0)  # between the triangles of a sharp edge
CORNER_RAD = math.radians(35.0)  # turn at which a chain ends
LEAST_LENGTH_M = 0.002


def mesh_edges(mesh: TriMesh) -> tuple[PartEdge, ...]:
    """The sharp edges of a closed mesh, numbered: the concave ones first, each by falling length."""
    pairs, sides = _shared(mesh)
    n = mesh.normals
    first, second = n[sides[:, 0]], n[sides[:, 1]]
    turn = np.arccos(np.clip(np.sum(first * second, axis=1), -1.0, 1.0))
    sharp = turn > SHARP_RAD
    pairs, sides, turn = pairs[sharp], sides[sharp], turn[sharp]
    # Concave where the far corner of the second triangle lies above the first.
    apex = mesh.triangles[sides[:, 1]].sum(axis=1) - pairs.sum(axis=1)
    rise = np.sum((mesh.vertices[apex] - mesh.vertices[pairs[:, 0]]) * n[sides[:, 0]], axis=1)
    found = []
    for kind, chosen in (("concave", rise > 0.0), ("convex", rise <= 0.0)):
        lines = _chained(mesh.vertices, pairs[chosen], turn[chosen])
        lines = [(points, angle) for points, angle in lines if _length(points) >= LEAST_LENGTH_M]
        found += [(kind, *line) for line in sorted(lines, key=lambda line: -_length(line[0]))]
    return tuple(
        PartEdge(k, kind, points, math.pi - angle, _radius(points))
        for k, (kind, points, angle) in enumerate(found, start=1)
    )


def _shared(mesh: TriMesh) -> tuple[Ints, Ints]:
    """Edges (K,2) by their vertices in the order of the first triangle, and the two triangles (K,2) that share each."""
    t = mesh.triangles
    directed = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    owner = np.tile(np.arange(len(t)), 3)
    n = len(mesh.vertices)
    forward, backward = directed[:, 0] * n + directed[:, 1], directed[:, 1] * n + directed[:, 0]
    order = np.argsort(forward)
    at = np.searchsorted(forward, backward, sorter=order)
    twin = order[np.minimum(at, len(order) - 1)]
    once = (directed[:, 0] < directed[:, 1]) & (forward[twin] == backward)
    return directed[once], np.column_stack([owner[once], owner[twin[once]]])


def _chained(vertices: Floats, pairs: Ints, turn: Floats) -> list[tuple[Floats, float]]:
    """Lines (N,3) through edges that follow each other without a corner, with the median angle between the faces' normals."""
    around: dict[int, list[int]] = {}
    for k, (a, b) in enumerate(pairs.tolist()):
        around.setdefault(a, []).append(k)
        around.setdefault(b, []).append(k)

    def onward(k: int, at: int) -> tuple[int, int] | None:
        """The one edge that goes on from a vertex without a corner, and its other end."""
        others = [j for j in around[at] if j != k]
        if len(others) != 1:
            return None
        j = others[0]
        a, b = pairs[j]
        far = int(b if a == at else a)
        start = int(pairs[k][0] if pairs[k][1] == at else pairs[k][1])
        u, v = vertices[at] - vertices[start], vertices[far] - vertices[at]
        cos = float(u @ v) / max(float(np.linalg.norm(u) * np.linalg.norm(v)), 1e-300)
        return None if cos < math.cos(CORNER_RAD) else (j, far)

    used = np.zeros(len(pairs), dtype=bool)
    lines = []
    for k in range(len(pairs)):
        if used[k]:
            continue
        used[k] = True
        chain, edges = [int(v) for v in pairs[k]], [k]
        for end in (1, 0):
            edge, at = k, chain[-1] if end else chain[0]
            while (step := onward(edge, at)) is not None and not used[step[0]]:
                edge, at = step
                used[edge] = True
                edges.append(edge)
                chain = [*chain, at] if end else [at, *chain]
        lines.append((vertices[chain], float(np.median(turn[edges]))))
    return lines


def _length(points: Floats) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _radius(points: Floats) -> float | None:
    """Radius m of the circle through all the points; None where they lie on none."""
    if len(points) < 6:
        return None
    centre = points.mean(axis=0)
    _, s, axes = np.linalg.svd(points - centre, full_matrices=False)
    if s[1] < 1e-3 * s[0] or s[2] > 0.02 * s[1]:
        return None
    x, y = (points - centre) @ axes[0], (points - centre) @ axes[1]
    a, *_ = np.linalg.lstsq(np.column_stack([x, y, np.ones(len(x))]), x**2 + y**2, rcond=None)
    radius = math.sqrt(max(0.0, a[2] + 0.25 * (a[0] ** 2 + a[1] ** 2)))
    off = np.hypot(x - 0.5 * a[0], y - 0.5 * a[1]) - radius
    return radius if np.abs(off).max() < 0.01 * radius else None


LARGEST_MESH = 256 * 1024**2
MOST_TRIANGLES = 2_000_000
_MERGED = 1e-6  # of the part's size: corners that a file repeats for each triangle


def read_mesh_shape(path: Path, unit_m: float) -> PartShape:
    """Read a closed mesh and find its sharp edges.

    Raises:
        InputError: the file is missing, empty, malformed, too large or has holes.
    """
    mesh, bodies = _bodies(read_surface(path, unit_m))
    if not mesh.watertight():
        raise InputError(
            f"'{path.name}' is not a closed surface (a hole, or triangles that face different ways): close it to a solid."
        )
    if mesh.volume < 0.0:
        mesh = mesh.flipped()
    return PartShape(path.name, mesh, mesh_edges(mesh), unit_m, bodies)


def _bodies(mesh: TriMesh) -> tuple[TriMesh, int]:
    """The mesh with corners of its own for each body, and their number: bodies that touch in an edge or a face share none.

    Where more than two triangles meet in an edge, two of them bound the same material.
    """
    t, n = mesh.triangles, len(mesh.vertices)
    edges = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    apex, owner = np.concatenate([t[:, 2], t[:, 0], t[:, 1]]), np.tile(np.arange(len(t)), 3)
    key = edges.min(axis=1) * n + edges.max(axis=1)
    order = np.argsort(key, kind="stable")
    pairs = []
    for met in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        ahead = edges[met, 0] < edges[met, 1]
        if len(met) == 2 or 2 * ahead.sum() != len(met):
            pairs.append(met[:2])
            continue
        foot, tip = mesh.vertices[np.sort(edges[met[0]])]
        along = (tip - foot) / np.linalg.norm(tip - foot)
        out = mesh.vertices[apex[met]] - foot
        across = out[0] - (out[0] @ along) * along
        angle = np.arctan2(out @ np.cross(along, across), out @ across)
        for k in np.flatnonzero(ahead):
            behind = (angle[k] - angle[~ahead] - 1e-4) % (2.0 * math.pi)  # through the material
            pairs.append(np.array([met[k], met[~ahead][np.argmin(behind)]]))
    joined = owner[np.array([pair for pair in pairs if len(pair) == 2]).reshape(-1, 2)]
    links = coo_matrix((np.ones(len(joined)), (joined[:, 0], joined[:, 1])), shape=(len(t), len(t)))
    count, body = connected_components(links, directed=False)
    own, triangles = np.unique(body[:, None] * n + t, return_inverse=True)
    return TriMesh(mesh.vertices[own % n], triangles.reshape(-1, 3)), count


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
    from weldcal.models.mesh import o3d

    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    try:
        with quiet:
            found = o3d.io.read_triangle_mesh(path, enable_post_processing=False)
    except Exception as error:  # Open3D raises several types for malformed files
        raise InputError(f"'{path.name}' cannot be read: {str(error)[:120]}.") from error
    return np.asarray(found.vertices, dtype=np.float64), np.asarray(found.triangles, dtype=np.int64)
