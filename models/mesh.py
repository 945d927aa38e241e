"""Closed, outward-oriented triangle meshes for Drake: extrusions, revolutions and swept grids."""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from pydrake.common import MemoryFile
from pydrake.math import RigidTransform

from weldcal.models.errors import InputError

if TYPE_CHECKING:
    from pydrake.geometry import Mesh


_PLOTTING = ("plotly", "plotly.graph_objects", "dash")


class _Later:
    """Something of a package that is imported when it is used for the first time."""

    def __init__(self, module: str, name: str) -> None:
        self._of = module, name

    def _found(self) -> Any:
        module, name = self._of
        return getattr(importlib.import_module(module), name)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._found(), name)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self._found()(*arguments, **named)


class _Stub(ModuleType):
    """Take the place of a package while Open3D is imported."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Later(self.__name__, name)


@lru_cache(1)
def _imported() -> Any:
    stubs = {name: _Stub(name) for name in _PLOTTING if name not in sys.modules}
    sys.modules.update(stubs)
    try:
        return importlib.import_module("open3d")
    finally:
        for name in stubs:
            del sys.modules[name]


class _Open3D:
    """Import Open3D when a name of it is used for the first time: it takes 0.4 s."""

    def __getattr__(self, name: str) -> Any:
        return getattr(_imported(), name)


o3d: Any = _Open3D()


# pydrake.geometry and scipy.spatial are imported where they are used: they take half of the time in which a process
# starts that only asks for a robot's name.

# Open3D takes a neighbour of the nearest triangle where these are long and narrow: on a tube of 0.6 m by 0.5 mm, with
# edges of 50 mm by 0.04 mm at most.
_LONGEST_M = 0.05

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TriMesh:
    """Hold vertices (N,3) in metres and triangles (M,3) of vertex indices, counter-clockwise from outside."""

    vertices: Floats
    triangles: Ints

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64).reshape(-1, 3)
        triangles = np.ascontiguousarray(self.triangles, dtype=np.int64).reshape(-1, 3)
        if not np.isfinite(vertices).all():
            raise InputError("A mesh vertex is not a finite number: check the dimensions it was made from.")
        if triangles.size and (triangles.min() < 0 or triangles.max() >= len(vertices)):
            raise InputError("A mesh triangle names a vertex that does not exist: check the triangle indices.")
        vertices.setflags(write=False)
        triangles.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles)

    def __getstate__(self) -> dict[str, Any]:
        """Without the scenes, which cannot be sent to another process."""
        return {name: value for name, value in vars(self).items() if name not in ("scene", "_short")}

    @cached_property
    def area_vectors(self) -> Floats:
        """(M,3) outward normals whose lengths are the triangle areas, m^2."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        return np.asarray(0.5 * np.cross(b - a, c - a), dtype=np.float64)

    @cached_property
    def normals(self) -> Floats:
        """(M,3) outward unit normals of the triangles."""
        return np.asarray(
            self.area_vectors / np.maximum(np.linalg.norm(self.area_vectors, axis=1, keepdims=True), 1e-300)
        )

    @cached_property
    def scene(self) -> Any:
        """The mesh as Open3D's scene of rays and distances."""
        scene = o3d.t.geometry.RaycastingScene()
        vertices, triangles = self.vertices.astype(np.float32), self.triangles.astype(np.uint32)
        scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(triangles))
        return scene

    def split(self, longest_m: float) -> TriMesh:
        """The same surface with edges of at most ``longest_m``, which are halved; no corner is shared."""
        c, done = self.vertices[self.triangles], []
        while len(c):
            edges = np.linalg.norm(np.roll(c, -1, axis=1) - c, axis=2)
            long, k = edges.max(axis=1) > longest_m, edges.argmax(axis=1)
            done.append(c[~long])
            a, b, d = (c[long, (k[long] + j) % 3] for j in range(3))
            middle = 0.5 * (a + b)
            c = np.concatenate([np.stack([a, middle, d], axis=1), np.stack([middle, b, d], axis=1)])
        corners = np.concatenate(done).reshape(-1, 3)
        return TriMesh(corners, np.arange(len(corners)))

    @cached_property
    def _short(self) -> TriMesh:
        return self.split(_LONGEST_M)

    def distances(self, points: Floats, signed: bool = True) -> Floats:
        """Distances (N,) m of points (N,3) m from the surface; `signed`: negative inside where the mesh is closed."""
        query = o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, dtype=np.float32))
        found = np.asarray(self._short.scene.compute_distance(query).numpy(), dtype=np.float64)
        if not signed or not self.watertight():
            return found
        # the majority of three rays decides on which side a point lies: one may hit an edge
        return np.where(self.scene.compute_occupancy(query, nsamples=3).numpy() > 0.5, -found, found)

    @property
    def bounds(self) -> Floats:
        """(2,3) smallest and largest coordinates, m."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def area(self) -> float:
        """Surface area, m^2."""
        return float(np.linalg.norm(self.area_vectors, axis=1).sum())

    @property
    def volume(self) -> float:
        """Enclosed volume, m^3 (positive when the triangles face outward; meaningful for closed meshes)."""
        return float(np.einsum("ij,ij->", self.vertices[self.triangles].mean(axis=1), self.area_vectors) / 3.0)

    def transformed(self, X: RigidTransform) -> TriMesh:
        """The same mesh with its vertices expressed through X (a mesh in frame B becomes one in A for X = X_AB)."""
        return TriMesh(self.vertices @ X.rotation().matrix().T + X.translation(), self.triangles)

    def flipped(self) -> TriMesh:
        """Return the same surface with its normals reversed."""
        return TriMesh(self.vertices, self.triangles[:, ::-1])

    def sample(self, n: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """n points (n,3) spread evenly over the area, with the outward unit normals (n,3) they lie on."""
        area = np.linalg.norm(self.area_vectors, axis=1)
        face = rng.choice(len(area), size=n, p=area / area.sum())
        u, v = rng.random((2, n, 1))
        fold = u + v > 1.0
        u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
        a, b, c = (self.vertices[self.triangles[face, k]] for k in range(3))
        return a + u * (b - a) + v * (c - a), self.normals[face]

    def watertight(self) -> bool:
        """True when every directed edge is met by exactly one triangle on its other side (closed and well oriented)."""
        t = self.triangles
        if not len(t):
            return False
        edges = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
        n = len(self.vertices)
        forward = edges[:, 0] * n + edges[:, 1]
        backward = edges[:, 1] * n + edges[:, 0]
        unique = np.unique(forward)
        return len(unique) == len(forward) and np.array_equal(unique, np.unique(backward))

    def to_obj(self) -> str:
        """Wavefront OBJ text with one normal per face: flat, clean shading, and what Drake reads from memory."""
        v = "\n".join(f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in self.vertices.tolist())
        vn = "\n".join(f"vn {x:.6g} {y:.6g} {z:.6g}" for x, y, z in self.normals.tolist())
        faces = (self.triangles + 1).tolist()
        f = "\n".join(f"f {a}//{k} {b}//{k} {c}//{k}" for k, (a, b, c) in enumerate(faces, start=1))
        return f"{v}\n{vn}\n{f}\n"

    def to_drake(self, hint: str) -> Mesh:
        """Return the mesh as a Drake shape held in memory; `hint` names it in Drake's messages."""
        from pydrake.geometry import InMemoryMesh, Mesh

        return Mesh(InMemoryMesh(mesh_file=MemoryFile(self.to_obj(), ".obj", hint)))


def merge(*meshes: TriMesh, tolerance_m: float = 0.0) -> TriMesh:
    """One mesh of several; with a tolerance, vertices closer than it become one and empty triangles vanish."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    vertices = np.concatenate([m.vertices for m in meshes])
    triangles = np.concatenate([m.triangles + k for m, k in zip(meshes, offsets, strict=True)])
    if tolerance_m <= 0.0:
        return TriMesh(vertices, triangles)
    from scipy.spatial import cKDTree

    # Every vertex takes the lowest index within reach; two passes settle chains of equal points.
    pairs = cKDTree(vertices).query_pairs(tolerance_m, output_type="ndarray")
    owner = np.arange(len(vertices))
    for _ in range(2):
        np.minimum.at(owner, pairs[:, 1], owner[pairs[:, 0]])
    kept, new_index = np.unique(owner, return_inverse=True)
    triangles = new_index[triangles]
    a, b, c = triangles.T
    return TriMesh(vertices[kept], triangles[(a != b) & (b != c) & (c != a)])


def circle(radius_m: float, segments: int, center: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """(segments,2) points of a circle, counter-clockwise from angle 0; chord error radius * (1 - cos(pi/segments))."""
    angle = 2.0 * np.pi * np.arange(segments) / segments
    return np.stack([center[0] + radius_m * np.cos(angle), center[1] + radius_m * np.sin(angle)], axis=1)


def inside_loops(points: Floats, loops: list[Floats]) -> npt.NDArray[np.bool_]:
    """Which points (N,2) lie inside an odd number of the closed loops (k,2): inside a polygon and outside its holes."""
    inside = np.zeros(len(points), dtype=bool)
    x, y = points[:, 0][:, None], points[:, 1][:, None]
    for loop in loops:
        (x0, y0), (x1, y1) = loop.T, np.roll(loop, -1, axis=0).T
        crosses = (y0 > y) != (y1 > y)
        rise = np.where(y1 == y0, 1.0, y1 - y0)
        inside ^= np.count_nonzero(crosses & (x < x0 + (y - y0) / rise * (x1 - x0)), axis=1) % 2 == 1
    return inside


def triangulate_polygon(outline: Floats, holes: list[Floats] | None = None) -> Ints:
    """Triangles (M,3), counter-clockwise, over the stacked points [outline, *holes] of a polygon with holes.

    Delaunay triangles with centroids inside; no point is added, so neighbouring faces stay watertight. Raises
    InputError where a boundary edge is not in the triangulation: the outline must be sampled finer there.
    """
    loops = [np.asarray(part, dtype=np.float64) for part in (outline, *(holes or []))]
    return _triangulated(tuple(loop.tobytes() for loop in loops)).copy()


@lru_cache(maxsize=16)
def _triangulated(outlines: tuple[bytes, ...]) -> Ints:
    """`triangulate_polygon` of points as bytes: a cell makes the same flange and the same plate several times."""
    from scipy.spatial import Delaunay

    loops = [np.frombuffer(part).reshape(-1, 2) for part in outlines]
    points = np.concatenate(loops)
    scaled = (points - points.mean(axis=0)) / np.ptp(points, axis=0).max()
    triangles = Delaunay(scaled).simplices.astype(np.int64)
    a, b, c = (scaled[triangles[:, k]] for k in range(3))
    doubled = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    triangles[doubled < 0] = triangles[doubled < 0][:, ::-1]
    keep = (np.abs(doubled) > 1e-12) & inside_loops(points[triangles].mean(axis=1), loops)
    triangles = triangles[keep]

    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    present = set(map(tuple, np.sort(edges, axis=1).tolist()))
    start = 0
    for loop in loops:
        index = start + np.arange(len(loop))
        border = np.sort(np.stack([index, np.roll(index, -1)], axis=1), axis=1)
        if any(tuple(edge) not in present for edge in border.tolist()):
            raise InputError("A polygon edge is too long for its neighbours: sample the outline more finely.")
        start += len(loop)
    return np.asarray(triangles, dtype=np.int64)


def plane_mesh(points: Floats, triangles: Ints, z_m: float, up: bool) -> TriMesh:
    """Return a flat face (points (N,2)) at height z, facing +z when `up`, else -z."""
    return TriMesh(np.column_stack([points, np.full(len(points), z_m)]), triangles if up else triangles[:, ::-1])


def grid(points: Floats, *, close_rows: bool = False, close_columns: bool = False) -> TriMesh:
    """The surface through a grid of points (rows, columns, 3); its normal is (row direction) x (column direction)."""
    rows, columns = points.shape[:2]
    i = np.arange(rows if close_rows else rows - 1)[:, None]
    j = np.arange(columns if close_columns else columns - 1)[None, :]
    i1, j1 = (i + 1) % rows, (j + 1) % columns
    a, b, c, d = (np.ravel(row * columns + column) for row, column in ((i, j), (i1, j), (i1, j1), (i, j1)))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return TriMesh(points.reshape(-1, 3), triangles)


def extrude(outline: Floats, z_low_m: float, z_high_m: float, holes: list[Floats] | None = None) -> TriMesh:
    """A prism between two heights over a polygon (N,2) with through holes; loops in any direction; watertight."""
    loops = [_turned(outline, left=True), *[_turned(h, left=False) for h in holes or []]]
    triangles = triangulate_polygon(loops[0], loops[1:])
    points = np.concatenate(loops)
    caps = [plane_mesh(points, triangles, z_high_m, up=True), plane_mesh(points, triangles, z_low_m, up=False)]
    walls = [wall(loop, z_low_m, z_high_m) for loop in loops]
    return merge(*caps, *walls, tolerance_m=1e-9)


def wall(loop: Floats, z_low_m: float, z_high_m: float) -> TriMesh:
    """The upright wall over a closed loop (N,2), facing right of its travel: outward when the loop turns left."""
    low, high = (np.column_stack([loop, np.full(len(loop), z)]) for z in (z_low_m, z_high_m))
    return grid(np.stack([low, high], axis=1), close_rows=True)


def revolve(profile: Floats, segments: int) -> TriMesh:
    """The surface of a profile (N,2) of (radius, z) turned about z; material lies to the left of the profile's travel.

    A profile from axis to axis, or one that ends where it begins, gives a watertight mesh; points on the axis become
    one vertex.
    """
    profile = np.asarray(profile, dtype=np.float64)
    if (profile[:, 0] < 0.0).any():
        raise InputError("A profile to be revolved has a negative radius: give radii of zero or more.")
    unit = circle(1.0, segments)
    ring = profile[:, None, :1] * unit[None]
    points = np.concatenate([ring, np.broadcast_to(profile[:, None, 1:], (*ring.shape[:2], 1))], axis=2)
    surface = grid(np.swapaxes(points, 0, 1), close_rows=True)
    return merge(surface, tolerance_m=1e-9)


def _turned(loop: Floats, *, left: bool) -> Floats:
    x, y = np.asarray(loop, dtype=np.float64).T
    area = np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    return np.asarray(loop if (area > 0) == left else loop[::-1], dtype=np.float64)
