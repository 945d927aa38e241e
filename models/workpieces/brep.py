"""Faces and solids, OpenCascade's own or regions of a closed mesh: normals, nearest points and what is inside.

Lengths in mm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from OCP.Bnd import Bnd_Box
from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.BRepBndLib import BRepBndLib
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge
from OCP.BRepClass3d import BRepClass3d_SolidClassifier
from OCP.collections import HArray1_gp_Pnt
from OCP.collections import IndexedDataMap_TopoDS_Shape_List_TopoDS_Shape_TopTools_ShapeMapHasher as EdgeFaces
from OCP.collections import IndexedMap_TopoDS_Shape_TopTools_ShapeMapHasher as Shapes
from OCP.ElCLib import ElCLib
from OCP.GC import GC_MakeCircle
from OCP.Geom import Geom_CylindricalSurface, Geom_Line, Geom_Plane
from OCP.GeomAbs import GeomAbs_CurveType, GeomAbs_SurfaceType
from OCP.GeomAdaptor import GeomAdaptor_Surface
from OCP.GeomAPI import GeomAPI_Interpolate
from OCP.GeomConvert import GeomConvert_SurfToAnaSurf
from OCP.GeomLProp import GeomLProp_SLProps
from OCP.gp import gp_Ax3, gp_Dir, gp_Lin, gp_Pnt, gp_Vec
from OCP.IntCurvesFace import IntCurvesFace_ShapeIntersector
from OCP.IntTools import IntTools_FClass2d
from OCP.ShapeAnalysis import ShapeAnalysis_Surface
from OCP.TopAbs import TopAbs_Orientation, TopAbs_ShapeEnum, TopAbs_State
from OCP.TopExp import TopExp, TopExp_Explorer
from OCP.TopoDS import TopoDS

Floats = npt.NDArray[np.float64]
EXACT_MM = 1e-4  # between curves of OpenCascade
ROUGH_MM = 0.005  # between the corners of a mesh and the line, circle, plane or cylinder that they lie on
BRIDGED_MM = 1.0  # clearance beside a tab, along a straight line
IN_MM = 0.4  # a point is taken inside a body or a face this far from its edge
CHORDS, NEWTON = 64, 6  # of a bent edge; steps from the nearest chord to the nearest point
RAYS = np.array([(0.5257, 0.3411, 0.7793), (-0.2113, 0.8271, -0.5208)])  # along no direction that parts are drawn in


class SolidFace:
    """A face with its surface, box and normal."""

    def __init__(self, face: Any) -> None:
        self.face = face
        drawn = BRep_Tool.Surface_s(face)
        own = GeomAdaptor_Surface(drawn)
        spline = own.GetType() == GeomAbs_SurfaceType.GeomAbs_BSplineSurface
        # Some programs write planes and cylinders as splines: those cross each other slowly and in many pieces.
        exact = GeomConvert_SurfToAnaSurf(drawn).ConvertToAnalytical(EXACT_MM) if spline else None
        self.surface = drawn if exact is None else exact
        self.low, self.high = _box(face)
        self.sign = -1.0 if face.Orientation() == TopAbs_Orientation.TopAbs_REVERSED else 1.0
        self.by_point = ShapeAnalysis_Surface(self.surface)
        self._by_border = self.by_point if exact is None else ShapeAnalysis_Surface(drawn)
        adaptor = GeomAdaptor_Surface(self.surface)
        self.round = adaptor.GetType() == GeomAbs_SurfaceType.GeomAbs_Cylinder
        self.flat = adaptor.GetType() == GeomAbs_SurfaceType.GeomAbs_Plane
        self.axis: Any = adaptor.Cylinder().Axis() if self.round else None
        self.along = array_of(adaptor.Plane().Axis().Direction()) if self.flat else None
        if exact is not None:
            uv = [
                0.5 * (own.FirstUParameter() + own.LastUParameter()),
                0.5 * (own.FirstVParameter() + own.LastVParameter()),
            ]
            n = GeomLProp_SLProps(drawn, *uv, 1, 1e-9).Normal()
            self.sign *= float(np.sign(self.sign * self.normal(array_of(drawn.Value(*uv))) @ array_of(n)))

    @cached_property
    def edges(self) -> list[Any]:
        """Its edges."""
        return [TopoDS.Edge(edge) for edge in parts_of(self.face, TopAbs_ShapeEnum.TopAbs_EDGE)]

    @cached_property
    def corners(self) -> list[Any]:
        """The ends of its edges."""
        return [
            BRep_Tool.Pnt_s(TopoDS.Vertex(v)) for e in self.edges for v in parts_of(e, TopAbs_ShapeEnum.TopAbs_VERTEX)
        ]

    @cached_property
    def ends(self) -> list[tuple[Any, tuple[Floats, Floats, Floats]]]:
        """The edges at which a flush face could go on: see `_end_of`."""
        return [(edge, end) for edge in self.edges if (end := _end_of(self, edge)) is not None]

    def normal(self, p: Floats) -> Floats:
        """Out of the material (3,), of the surface or its continuation at a point."""
        at = self.by_point.ValueOfUV(gp_Pnt(*p), EXACT_MM)
        n = GeomLProp_SLProps(self.surface, at.X(), at.Y(), 1, 1e-9).Normal()
        return self.sign * np.array([n.X(), n.Y(), n.Z()])

    @cached_property
    def _inside(self) -> Any:
        return IntTools_FClass2d(self.face, EXACT_MM)

    @cached_property
    def _border(self) -> tuple[list[Any], Floats, Floats, Floats, npt.NDArray[np.int64]]:
        """The curves of the edges; chords of them by their starts, (N,3) vectors, (N,2) parameters and curves."""
        curves = [BRepAdaptor_Curve(edge) for edge in self.edges if not BRep_Tool.Degenerated_s(edge)]
        starts, chords, parameters, of = [], [], [], []
        for k, curve in enumerate(curves):
            straight = curve.GetType() == GeomAbs_CurveType.GeomAbs_Line
            at = np.linspace(curve.FirstParameter(), curve.LastParameter(), 2 if straight else CHORDS + 1)
            points = np.array([array_of(curve.Value(t)) for t in at])
            starts.append(points[:-1])
            chords.append(np.diff(points, axis=0))
            parameters.append(np.stack([at[:-1], at[1:]], axis=1))
            of.append(np.full(len(at) - 1, k))
        return curves, np.vstack(starts), np.vstack(chords), np.vstack(parameters), np.concatenate(of)

    def _over(self, p: Floats) -> Floats | None:
        """Return the point of the surface that is nearest to a point; None where the face does not reach."""
        at = self._by_border.ValueOfUV(gp_Pnt(*p), EXACT_MM)
        if self._inside.Perform(at) in (TopAbs_State.TopAbs_IN, TopAbs_State.TopAbs_ON):
            return array_of(self._by_border.Value(at.X(), at.Y()))
        return None

    def foot(self, p: Floats) -> Floats:
        """Return the point of the face that is nearest to a point.

        Of a bent face one at which the distance is least in its vicinity.
        """
        if (over := self._over(p)) is not None:
            return over
        curves, starts, chords, parameters, of = self._border
        share = np.clip(np.vecdot(p - starts, chords) / np.vecdot(chords, chords), 0.0, 1.0)
        nearest = int(np.argmin(np.linalg.norm(starts + share[:, None] * chords - p, axis=1)))
        curve, (low, high) = curves[of[nearest]], parameters[nearest]
        t = low + share[nearest] * (high - low)
        if curve.GetType() == GeomAbs_CurveType.GeomAbs_Line:
            return np.asarray(starts[nearest] + share[nearest] * chords[nearest])
        point, along, bend = gp_Pnt(), gp_Vec(), gp_Vec()
        for _ in range(NEWTON):
            curve.D2(t, point, along, bend)
            away, d = array_of(point) - p, array_of(along)
            steep = max(float(d @ d + away @ array_of(bend)), 0.1 * float(d @ d))
            t = float(np.clip(t - away @ d / steep, curve.FirstParameter(), curve.LastParameter()))
        return array_of(curve.Value(t))


class Solid:
    """A solid with its faces and with what answers whether a point is inside."""

    def __init__(self, solid: Any) -> None:
        self.solid = solid
        self.faces = [SolidFace(TopoDS.Face(face)) for face in parts_of(solid, TopAbs_ShapeEnum.TopAbs_FACE)]
        self.low, self.high = _box(solid)
        self._classifier = BRepClass3d_SolidClassifier(solid)
        self._rays = IntCurvesFace_ShapeIntersector()
        self._rays.Load(solid, 1e-6)

    @cached_property
    def edges(self) -> list[tuple[Any, list[SolidFace]]]:
        """Its edges, each with the faces that meet there."""
        return faces_at(self.solid, self.faces)

    def holds(self, p: Floats) -> bool:
        """Return whether a point is inside."""
        if (p < self.low).any() or (p > self.high).any():
            return False
        hits = [self._hits(p, along) for along in RAYS]
        odd = [len(one) % 2 == 1 for one in hits]
        if odd[0] == odd[1]:  # else one ray crosses an edge, which may count twice or not at all
            return odd[0]
        self._classifier.Perform(gp_Pnt(*p), 1e-6)
        return bool(self._classifier.State() == TopAbs_State.TopAbs_IN)

    def _hits(self, p: Floats, along: Floats) -> list[float]:
        """Where a ray from a point crosses the skin, mm from the point."""
        try:
            self._rays.Perform(gp_Lin(gp_Pnt(*p), gp_Dir(*along)), 0.0, 1e5)
        except Exception:  # OpenCascade cannot compute a few rays beside a sphere
            return []
        return [self._rays.WParameter(k + 1) for k in range(self._rays.NbPnt())]

    def through(self, p: Floats, along: Floats) -> tuple[float, float]:
        """How far from a point in the material a ray leaves it the first time, at a hole for one, and the last time."""
        hits = [hit for hit in self._hits(p, along) if hit > 1e-3] or [0.0]
        return min(hits), max(hits)


class MeshFace(SolidFace):
    """A region of a closed mesh that is a plane or a cylinder; any other has no surface."""

    def __init__(self, triangles: Floats, fit: tuple[Floats, Floats, float] | None) -> None:
        """Take its triangles (M,3,3) with their normals out of the material, and its plane or cylinder.

        See `mesh_files.regions`.
        """
        self.triangles, self.fit = triangles, fit
        self.low, self.high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        self.edges: list[Any] = []  # the body adds them
        self.flat, self.round = fit is not None and fit[2] == 0.0, fit is not None and fit[2] != 0.0
        self.surface, self.axis, self.sign = None, None, 1.0
        if fit is not None:
            origin, along, radius = fit
            place = gp_Ax3(gp_Pnt(*origin), gp_Dir(*along))
            self.surface = Geom_CylindricalSurface(place, abs(radius)) if self.round else Geom_Plane(place)
            self.along = along if self.flat else None
            self.axis, self.sign = place.Axis() if self.round else None, -1.0 if radius < 0.0 else 1.0
            self.by_point = ShapeAnalysis_Surface(self.surface)
            x = array_of(place.XDirection())
            self._axes = np.stack([x, np.cross(along, x), along])
            self._local = (triangles - origin) @ self._axes.T

    def normal(self, p: Floats) -> Floats:
        """See Face; without a surface that of the nearest triangle."""
        if self.surface is not None:
            return super().normal(p)
        a, b, c = self.triangles[self._nearest(p)[1]]
        return unit(np.cross(b - a, c - a))

    def _over(self, p: Floats) -> Floats | None:
        if self.fit is None:
            return self._nearest(p)[0]
        origin, along, radius = self.fit
        v = self._axes @ (p - origin)
        if self.round:
            angle = math.atan2(v[1], v[0])
            turn = np.arctan2(self._local[..., 1], self._local[..., 0]) - angle
            flat = np.stack(
                [abs(radius) * (np.mod(turn + math.pi, 2.0 * math.pi) - math.pi), self._local[..., 2] - v[2]], axis=2
            )
            flat = flat[np.ptp(flat[..., 0], axis=1) < math.pi * abs(radius)]  # not around the far side
            found = origin + self._axes.T @ (abs(radius) * math.cos(angle), abs(radius) * math.sin(angle), v[2])
        else:
            flat, found = self._local[..., :2] - v[:2], p - v[2] * along
        d = np.roll(flat, -1, axis=1) - flat
        beside = (flat[..., 0] * d[..., 1] - flat[..., 1] * d[..., 0]) / np.maximum(np.linalg.norm(d, axis=2), 1e-12)
        inside = (beside > -EXACT_MM).all(axis=1) | (beside < EXACT_MM).all(axis=1)
        return found if inside.any() else None

    def _nearest(self, p: Floats) -> tuple[Floats, int]:
        """Return the nearest point of the triangles, and the number of its triangle."""
        a, d = self.triangles - p, np.roll(self.triangles, -1, axis=1) - self.triangles
        n = np.cross(d[:, 0], d[:, 1])
        n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)
        foot = np.vecdot(a[:, 0], n)[:, None] * n
        inside = (np.vecdot(np.cross(d, foot[:, None] - a), n[:, None]) >= 0.0).all(axis=1)
        share = np.clip(-np.vecdot(a, d) / np.maximum(np.vecdot(d, d), 1e-300), 0.0, 1.0)
        rim = a + share[..., None] * d
        k = np.argmin(np.linalg.norm(rim, axis=2), axis=1)
        found = np.where(inside[:, None], foot, rim[np.arange(len(rim)), k])
        nearest = int(np.argmin(np.linalg.norm(found, axis=1)))
        return p + found[nearest], nearest


class MeshBody(Solid):
    """A closed shell of triangles (M,3,3), with its regions as faces and their borders as edges."""

    def __init__(self, triangles: Floats, faces: list[MeshFace], borders: list[tuple[Floats, list[int]]]) -> None:
        self.faces = list[SolidFace](faces)
        self.low, self.high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        self._triangles = triangles
        self.edges = [(_edge_along(line), [self.faces[k] for k in met]) for line, met in borders]
        for edge, met in self.edges:
            for face in met:
                face.edges.append(edge)

    def holds(self, p: Floats) -> bool:
        """Return whether a point is inside, by the solid angle of the shell (Van Oosterom and Strackee 1983)."""
        if (p < self.low).any() or (p > self.high).any():
            return False
        v = self._triangles - p
        a, b, c = v[:, 0], v[:, 1], v[:, 2]
        la, lb, lc = np.linalg.norm(v, axis=2).T
        up = np.vecdot(a, np.cross(b, c))
        down = la * lb * lc + np.vecdot(a, b) * lc + np.vecdot(b, c) * la + np.vecdot(c, a) * lb
        return abs(float(np.arctan2(up, down).sum())) > math.pi

    def _hits(self, p: Floats, along: Floats) -> list[float]:
        """See Body (Moeller and Trumbore 1997)."""
        t = self._triangles
        e, f = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
        h = np.cross(along, f)
        det = np.vecdot(e, h)
        inverse = 1.0 / np.where(np.abs(det) > 1e-12, det, np.inf)
        s = p - t[:, 0]
        q = np.cross(s, e)
        u, v = inverse * np.vecdot(s, h), inverse * (q @ along)
        hit = (det != 0.0) & (inverse != 0.0) & (u > -1e-9) & (v > -1e-9) & (u + v < 1.0 + 1e-9)
        return [far for far in (inverse * np.vecdot(f, q))[hit].tolist() if far > 0.0]


def _edge_along(line: Floats) -> Any:
    """Return the edge along a line (N,3): straight, a circle or a smooth curve through its points."""
    p, q = gp_Pnt(*line[0]), gp_Pnt(*line[-1])
    closed = len(line) > 3 and float(np.linalg.norm(line[0] - line[-1])) < EXACT_MM
    if not closed and (len(line) == 2 or _beside_chord(line) < ROUGH_MM):
        return BRepBuilderAPI_MakeEdge(p, q).Edge()
    line = line[np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > EXACT_MM])]
    if len(line) - closed < 3:
        return BRepBuilderAPI_MakeEdge(p, gp_Pnt(*line[1])).Edge()  # there and back
    k = len(line) // 3
    circle = GC_MakeCircle(p, gp_Pnt(*line[k]), gp_Pnt(*line[2 * k])) if len(line) > 4 else None
    if circle is not None and circle.IsDone():
        found = circle.Value().Circ()
        off = [found.Distance(gp_Pnt(*point)) for point in line]
        if max(off) < ROUGH_MM:
            begin, end = 0.0, 2.0 * math.pi
            if not closed:
                begin, end = ElCLib.Parameter_s(found, p), ElCLib.Parameter_s(found, q)
            return BRepBuilderAPI_MakeEdge(found, begin, end if end > begin else end + 2.0 * math.pi).Edge()
    points = HArray1_gp_Pnt(1, len(line) - closed)
    for k, point in enumerate(line[: len(line) - closed]):
        points.SetValue(k + 1, gp_Pnt(*point))
    curve = GeomAPI_Interpolate(points, closed, EXACT_MM)  # its corners lie on the true line, its chords beside it
    curve.Perform()
    return BRepBuilderAPI_MakeEdge(curve.Curve()).Edge()


def _beside_chord(line: Floats) -> float:
    """How far a line (N,3) goes from its chord."""
    along = unit(line[-1] - line[0])
    v = line - line[0]
    return float(np.linalg.norm(v - np.outer(v @ along, along), axis=1).max())


def of_opencascade(error: Exception) -> bool:
    """Return whether an exception is one of OpenCascade's, which have no other class in common."""
    return type(error).__module__.split(".")[0] == "OCP"


def called(names: Sequence[str], k: int) -> str:
    """Return the name of a body, or its number where the file has none."""
    return f"'{names[k]}'" if k < len(names) and names[k] else f"body {k + 1}"


def listed(words: Sequence[str], most: int = 4) -> str:
    """Return words as one phrase, the first few of many."""
    return ", ".join(words[:most]) + (f" and {len(words) - most} more" if len(words) > most else "")


def parts_of(shape: Any, kind: Any) -> list[Any]:
    """Return the parts of a shape of one kind, in the file's order."""
    explorer, found = TopExp_Explorer(shape, kind), []
    while explorer.More():
        found.append(explorer.Current())
        explorer.Next()
    return found


def faces_at(shape: Any, faces: list[SolidFace]) -> list[tuple[Any, list[SolidFace]]]:
    """The edges of a shape in the file's order, each with those of its faces that meet there; none within one face."""
    faces_of, found, known = EdgeFaces(), [], Shapes()
    at = {known.Add(face.face): face for face in faces}
    TopExp.MapShapesAndAncestors_s(shape, TopAbs_ShapeEnum.TopAbs_EDGE, TopAbs_ShapeEnum.TopAbs_FACE, faces_of)
    for k in range(faces_of.Extent()):
        edge, met = TopoDS.Edge(faces_of.FindKey(k + 1)), list(faces_of.FindFromIndex(k + 1))
        own = [at[k] for k in sorted({known.FindIndex(one) for one in met} - {0})]
        if not BRep_Tool.Degenerated_s(edge) and (len(own) > 1 or len(met) == 1):
            found.append((edge, own))
    return found


def middle_of(curve: Any, begin: float, end: float) -> tuple[Floats, Floats, float]:
    """Return the middle of a stretch of a curve, its direction there, and its length."""
    point, along = gp_Pnt(), gp_Vec()
    curve.D1(0.5 * (begin + end), point, along)
    return array_of(point), unit(array_of(along)), (end - begin) * along.Magnitude()


def sampled(curve: Any, begin: float, end: float) -> Floats:
    """Points (N,3) on a stretch of a curve, 0.5 mm apart on a bent one."""
    if isinstance(curve, Geom_Line) or (
        isinstance(curve, BRepAdaptor_Curve) and curve.GetType() == GeomAbs_CurveType.GeomAbs_Line
    ):
        return np.array([array_of(curve.Value(begin)), array_of(curve.Value(end))])
    steps = np.linspace(begin, end, 33)
    points = np.array([array_of(curve.Value(u)) for u in steps])
    length = length_of(points)
    if abs(length - float(np.linalg.norm(points[-1] - points[0]))) < EXACT_MM:
        return points[[0, -1]]
    return np.array([array_of(curve.Value(u)) for u in np.linspace(begin, end, max(9, math.ceil(2.0 * length) + 1))])


def _box(shape: Any) -> tuple[Floats, Floats]:
    box = Bnd_Box()
    BRepBndLib.AddOptimal_s(shape, box, False, False)
    return array_of(box.CornerMin()), array_of(box.CornerMax())


def length_of(line: Floats) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def array_of(p: Any) -> Floats:
    return np.array([p.X(), p.Y(), p.Z()])


def unit(v: Floats) -> Floats:
    return np.asarray(v / np.linalg.norm(v))


def _end_of(face: SolidFace, edge: Any) -> tuple[Floats, Floats, Floats] | None:
    """Return an edge's middle, the face's normal there, and the direction out of the face in its plane."""
    curve = BRepAdaptor_Curve(edge)
    straight = curve.GetType() == GeomAbs_CurveType.GeomAbs_Line
    if BRep_Tool.Degenerated_s(edge) or not (
        straight if face.flat else curve.GetType() == GeomAbs_CurveType.GeomAbs_Circle
    ):
        return None
    p, t, _ = middle_of(curve, curve.FirstParameter(), curve.LastParameter())
    n = face.normal(p)
    m = np.cross(t, n)
    inner = face.foot(p + IN_MM * m)
    return p, n, m if np.linalg.norm(inner - p - IN_MM * m) > 0.5 * IN_MM else -m
