"""The part as the search and the fit use it: ray caster, surface samples, resting directions and sharp edges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, cKDTree

from weldcal.models.mesh import TriMesh

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SAMPLES = 30_000
EDGE_STEP_M = 0.003  # between points of an edge: three points of a scan with 1 mm between them
SHARP_COS = math.cos(math.radians(35.0))
MOST_DIRECTIONS = 14
BENEATH_M = 2e-5  # start of a ray into the part: a float32 rounds by 1e-6 m at 10 m, so the ray misses its own face
LEAST_SHEET_M = 1e-4  # a shorter ray ends at the face of another body that overlaps by a drawing's tolerance
SMOOTHED, SMOOTHED_M, SMOOTHED_COS = 32, 0.010, (math.cos(math.radians(40.0)), math.cos(math.radians(20.0)))


@dataclass(frozen=True, eq=False)
class SharpEdges:
    """Samples of the convex edges, one row for each face beside an edge: m and unit vectors.

    ``point`` (N,3), tangent (N,3), normal (N,3) of the face, outward (N,3) in the face and away from it, other (N,3)
    the normal of the face beyond the edge, chain (N,) the number of the straight edge.
    """

    point: Floats
    tangent: Floats
    normal: Floats
    outward: Floats
    other: Floats
    chain: npt.NDArray[np.int64]


class PartModel:
    """A mesh in frame P, m, prepared for registration."""

    def __init__(self, mesh: TriMesh, seed: int = 0) -> None:
        self.mesh = mesh
        self.points, self.normals = mesh.sample(SAMPLES, np.random.default_rng(seed))
        corners, area = mesh.vertices[mesh.triangles], np.linalg.norm(mesh.area_vectors, axis=1)
        self.gravity = np.average(corners.mean(axis=1), axis=0, weights=area)
        self.center = 0.5 * mesh.bounds.sum(axis=0)
        self.radius = float(np.linalg.norm(mesh.vertices - self.center, axis=1).max())

    def closest(self, p: Floats) -> tuple[Floats, Floats]:
        """The nearest surface points (N,3) to points (N,3), and the normals (N,3) there."""
        found = self.mesh.scene.compute_closest_points(p.astype(np.float32))
        return (
            found["points"].numpy().astype(np.float64),
            self.smooth_normals[found["primitive_ids"].numpy().astype(np.int64)],
        )

    @cached_property
    def smooth_normals(self) -> Floats:
        """(M,3) unit normals of the triangles, averaged over near ones of nearly the same direction.

        The small triangles of a mesh from a scan are tilted by its noise. Taken as they are, they would keep a flat
        face from sliding along itself.
        """
        tree = cKDTree(self.mesh.vertices[self.mesh.triangles].mean(axis=1))
        away, k = tree.query(tree.data, k=min(SMOOTHED, tree.n), distance_upper_bound=SMOOTHED_M)
        found = np.isfinite(away)
        k = np.where(found, k, 0)
        vector, normals = self.mesh.area_vectors, self.mesh.normals
        for cosine in SMOOTHED_COS:
            same = found & (np.einsum("ijk,ik->ij", normals[k], normals) > cosine)
            total = np.einsum("ij,ijk->ik", same, vector[k])
            size = np.linalg.norm(total, axis=1, keepdims=True)
            normals = np.where(size > 0.0, total / np.maximum(size, 1e-30), normals)
        return np.asarray(normals)

    def ranges(self, eye: Floats, directions: Floats) -> tuple[Floats, Floats]:
        """Cast rays from eyes (3,) or (N,3) along directions (N,3): distances (N,), inf for a miss, normals (N,3)."""
        rays = np.hstack([np.broadcast_to(eye, directions.shape), directions]).astype(np.float32)
        hit = self.mesh.scene.cast_rays(rays)
        index = hit["primitive_ids"].numpy().astype(np.int64)
        index[index >= len(self.mesh.triangles)] = 0
        return hit["t_hit"].numpy().astype(np.float64), self.mesh.normals[index]

    @cached_property
    def thickness_m(self) -> float:
        """Thickness under the thinnest fifth of the surface. A ray ends where two bodies touch."""
        p, n = self.points[::20], self.normals[::20]
        through = BENEATH_M + self.ranges(p - BENEATH_M * n, -n)[0]
        through = through[np.isfinite(through) & (through > LEAST_SHEET_M)]
        return float(np.percentile(through, 20)) if len(through) else 0.1

    @cached_property
    def directions(self) -> list[Floats]:
        """Directions (3,) of P that may point up.

        The part rests on a face of its hull, or a large flat face lies up.
        """
        found: list[tuple[float, Floats]] = []
        hull = ConvexHull(self.mesh.vertices)
        corners = self.mesh.vertices[hull.simplices]
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        gravity = self.gravity
        for normal, size in _grouped(hull.equations[:, :3], area):
            face = corners[hull.equations[:, :3] @ normal > 0.999].reshape(-1, 3)
            if size < 0.01 * area.sum() or not _above(face, normal, gravity):
                continue
            found.append((size, -normal))
        size = np.linalg.norm(self.mesh.area_vectors, axis=1)
        found += [(0.5 * a, n) for n, a in _grouped(self.mesh.normals, size) if a > 0.06 * size.sum()]
        found.sort(key=lambda f: -f[0])
        kept: list[Floats] = []
        for _, d in found:
            if len(kept) < MOST_DIRECTIONS and not any(d @ k > math.cos(math.radians(6.0)) for k in kept):
                kept.append(d)
        # A part without a flat side may lie in any way; its frame's axes are as good as others.
        return kept or [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]

    @cached_property
    def edges(self) -> SharpEdges:
        """The convex sharp edges."""
        t, n = self.mesh.triangles, self.mesh.normals
        _, key = np.unique(np.round(self.mesh.vertices / 1e-7).astype(np.int64), axis=0, return_inverse=True)
        key = key.ravel()
        pair = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
        face = np.tile(np.arange(len(t)), 3)
        third = np.concatenate([t[:, 2], t[:, 0], t[:, 1]])
        name = np.sort(key[pair], axis=1) @ np.array([len(key), 1])
        order = np.argsort(name, kind="stable")
        same = np.flatnonzero(name[order][1:] == name[order][:-1])
        i, j = order[same], order[same + 1]
        p0, p1 = self.mesh.vertices[pair[i, 0]], self.mesh.vertices[pair[i, 1]]
        na, nb = n[face[i]], n[face[j]]
        # Convex: the other triangle's far corner lies below this triangle's plane.
        below = np.sum((self.mesh.vertices[third[j]] - p0) * na, axis=1)
        length = np.linalg.norm(p1 - p0, axis=1)
        keep = (np.sum(na * nb, axis=1) < SHARP_COS) & (below < -1e-7) & (length > 1e-6)
        rows = []
        for k in np.flatnonzero(keep):
            count = max(1, round(float(length[k]) / EDGE_STEP_M))
            s = (np.arange(count) + 0.5) / count
            at = p0[k] + s[:, None] * (p1[k] - p0[k])
            tangent = (p1[k] - p0[k]) / length[k]
            for mine, beyond in ((na[k], nb[k]), (nb[k], na[k])):
                out = beyond - (beyond @ mine) * mine
                out -= (out @ tangent) * tangent
                if (size := float(np.linalg.norm(out))) > 1e-6:
                    one = np.concatenate([tangent, mine, out / size, beyond, [float(k)]])
                    rows.append(np.hstack([at, np.broadcast_to(one, (count, 13))]))
        all_rows = np.concatenate(rows) if rows else np.zeros((0, 16))
        point, tangent, normal, outward, other = np.split(all_rows[:, :15], 5, axis=1)
        return SharpEdges(point, tangent, normal, outward, other, all_rows[:, 15].astype(np.int64))


def _grouped(normals: Floats, area: Floats) -> list[tuple[Floats, float]]:
    """Directions shared by the largest areas, with the areas, largest first."""
    rest, out = area.copy(), []
    for _ in range(24):
        k = int(np.argmax(rest))
        if rest[k] <= 0.0:
            break
        same = (normals @ normals[k] > math.cos(math.radians(4.0))) & (rest > 0.0)
        out.append((np.asarray(normals[k]), float(rest[same].sum())))
        rest[same] = 0.0
    return sorted(out, key=lambda o: -o[1])


def _above(face: Floats, normal: Floats, point: Floats) -> bool:
    """Whether a point lies above the polygon of a hull face's corners (N,3): the part can rest on it."""
    x = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    x /= np.linalg.norm(x)
    flat = np.column_stack([face @ x, face @ np.cross(normal, x)])
    at = np.array([point @ x, point @ np.cross(normal, x)])
    try:
        outline = ConvexHull(flat)
    except Exception:
        return False
    return bool((outline.equations[:, :2] @ at + outline.equations[:, 2] < 0.0).all())
