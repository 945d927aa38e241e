"""Reads a part from an STL, OBJ or PLY file as a closed mesh."""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER, file_size
from weldcal.models.mesh import TriMesh, merge
from weldcal.models.workpieces.shape import PartEdge, PartJoint, PartShape

if TYPE_CHECKING:
    from weldcal.models.workpieces.brep import MeshBody

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

SHARP_RAD = math.radians(20.0)  # between the triangles of a sharp edge
CORNER_RAD = math.radians(35.0)  # turn at which a chain ends
LEAST_LENGTH_M = 0.002
FLAT_RAD, FINE = math.radians(0.2), 1e-6  # between the triangles of a plane; rounding of corners, of the part's size
ROUGH_MM = 0.005  # of a corner from its plane or cylinder
LARGEST_RADIUS_MM = 2000.0
MOST_MISSED, MUCH = 200, 10.0  # tries of cylinders that fail; a plane among bent strips is so many times larger


def mesh_edges(mesh: TriMesh) -> tuple[PartEdge, ...]:
    """Return the sharp edges of a closed mesh, numbered: the concave ones first, each by falling length."""
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
    """Chain edges that follow each other without a corner to lines (N,3).

    With the median angle between the faces' normals.
    """
    around: dict[int, list[int]] = {}
    for k, (a, b) in enumerate(pairs.tolist()):
        around.setdefault(a, []).append(k)
        around.setdefault(b, []).append(k)

    def onward(k: int, at: int) -> tuple[int, int] | None:
        """Return the one edge that goes on from a vertex without a corner, and its other end."""
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
    mesh, body = _bodies(read_surface(path, unit_m))
    if not mesh.watertight():
        raise InputError(
            f"'{path.name}' is not a closed surface: it has a hole, or some triangles face inward and others outward."
            " Repair it to a closed solid."
        )
    if mesh.volume < 0.0:
        mesh = mesh.flipped()
    bodies = int(body.max()) + 1
    edges, joints, notes = mesh_edges(mesh), tuple[PartJoint, ...](), list[str]()
    if find_spec("OCP") is not None:  # without OpenCascade no joints are looked for
        from weldcal.models.workpieces.joints import joints_between
        from weldcal.models.workpieces.step import with_joints

        edges, joints = with_joints(edges, joints_between(_solids(mesh, body), notes))
    return PartShape(
        name=path.name, mesh=mesh, edges=edges, unit_m=unit_m, bodies=bodies, joints=joints, notes=tuple(notes)
    )


def _bodies(mesh: TriMesh) -> tuple[TriMesh, Ints]:
    """Return the mesh with corners of its own for each body, and the body (M,) of each triangle.

    Bodies that touch share no corner.

    Most programs write one body after another: each ends where all the edges since its beginning are met from both
    sides. A body that is written twice counts once.
    """
    t, n = mesh.triangles, len(mesh.vertices)
    edges = t[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    key, ahead = edges.min(axis=1) * n + edges.max(axis=1), np.where(edges[:, 0] < edges[:, 1], 1, -1)
    order = np.argsort(key, kind="stable")
    first = np.concatenate([[True], np.diff(key[order]) != 0])
    total = np.cumsum(ahead[order])
    total -= (total - ahead[order])[first][np.cumsum(first) - 1]
    was = np.where(first, 0, np.roll(total, 1))
    change = np.zeros(len(key), dtype=np.int64)
    change[order] = (total != 0).astype(np.int64) - (was != 0)
    closed = np.cumsum(change)[2::3] == 0
    written = np.concatenate([[0], np.cumsum(closed)[:-1]])
    kept, body, seen, count = list[Ints](), list[Ints](), set[bytes](), 0
    for some in np.split(np.arange(len(t)), np.flatnonzero(np.diff(written)) + 1):
        turned = np.argmin(t[some], axis=1)[:, None] + np.arange(3)
        same = np.take_along_axis(t[some], turned % 3, axis=1)
        if (name := same[np.lexsort(same.T)].tobytes()) not in seen:
            seen.add(name)
            kept.append(some)
            body.append(count + _apart(TriMesh(mesh.vertices, t[some])))
            count = int(body[-1].max()) + 1
    t, bodies = t[np.concatenate(kept)], np.concatenate(body)
    own, triangles = np.unique(bodies[:, None] * n + t, return_inverse=True)
    return TriMesh(mesh.vertices[own % n], triangles.reshape(-1, 3)), bodies


def _apart(mesh: TriMesh) -> Ints:
    """Return the body (M,) of each triangle where bodies may touch in an edge.

    Two of more triangles at it bound the same material.
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
    return _components(len(t), joined)


def _solids(mesh: TriMesh, body: Ints) -> list[MeshBody]:
    """Return the bodies of a mesh with their faces, mm; the skin of a cavity belongs to the body around it."""
    from weldcal.models.workpieces.brep import MeshBody, MeshFace

    shells = [TriMesh(1e3 * mesh.vertices, mesh.triangles[body == k]) for k in range(int(body.max()) + 1)]
    spans = [np.stack([c.min(axis=(0, 1)), c.max(axis=(0, 1))]) for c in (m.vertices[m.triangles] for m in shells)]
    inner = [k for k, shell in enumerate(shells) if shell.volume < 0.0]
    around = {k: list[int]() for k in range(len(shells)) if k not in inner}
    for k in inner:
        within = [j for j in around if (spans[j][0] < spans[k][0]).all() and (spans[j][1] > spans[k][1]).all()]
        if within:
            around[min(within, key=lambda j: float(np.ptp(spans[j], axis=0).prod()))].append(k)
        else:
            shells[k] = shells[k].flipped()
            around[k] = []
    found = []
    for k, holes in around.items():
        t = np.concatenate([shells[j].triangles for j in (k, *holes)])
        used, index = np.unique(t, return_inverse=True)
        solid = TriMesh(shells[k].vertices[used], index.reshape(-1, 3))
        label, fits = regions(solid)
        corners = solid.vertices[solid.triangles]
        faces = [MeshFace(corners[label == j], fit) for j, fit in enumerate(fits)]
        found.append(MeshBody(corners, faces, _borders(solid, label)))
    return found


def _borders(mesh: TriMesh, label: Ints) -> list[tuple[Floats, list[int]]]:
    """Return the lines (N,3) along which two regions meet, each with the two."""
    pairs, sides = _shared(mesh)
    met = np.sort(label[sides], axis=1)
    apart = met[:, 0] != met[:, 1]
    pairs, met = pairs[apart], met[apart]
    kinds, which = np.unique(met, axis=0, return_inverse=True)
    which = which.ravel()
    order = np.argsort(which, kind="stable")
    return [
        (line, kinds[which[some[0]]].tolist())
        for some in np.split(order, np.flatnonzero(np.diff(which[order])) + 1)
        if len(some)
        for line, _ in _chained(mesh.vertices, pairs[some], np.zeros(len(some)))
    ]


def regions(mesh: TriMesh) -> tuple[Ints, list[tuple[Floats, Floats, float] | None]]:
    """Return the planes and cylinders of a closed mesh, mm.

    Returns:
        The region (M,) of each triangle, and of each region a point, the normal or the axis, and 0 or the radius,
        negative of a hole; None of a region that is neither.
    """
    corners, n, area = mesh.vertices[mesh.triangles], mesh.normals, np.linalg.norm(mesh.area_vectors, axis=1)
    pairs, sides = _shared(mesh)
    a, b = sides.T
    turn = np.arccos(np.clip(np.vecdot(n[a], n[b]), -1.0, 1.0))
    off = [
        np.abs(np.vecdot(corners[q] - mesh.vertices[pairs[:, :1]], n[p][:, None])).max(axis=1)
        for p, q in ((a, b), (b, a))
    ]
    fine = FINE * float(np.ptp(mesh.vertices, axis=0).max())
    flat = (turn < FLAT_RAD) | ((np.where(area[a] < area[b], off[1], off[0]) < fine) & (turn < SHARP_RAD))
    patch = _components(len(n), sides[flat])
    count = int(patch.max()) + 1
    members = np.split(np.argsort(patch, kind="stable"), np.cumsum(np.bincount(patch))[:-1])
    size = np.bincount(patch, weights=area)
    smooth = (turn < SHARP_RAD) & (patch[a] != patch[b])
    near = [set[int]() for _ in range(count)]
    for p, q in zip(patch[a[smooth]].tolist(), patch[b[smooth]].tolist(), strict=True):
        near[p].add(q)
        near[q].add(p)
    middle = [np.average(n[some], axis=0, weights=area[some] + 1e-300) for some in members]
    region, fits = np.full(count, -1), list[tuple[Floats, Floats, float] | None]()
    points = [corners[some].reshape(-1, 3) for some in members]
    missed = 0
    for seed in np.argsort(-size).tolist():
        if region[seed] >= 0 or len(near[seed]) < 2 or missed > MOST_MISSED:
            continue
        found = None
        for other in sorted(near[seed], key=lambda k: -size[k])[:2]:
            found = found or _cylinder(seed, other, points, middle, near, region)
        if found is None:
            missed += 1
            continue
        some, fit = found
        region[some] = len(fits)
        fits.append(fit)
    left = np.flatnonzero(region < 0)
    rest = [k for k in left.tolist() if any(region[j] < 0 for j in near[k])]
    usual = float(np.median(size[rest])) if rest else 0.0
    bent = np.isin(np.arange(count), [k for k in rest if size[k] < MUCH * usual])
    for k in left[~bent[left]].tolist():
        region[k] = len(fits)
        normal = middle[k] / np.linalg.norm(middle[k])
        level = float(np.ptp(points[k] @ normal)) < 2.0 * ROUGH_MM
        fits.append((points[k].mean(axis=0), normal, 0.0) if level else None)
    both = smooth & bent[patch[a]] & bent[patch[b]]
    group = _components(count, np.column_stack([patch[a[both]], patch[b[both]]]))
    for g in np.unique(group[bent]):
        region[bent & (group == g)] = len(fits)
        fits.append(None)
    return region[patch], fits


def _cylinder(
    seed: int, other: int, points: list[Floats], middle: list[Floats], near: list[set[int]], taken: Ints
) -> tuple[list[int], tuple[Floats, Floats, float]] | None:
    """Return the patches around two that lie on one cylinder, and that: a point, its axis and its radius.

    None for fewer than four.
    """
    along = np.cross(middle[seed], middle[other])
    if np.linalg.norm(along) < 1e-6:
        return None
    some, fit = [seed, other], None
    for rough, steps in ((5.0 * ROUGH_MM, 0), (ROUGH_MM, 30), (ROUGH_MM, 30)):
        fit = _fitted(np.concatenate([points[k] for k in some]), along / np.linalg.norm(along), steps)
        if fit is None:
            return None
        origin, along, radius = fit
        some, asked = [], [seed]
        known = {seed}
        while asked:
            k = asked.pop()
            v = points[k] - origin
            away = np.linalg.norm(v - np.outer(v @ along, along), axis=1)
            if np.abs(away - radius).max() < rough:
                some.append(k)
                fresh = [j for j in near[k] if taken[j] < 0 and j not in known]
                known.update(fresh)
                asked += fresh
        if len(some) < 4:
            return None
    v = points[seed].mean(axis=0) - origin
    inward = float((v - (v @ along) * along) @ middle[seed]) < 0.0
    return some, (origin, along, -radius if inward else radius)


def _fitted(points: Floats, along: Floats, steps: int) -> tuple[Floats, Floats, float] | None:
    """Return the cylinder through points (N,3).

    A point, its axis and its radius, by least squares in so many steps from a rough axis.
    """
    x = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    x /= np.linalg.norm(x)
    y, middle = np.cross(along, x), points.mean(axis=0)
    v = points - middle
    u, w = v @ x, v @ y
    (a, b, c), *_ = np.linalg.lstsq(np.column_stack([u, w, np.ones(len(u))]), u**2 + w**2, rcond=None)
    q = np.array([0.5 * a, 0.5 * b, 0.0, 0.0, math.sqrt(max(1e-12, c + 0.25 * (a * a + b * b)))])

    def off(q: Floats) -> Floats:
        axis = along + q[2] * x + q[3] * y
        axis = axis / np.linalg.norm(axis)
        d = v - q[0] * x - q[1] * y
        return np.asarray(np.linalg.norm(d - np.outer(d @ axis, axis), axis=1) - q[4])

    if steps:
        q = least_squares(off, q, method="trf", x_scale=[1.0, 1.0, 1e-3, 1e-3, 1.0], max_nfev=steps).x
    axis = along + q[2] * x + q[3] * y
    if not q[4] < LARGEST_RADIUS_MM:
        return None
    return middle + q[0] * x + q[1] * y, axis / np.linalg.norm(axis), float(q[4])


def _components(count: int, links: Ints) -> Ints:
    graph = coo_matrix((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


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
