"""Reads a part from a STEP file through OpenCascade: its unit, a fine mesh and its exact edges."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError
from weldcal.models.files import file_size, read_bytes
from weldcal.models.mesh import TriMesh, merge
from weldcal.models.workpieces.shape import UNITS_M, PartEdge, PartShape

Floats = npt.NDArray[np.float64]

LARGEST_STEP = 512 * 1024**2
CHORD_MM, FACET_RAD = 0.02, 0.05  # largest distance and angle between the mesh and the surface
EDGE_SPACING_MM = 0.5
SMOOTH_RAD = math.radians(2.0)
_MERGED_M = 1e-7
_STRINGS, _HELD, _NAMED = re.compile(rb"'(?:[^']|'')*'"), re.compile(rb"#(\d+)\s*="), re.compile(rb"#(\d+)")
_UNIT_NAMES = {"MILLIMETRE": "mm", "MILLIMETER": "mm", "METRE": "m", "METER": "m", "INCH": "inch"}


def read_step(path: Path, units: str | None = None) -> PartShape:
    """Read the solids of a STEP file.

    Raises:
        InputError: no OpenCascade, not a STEP file, no solid in it, or another unit than `units`.
    """
    file_size(path, LARGEST_STEP)
    _check_text(path)
    shape, unit = _transferred(path)
    if units is not None and unit is not None and unit != units:
        raise InputError(f"'{path.name}' is in {unit}, not in {units}: give units {unit}.")
    mesh, bodies = _mesh(shape, path)
    from weldcal.models.workpieces.joints import with_joints

    edges, joints = with_joints(_edges(shape), shape)
    return PartShape(path.name, mesh, edges, UNITS_M[unit or units or "mm"], bodies, joints)


def _check_text(path: Path) -> None:
    """Check what OpenCascade takes for granted: a whole file, and no reference to an entity that is not there.

    Raises:
        InputError: it is not a STEP file, is cut off or refers to what it does not hold.
    """
    content = read_bytes(path, LARGEST_STEP)
    if b"ISO-10303-21" not in content[:4096]:
        raise InputError(f"'{path.name}' is not a STEP file: it does not begin with ISO-10303-21.")
    if b"END-ISO-10303-21" not in content[-4096:]:
        raise InputError(f"'{path.name}' is cut off: it does not end with END-ISO-10303-21; export or copy it again.")
    plain = _STRINGS.sub(b"''", content)
    held = set(_HELD.findall(plain))
    missing = set(_NAMED.findall(plain)) - held
    if not held:
        raise InputError(f"'{path.name}' is a STEP file without any shape: export the part again.")
    if missing:
        first = min(map(int, missing))
        raise InputError(
            f"'{path.name}' is damaged: it refers to #{first}, which it does not hold; export or copy it again."
        )


def _transferred(path: Path) -> tuple[Any, str | None]:
    """The TopoDS_Shape in millimetres and the file's length unit (None where it is another than mm, m, inch)."""
    try:
        from OCP.collections import Sequence_TCollection_AsciiString
        from OCP.IFSelect import IFSelect_ReturnStatus
        from OCP.Message import Message
        from OCP.STEPControl import STEPControl_Reader
    except ImportError:
        raise InputError("Reading STEP needs OpenCascade: type pip install 'weldcal[parts]', or give an STL.") from None
    messenger = Message.DefaultMessenger_s()
    for printer in list(messenger.Printers()):
        messenger.RemovePrinter(printer)  # it would write its statistics to stdout
    reader = STEPControl_Reader()
    try:
        if reader.ReadFile(str(path)) != IFSelect_ReturnStatus.IFSelect_RetDone:
            raise InputError(f"'{path.name}' cannot be read as STEP: it is cut off or malformed; export it again.")
        lengths, angles, solids = (Sequence_TCollection_AsciiString() for _ in range(3))
        reader.FileUnits(lengths, angles, solids)
        names = {lengths.Value(k + 1).ToCString().upper() for k in range(lengths.Length())}
        reader.SetSystemLengthUnit(1.0)
        reader.TransferRoots()
        shape = reader.OneShape()
    except InputError:
        raise
    except Exception as error:  # OpenCascade raises several types
        raise InputError(f"'{path.name}' cannot be read as STEP: {_first_line(error)}.") from error
    if shape is None or shape.IsNull():
        raise InputError(f"'{path.name}' holds no shape that can be read: export it again as STEP AP214 or AP242.")
    known = {_UNIT_NAMES[name] for name in names if name in _UNIT_NAMES}
    if len(known) > 1:
        raise InputError(f"'{path.name}' mixes the units {', '.join(sorted(known))}: export it in one unit.")
    return shape, next(iter(known), None)


def _mesh(shape: Any, path: Path) -> tuple[TriMesh, int]:
    """The fine mesh of all solids, m, and their number."""
    from OCP.BRep import BRep_Tool
    from OCP.BRepMesh import BRepMesh_IncrementalMesh
    from OCP.TopAbs import TopAbs_Orientation, TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopoDS import TopoDS

    explorer = TopExp_Explorer(shape, TopAbs_ShapeEnum.TopAbs_SOLID)
    bodies = 0
    while explorer.More():
        bodies += 1
        explorer.Next()
    if not bodies:
        raise InputError(
            f"'{path.name}' holds no solid (only surfaces or lines): close it to a solid and export it again."
        )
    BRepMesh_IncrementalMesh(shape, CHORD_MM, False, FACET_RAD, False)
    pieces = []
    explorer = TopExp_Explorer(shape, TopAbs_ShapeEnum.TopAbs_FACE)
    while explorer.More():
        face, location = TopoDS.Face(explorer.Current()), TopLoc_Location()
        explorer.Next()
        triangulation = BRep_Tool.Triangulation_s(face, location)
        if triangulation is None:
            continue
        placed = location.Transformation()
        nodes = (triangulation.Node(k + 1).Transformed(placed) for k in range(triangulation.NbNodes()))
        points = np.array([(p.X(), p.Y(), p.Z()) for p in nodes])
        triangles = np.array([triangulation.Triangle(k + 1).Get() for k in range(triangulation.NbTriangles())]) - 1
        if face.Orientation() == TopAbs_Orientation.TopAbs_REVERSED:
            triangles = triangles[:, ::-1]
        pieces.append(TriMesh(1e-3 * points, triangles))
    if not pieces:
        raise InputError(f"The surfaces of '{path.name}' cannot be meshed: repair the part and export it again.")
    return merge(*pieces, tolerance_m=_MERGED_M), bodies


def _edges(shape: Any) -> tuple[PartEdge, ...]:
    """Every edge of the shape, numbered in the file's order; edges within one smooth face are left out."""
    from OCP.BRep import BRep_Tool
    from OCP.collections import (
        IndexedDataMap_TopoDS_Shape_List_TopoDS_Shape_TopTools_ShapeMapHasher as EdgeFaces,
    )
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp
    from OCP.TopoDS import TopoDS

    faces_of = EdgeFaces()
    TopExp.MapShapesAndAncestors_s(shape, TopAbs_ShapeEnum.TopAbs_EDGE, TopAbs_ShapeEnum.TopAbs_FACE, faces_of)
    found: list[PartEdge] = []
    for k in range(faces_of.Extent()):
        edge = TopoDS.Edge(faces_of.FindKey(k + 1))
        faces = [TopoDS.Face(face) for face in faces_of.FindFromIndex(k + 1)]
        unique = [f for i, f in enumerate(faces) if not any(f.IsSame(g) for g in faces[:i])]
        if BRep_Tool.Degenerated_s(edge) or (len(unique) == 1 and len(faces) > 1):
            continue
        points, radius = _sampled(edge)
        if len(points) < 2:
            continue
        kind, angle = ("boundary", math.nan) if len(unique) < 2 else _met(edge, unique[0], unique[1])
        found.append(PartEdge(len(found) + 1, kind, 1e-3 * points, angle, radius))
    return tuple(found)


def _sampled(edge: Any) -> tuple[Floats, float | None]:
    """Points (N,3) mm evenly along an edge, and the radius m of a circle or arc."""
    from OCP.BRepAdaptor import BRepAdaptor_Curve
    from OCP.GCPnts import GCPnts_AbscissaPoint, GCPnts_UniformAbscissa
    from OCP.GeomAbs import GeomAbs_CurveType

    curve = BRepAdaptor_Curve(edge)
    length = GCPnts_AbscissaPoint.Length_s(curve)
    if not math.isfinite(length) or length < 1e-6:
        return np.empty((0, 3)), None
    straight = curve.GetType() == GeomAbs_CurveType.GeomAbs_Line
    count = 2 if straight else max(9, math.ceil(length / EDGE_SPACING_MM) + 1)
    spread = GCPnts_UniformAbscissa(curve, count)
    at = [spread.Parameter(k + 1) for k in range(spread.NbPoints())] if spread.IsDone() else []
    if len(at) < 2:
        at = list(np.linspace(curve.FirstParameter(), curve.LastParameter(), count))
    points = np.array([(p.X(), p.Y(), p.Z()) for p in (curve.Value(u) for u in at)])
    circular = curve.GetType() == GeomAbs_CurveType.GeomAbs_Circle
    return points, 1e-3 * float(curve.Circle().Radius()) if circular else None


def _met(edge: Any, first: Any, second: Any) -> tuple[str, float]:
    """Kind of an edge between two faces, and the angle between these, rad."""
    from OCP.BRep import BRep_Tool
    from OCP.BRepAdaptor import BRepAdaptor_Curve
    from OCP.gp import gp_Pnt, gp_Vec
    from OCP.TopAbs import TopAbs_Orientation, TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    low, high = BRep_Tool.Range_s(edge)
    middle = 0.5 * (low + high)
    point, along = gp_Pnt(), gp_Vec()
    BRepAdaptor_Curve(edge).D1(middle, point, along)
    tangent = np.array([along.X(), along.Y(), along.Z()])
    # The orientation of the edge as it stands in the first face: the face lies to its left.
    explorer = TopExp_Explorer(first, TopAbs_ShapeEnum.TopAbs_EDGE)
    while explorer.More():
        if explorer.Current().IsSame(edge):
            if TopoDS.Edge(explorer.Current()).Orientation() == TopAbs_Orientation.TopAbs_REVERSED:
                tangent = -tangent
            break
        explorer.Next()
    n_1, n_2 = _normal(edge, first, middle), _normal(edge, second, middle)
    turn = math.acos(float(np.clip(n_1 @ n_2, -1.0, 1.0)))
    if turn < SMOOTH_RAD:
        return "smooth", math.pi
    inward = np.cross(n_1, tangent)
    return ("concave" if n_2 @ inward > 0.0 else "convex"), math.pi - turn


def _normal(edge: Any, face: Any, at: float) -> Floats:
    """Outward unit normal (3,) of a face at the parameter of one of its edges."""
    from OCP.BRep import BRep_Tool
    from OCP.BRepAdaptor import BRepAdaptor_Surface
    from OCP.gp import gp_Pnt, gp_Vec
    from OCP.TopAbs import TopAbs_Orientation

    u_v = BRep_Tool.CurveOnSurface_s(edge, face, 0.0, 0.0).Value(at)
    point, by_u, by_v = gp_Pnt(), gp_Vec(), gp_Vec()
    BRepAdaptor_Surface(face).D1(u_v.X(), u_v.Y(), point, by_u, by_v)
    n = np.cross([by_u.X(), by_u.Y(), by_u.Z()], [by_v.X(), by_v.Y(), by_v.Z()])
    n = n / max(float(np.linalg.norm(n)), 1e-300)
    return np.asarray(-n if face.Orientation() == TopAbs_Orientation.TopAbs_REVERSED else n)


def _first_line(error: Exception) -> str:
    text = re.sub(r"\s+", " ", str(error)).strip()
    return text[:120] or type(error).__name__
