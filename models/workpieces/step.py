"""Reads a part from a STEP file through OpenCascade: its unit, a fine mesh and its exact edges."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError
from weldcal.models.files import file_size, read_bytes
from weldcal.models.mesh import TriMesh, merge
from weldcal.models.workpieces.shape import UNITS_M, PartEdge, PartJoint, PartShape

if TYPE_CHECKING:
    from weldcal.models.workpieces.brep import Solid, SolidFace
    from weldcal.models.workpieces.joints import Piece

Floats = npt.NDArray[np.float64]

LARGEST_STEP = 512 * 1024**2
CHORD_MM, FACET_RAD = 0.02, 0.05  # largest distance and angle between the mesh and the surface
LEAST_EDGE_MM = 1e-6
SEWN_MM = 0.1  # between surfaces that are sewn: below the gap that a weld notices
SMOOTH_RAD = math.radians(2.0)
_ON_M = 5e-5  # how far a line's middle may lie from the edge that it is: a choice, above the error of an edge's chords
_MERGED_M = 1e-7
_EXTERNAL = re.compile(
    rb"DOCUMENT_FILE\s*\(\s*'([^']*\.st(?:e?p))'", re.IGNORECASE
)  # ISO 10303-44: parts in files of their own
_STRINGS, _HELD, _NAMED = re.compile(rb"'(?:[^']|'')*'"), re.compile(rb"#(\d+)\s*="), re.compile(rb"#(\d+)")
_UNNAMED = "Open CASCADE STEP translator"  # its name for a body without one
_UNIT_NAMES = {"MILLIMETRE": "mm", "MILLIMETER": "mm", "METRE": "m", "METER": "m", "INCH": "inch"}


def read_step(path: Path, units: str | None = None) -> PartShape:
    """Read the solids of a STEP file.

    Raises:
        InputError: no OpenCascade, not a STEP file, no solid in it, or another unit than `units`.
    """
    file_size(path, LARGEST_STEP)
    for file in (path, *referenced(path)):
        _check_text(file)
    shape, unit, names = _transferred(path)
    from weldcal.models.workpieces.joints import joints_between

    if units is not None and unit is not None and unit != units:
        raise InputError(f"'{path.name}' is in {unit}, not in {units}: give units {unit}.")
    notes = list[str]()
    shape, bodies, names = _sound(_closed(shape, path, notes), names, path, notes)
    mesh = _mesh(shape, path)
    edges, joints = with_joints(_edges(shape), joints_between(bodies, notes, names), names)
    return PartShape(
        name=path.name,
        mesh=mesh,
        edges=edges,
        unit_m=UNITS_M[unit or units or "mm"],
        bodies=len(bodies),
        joints=joints,
        notes=tuple(notes),
    )


def referenced(path: Path) -> list[Path]:
    """Return the STEP files beside a part's file from which it takes bodies, by its own and their external references.

    Raises:
        InputError: one of them is not there.
    """
    found, asked = list[Path](), [path]
    while asked:
        one = asked.pop()
        if one.suffix.lower() not in (".step", ".stp"):
            continue
        for name in _EXTERNAL.findall(read_bytes(one, LARGEST_STEP)):
            other = path.parent / Path(name.decode(errors="replace").replace("\\", "/")).name
            if not other.is_file():
                raise InputError(
                    f"'{one.name}' takes a body from '{other.name}': put that file beside it, or export the assembly as"
                    " one file."
                )
            if other not in (path, *found):
                found.append(other)
                asked.append(other)
    return found


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


def _transferred(path: Path) -> tuple[Any, str | None, list[str]]:
    """Return the TopoDS_Shape in millimetres, the file's length unit and the names of its solids.

    The unit is None where it is another than mm, m, inch.
    """
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
        shape = _assembled(path) if referenced(path) else None
        if shape is None:
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
    return shape, next(iter(known), None), _names(reader, shape)


def _names(reader: Any, shape: Any) -> list[str]:
    """Return the names of the solids: of their products in an assembly, else their own; "" where there is none."""
    from OCP.StepRepr import StepRepr_NextAssemblyUsageOccurrence
    from OCP.TopAbs import TopAbs_ShapeEnum

    from weldcal.models.workpieces.brep import parts_of

    found, made = list[str](), reader.WS().TransferReader()
    for solid in parts_of(shape, TopAbs_ShapeEnum.TopAbs_SOLID):
        entity = made.EntityFromShapeResult(solid, 1)  # None of a body in another file
        if isinstance(entity, StepRepr_NextAssemblyUsageOccurrence):
            entity = entity.RelatedProductDefinition().Formation().OfProduct()
        name = getattr(entity, "Name", lambda: None)()
        words = "" if name is None else name.ToCString().strip()
        found.append("" if words.startswith(_UNNAMED) else words)
    return found


def _assembled(path: Path) -> Any:
    """Return the shape of an assembly whose bodies are in other files, in millimetres."""
    from OCP.STEPCAFControl import STEPCAFControl_Reader
    from OCP.TCollection import TCollection_ExtendedString
    from OCP.TDocStd import TDocStd_Document
    from OCP.XCAFDoc import XCAFDoc_DocumentTool

    document = TDocStd_Document(TCollection_ExtendedString("assembly"))
    reader = STEPCAFControl_Reader()
    reader.ReadFile(str(path))
    reader.Transfer(document)
    return XCAFDoc_DocumentTool.ShapeTool_s(document.Main()).GetOneShape()


def _closed(shape: Any, path: Path, notes: list[str]) -> Any:
    """Return a shape with its solids; surfaces without any are sewn to some where they close within SEWN_MM.

    Raises:
        InputError: they do not, with the number of their free edges and the widest gap.
    """
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeSolid, BRepBuilderAPI_Sewing
    from OCP.BRepLib import BRepLib
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopoDS import TopoDS

    from weldcal.models.workpieces.brep import parts_of

    faces = parts_of(shape, TopAbs_ShapeEnum.TopAbs_FACE)
    if parts_of(shape, TopAbs_ShapeEnum.TopAbs_SOLID):
        return shape
    if not faces:
        raise InputError(f"'{path.name}' holds no solid and no surface, only lines: export the part as a solid.")
    sewing = BRepBuilderAPI_Sewing(SEWN_MM)
    for face in faces:
        sewing.Add(face)
    sewing.Perform()
    shells = parts_of(sewing.SewedShape(), TopAbs_ShapeEnum.TopAbs_SHELL)
    free = [TopoDS.Edge(sewing.FreeEdge(k + 1)) for k in range(sewing.NbFreeEdges())]
    if free or not shells:
        gap = _widest_gap(free)
        raise InputError(
            f"'{path.name}' holds no solid, and its {len(faces)} surfaces do not close within {SEWN_MM:g} mm:"
            f" {len(free)} edges are free, the widest gap is {gap:.3g} mm. Close it to a solid and export it again."
        )
    solids = []
    for shell in shells:
        solid = BRepBuilderAPI_MakeSolid(TopoDS.Shell(shell)).Solid()
        BRepLib.OrientClosedSolid_s(solid)
        solids.append(solid)
    words = f"a solid (within {SEWN_MM:g} mm)" if len(solids) == 1 else f"{len(solids)} solids (within {SEWN_MM:g} mm)"
    notes.append(f"The file holds surfaces only: {len(faces)} of them were sewn to {words}.")
    return _compound(solids)


def _widest_gap(free: Sequence[Any]) -> float:
    """Return the largest distance, mm, from the middle of a free edge to the nearest of the others."""
    from OCP.BRepAdaptor import BRepAdaptor_Curve

    from weldcal.models.workpieces.brep import sampled

    lines = [sampled(c, c.FirstParameter(), c.LastParameter()) for c in map(BRepAdaptor_Curve, free)]
    fine = [
        line[0] + np.linspace(0.0, 1.0, 65)[:, None] * (line[1] - line[0]) if len(line) == 2 else line for line in lines
    ]
    apart = [
        min(
            (float(np.linalg.norm(other - line[len(line) // 2], axis=1).min()) for other in fine if other is not line),
            default=0.0,
        )
        for line in fine
    ]
    return max(apart, default=0.0)


def _compound(shapes: Sequence[Any]) -> Any:
    from OCP.BRep import BRep_Builder
    from OCP.TopoDS import TopoDS_Compound

    builder, found = BRep_Builder(), TopoDS_Compound()
    builder.MakeCompound(found)
    for shape in shapes:
        builder.Add(found, shape)
    return found


def _sound(shape: Any, names: Sequence[str], path: Path, notes: list[str]) -> tuple[Any, list[Solid], list[str]]:
    """Return a shape without the bodies that OpenCascade cannot evaluate, with its bodies and their names.

    Raises:
        InputError: it can evaluate none.
    """
    from OCP.TopAbs import TopAbs_ShapeEnum

    from weldcal.models.workpieces.brep import Solid, called, listed, of_opencascade, parts_of

    solids = parts_of(shape, TopAbs_ShapeEnum.TopAbs_SOLID)
    found, left, why = dict[int, Solid](), list[str](), ""
    for k, solid in enumerate(solids):
        try:
            found[k] = Solid(solid)
            _edges(solid)
        except Exception as error:
            if not of_opencascade(error):
                raise
            found.pop(k, None)
            left.append(called(names, k))
            why = type(error).__name__
    if not found:
        raise InputError(
            f"OpenCascade cannot evaluate the surfaces of '{path.name}' ({why}): repair the part and export it again."
        )
    if left:
        notes.append(f"Left out, for OpenCascade cannot evaluate its surfaces ({why}): {listed(left)}.")
        shape = _compound([solids[k] for k in found])
        names = [names[k] if k < len(names) else "" for k in found]
    return shape, list(found.values()), list(names)


def _mesh(shape: Any, path: Path) -> TriMesh:
    """Return the fine mesh of all solids, m."""
    from OCP.BRep import BRep_Tool
    from OCP.BRepMesh import BRepMesh_IncrementalMesh
    from OCP.TopAbs import TopAbs_Orientation, TopAbs_ShapeEnum
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopoDS import TopoDS

    from weldcal.models.workpieces.brep import parts_of

    BRepMesh_IncrementalMesh(shape, CHORD_MM, False, FACET_RAD, False)
    pieces = []
    for found in parts_of(shape, TopAbs_ShapeEnum.TopAbs_FACE):
        face, location = TopoDS.Face(found), TopLoc_Location()
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
    return merge(*pieces, tolerance_m=_MERGED_M)


def _edges(shape: Any) -> tuple[PartEdge, ...]:
    """Return every edge of the shape, numbered in the file's order; edges within one smooth face are left out."""
    from OCP.BRepAdaptor import BRepAdaptor_Curve
    from OCP.GeomAbs import GeomAbs_CurveType
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopoDS import TopoDS

    from weldcal.models.workpieces.brep import SolidFace, faces_at, length_of, parts_of, sampled

    faces = [SolidFace(TopoDS.Face(face)) for face in parts_of(shape, TopAbs_ShapeEnum.TopAbs_FACE)]
    found: list[PartEdge] = []
    for edge, met in faces_at(shape, faces):
        curve = BRepAdaptor_Curve(edge)
        points = sampled(curve, curve.FirstParameter(), curve.LastParameter())
        if not length_of(points) > LEAST_EDGE_MM:
            continue
        kind, angle = ("boundary", math.nan) if len(met) < 2 else _met(curve, edge, met[0], met[1])
        circular = curve.GetType() == GeomAbs_CurveType.GeomAbs_Circle
        radius = 1e-3 * float(curve.Circle().Radius()) if circular else None
        found.append(PartEdge(len(found) + 1, kind, 1e-3 * points, angle, radius))
    return tuple(found)


def _met(curve: Any, edge: Any, first: SolidFace, second: SolidFace) -> tuple[str, float]:
    """Kind of an edge between two faces, and the angle between these, rad."""
    from OCP.TopAbs import TopAbs_Orientation, TopAbs_ShapeEnum

    from weldcal.models.workpieces.brep import middle_of, parts_of

    point, tangent, _ = middle_of(curve, curve.FirstParameter(), curve.LastParameter())
    # The orientation of the edge as it stands in the first face: the face lies to its left.
    own = next(e for e in parts_of(first.face, TopAbs_ShapeEnum.TopAbs_EDGE) if e.IsSame(edge))
    if own.Orientation() == TopAbs_Orientation.TopAbs_REVERSED:
        tangent = -tangent
    n_1, n_2 = first.normal(point), second.normal(point)
    turn = math.acos(float(np.clip(n_1 @ n_2, -1.0, 1.0)))
    if turn < SMOOTH_RAD:
        return "smooth", math.pi
    inward = np.cross(n_1, tangent)
    return ("concave" if n_2 @ inward > 0.0 else "convex"), math.pi - turn


def with_joints(
    edges: tuple[PartEdge, ...], chains: list[list[Piece]], names: Sequence[str] = ()
) -> tuple[tuple[PartEdge, ...], tuple[PartJoint, ...]]:
    """The edges of a part with those of its joints that are no edge of a body added at the end, and its joints.

    ``names``: of the bodies.
    """
    from weldcal.models.workpieces.brep import length_of
    from weldcal.models.workpieces.joints import closes

    known, joints = list(edges), []
    ends = np.array([edge.points_P[[0, -1]] for edge in edges]).reshape(-1, 2, 3)
    closed, lengths = np.array([(edge.closed, edge.length_m) for edge in edges]).reshape(-1, 2).T
    boxes = np.array([(edge.points_P.min(axis=0), edge.points_P.max(axis=0)) for edge in edges]).reshape(-1, 2, 3)
    for chain in chains:
        ids = []
        for piece in chain:
            kind = "concave" if piece.angle < math.pi - 0.01 else "flush"
            line = 1e-3 * piece.line
            apart = [np.abs(ends - line[some]).max(axis=(1, 2)) for some in ([0, -1], [-1, 0])]
            near = ((closed > 0.0) | (np.minimum(*apart) < 2e-5)) & (np.abs(lengths - length_of(line)) <= 2e-5)
            beyond = np.maximum(boxes[:, 0] - _middle(line), _middle(line) - boxes[:, 1]).max(axis=1)
            lies = (
                int(k) for k in np.flatnonzero(near & (beyond < _ON_M)) if known[k].up_P is None and _is(known[k], line)
            )
            at = next(lies, len(known))
            radius = known[at].radius_m if at < len(known) else None
            line = known[at].points_P if at < len(known) else 1e-3 * piece.line
            known[at : at + 1] = [PartEdge(at + 1, kind, line, piece.angle, radius, piece.up)]
            ids.append(at + 1)
        longest = max(chain, key=lambda piece: length_of(piece.line))
        joints.append(
            PartJoint(
                type=longest.type,
                edges=tuple(ids),
                length_m=1e-3 * sum(length_of(piece.line) for piece in chain),
                angle_rad=longest.angle,
                gap_m=1e-3 * max(piece.gap for piece in chain),
                walls_m=(1e-3 * longest.walls[0], 1e-3 * longest.walls[1]),
                thick_m=(1e-3 * longest.thick[0], 1e-3 * longest.thick[1]),
                up_P=longest.up,
                side=longest.side,
                closed=closes(chain),
                bodies=tuple(dict.fromkeys(names[k] for k in longest.bodies if k < len(names) and names[k])),
            )
        )
    return tuple(known), tuple(joints)


def _is(edge: PartEdge, line: Floats) -> bool:
    """Return whether an edge of this length is this line (N,3) m."""
    p, q, middle = edge.points_P, line, _middle(line)
    ends = min(np.abs(p[[0, -1]] - q[[0, -1]]).max(), np.abs(p[[0, -1]] - q[[-1, 0]]).max())
    a, d = p[:-1], np.diff(p, axis=0)
    share = np.clip(np.vecdot(middle - a, d) / np.vecdot(d, d), 0.0, 1.0)
    off = float(np.linalg.norm(a + share[:, None] * d - middle, axis=1).min())
    return bool((ends < 2e-5 or (edge.closed and np.linalg.norm(q[0] - q[-1]) < 1e-5)) and off < _ON_M)


def _middle(line: Floats) -> Floats:
    return np.asarray(0.5 * (line[0] + line[-1]) if len(line) == 2 else line[len(line) // 2])


def _first_line(error: Exception) -> str:
    text = re.sub(r"\s+", " ", str(error)).strip()
    return text[:120] or type(error).__name__
