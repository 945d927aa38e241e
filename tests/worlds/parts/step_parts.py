"""Makes twelve parts as STEP files through OpenCascade, each with the seam to weld on it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError

Floats = npt.NDArray[np.float64]
Corners = Sequence[tuple[float, float]]


@dataclass(frozen=True, eq=False, kw_only=True)
class MadePart:
    """Hold a part in mm with the seam on it.

    Its shape, its joint, points (N,3) on the seam's root in the order of travel, roughly (up to 0.3 mm), and the exact
    length of the root.

    `up` (3,): out of the joint, for a line that needs it; `concave`: how many concave edges the file has.
    """

    name: str
    shape: Any
    line_mm: Floats
    length_mm: float
    joint: str = "fillet"
    opening_deg: float = 90.0
    up: tuple[float, float, float] | None = None

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Write NAME.step and NAME.csv, the seam, into a folder; their paths."""
        step, csv = folder / f"{self.name}.step", folder / f"{self.name}.csv"
        write_step(self.shape, step)
        rows = self.line_mm if self.up is None else np.hstack([self.line_mm, np.tile(self.up, (len(self.line_mm), 1))])
        head = "x,y,z" if self.up is None else "x,y,z,nx,ny,nz"
        np.savetxt(csv, rows, fmt="%.4f", delimiter=",", header=head, comments="")
        return step, csv


def write_step(shape: Any, path: Path, unit: str = "MM") -> None:
    """Write a shape (mm) as STEP in a unit: MM, M or INCH."""
    from OCP.IFSelect import IFSelect_ReturnStatus
    from OCP.Interface import Interface_Static
    from OCP.Message import Message
    from OCP.STEPControl import STEPControl_StepModelType, STEPControl_Writer

    messenger = Message.DefaultMessenger_s()
    for printer in list(messenger.Printers()):
        messenger.RemovePrinter(printer)
    writer = STEPControl_Writer()
    Interface_Static.SetCVal_s("write.step.unit", unit)
    try:
        writer.Transfer(shape, STEPControl_StepModelType.STEPControl_AsIs)
        done = writer.Write(str(path)) == IFSelect_ReturnStatus.IFSelect_RetDone
    finally:
        Interface_Static.SetCVal_s("write.step.unit", "MM")
    if not done:
        raise InputError(f"'{path}' cannot be written.")


def box(low: Sequence[float], size: Sequence[float]) -> Any:
    """Return a box from its lowest corner, mm."""
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.gp import gp_Pnt

    return BRepPrimAPI_MakeBox(gp_Pnt(*low), *size).Shape()


def prism(corners: Sequence[Sequence[float]], along: Sequence[float]) -> Any:
    """Return a polygon (N,3) mm moved along a vector."""
    from OCP.BRepPrimAPI import BRepPrimAPI_MakePrism
    from OCP.gp import gp_Vec

    return BRepPrimAPI_MakePrism(_face(corners), gp_Vec(*along)).Shape()


def turned(corners: Sequence[Sequence[float]], point: Sequence[float], axis: Sequence[float], angle_rad: float) -> Any:
    """Return a polygon (N,3) mm turned about an axis."""
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeRevol
    from OCP.gp import gp_Ax1, gp_Dir, gp_Pnt

    return BRepPrimAPI_MakeRevol(_face(corners), gp_Ax1(gp_Pnt(*point), gp_Dir(*axis)), angle_rad).Shape()


def cylinder(foot: Sequence[float], radius: float, height: float, axis: Sequence[float] = (0.0, 0.0, 1.0)) -> Any:
    """Return a cylinder, mm."""
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeCylinder
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    return BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(*foot), gp_Dir(*axis)), radius, height).Shape()


def fused(first: Any, *others: Any) -> Any:
    """One solid of several, with the seams between coplanar faces removed."""
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Fuse
    from OCP.ShapeUpgrade import ShapeUpgrade_UnifySameDomain

    for other in others:
        first = BRepAlgoAPI_Fuse(first, other).Shape()
    unified = ShapeUpgrade_UnifySameDomain(first, True, True, False)
    unified.Build()
    return unified.Shape()


def less(first: Any, *others: Any) -> Any:
    """Return a solid without others."""
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut

    for other in others:
        first = BRepAlgoAPI_Cut(first, other).Shape()
    return first


def assembly(*solids: Any) -> Any:
    """Several solids side by side, as a CAD assembly is exported."""
    from OCP.BRep import BRep_Builder
    from OCP.TopoDS import TopoDS_Compound

    compound, builder = TopoDS_Compound(), BRep_Builder()
    builder.MakeCompound(compound)
    for solid in solids:
        builder.Add(compound, solid)
    return compound


def _face(corners: Sequence[Sequence[float]]) -> Any:
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace, BRepBuilderAPI_MakePolygon
    from OCP.gp import gp_Pnt

    polygon = BRepBuilderAPI_MakePolygon()
    for corner in corners:
        polygon.Add(gp_Pnt(*corner))
    polygon.Close()
    return BRepBuilderAPI_MakeFace(polygon.Wire()).Face()


def _straight(a: Sequence[float], b: Sequence[float]) -> Floats:
    return np.array([a, b], dtype=np.float64)


def _arc(radius: float, low: float, high: float, z: float, step_mm: float = 5.0) -> Floats:
    angle = np.linspace(low, high, max(3, math.ceil(radius * abs(high - low) / step_mm)))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(len(angle), z)])


def grooved_plate() -> MadePart:
    """Return a plate with a V groove of 45 deg, 8 mm deep."""
    w = 8.0 * math.tan(math.radians(22.5))
    groove = prism([(-101, -w * 1.25, 2), (-101, w * 1.25, 2), (-101, 0, -8)], (202, 0, 0))
    shape = less(box((-100, -60, -20), (200, 120, 20)), groove)
    return MadePart(
        name="grooved_plate",
        shape=shape,
        joint="v_groove",
        line_mm=_straight((-100, 0, -8), (100, 0, -8)),
        length_mm=200.0,
        opening_deg=45.0,
    )


def curved_groove() -> MadePart:
    """Return a plate with a V groove of 60 deg along an arc of radius 150 mm."""
    r, w = 150.0, 10.0 * math.tan(math.radians(30.0))
    ring = turned([(r - w, 0, 2), (r + w, 0, 2), (r, 0, -8)], (0, 0, 0), (0, 0, 1), 2.0 * math.pi)
    shape = less(box((90, -90, -20), (100, 180, 20)), ring)
    low, high = -math.asin(90.0 / r), math.asin(90.0 / r)
    return MadePart(
        name="curved_groove",
        shape=shape,
        joint="v_groove",
        line_mm=_arc(r, low, high, -8.0),
        length_mm=r * (high - low),
        opening_deg=60.0,
    )


def pipe_on_plate() -> MadePart:
    """Return a pipe of 160 mm on a plate; the seam is a third of its foot."""
    pipe = less(cylinder((0, 0, -1), 80.0, 61.0), cylinder((0, 0, -2), 72.0, 70.0))
    shape = fused(box((-120, -120, -12), (240, 240, 12)), pipe)
    line = _arc(80.0, math.radians(-150.0), math.radians(-30.0), 0.0)
    return MadePart(name="pipe_on_plate", shape=shape, line_mm=line, length_mm=80.0 * math.radians(120.0))


def box_corner() -> MadePart:
    """Two plates of a box that touch along one line: the open corner is a groove of 90 deg on the outside."""
    shape = assembly(
        prism([(-90, 0, 0), (-90, 80, 0), (-90, 80, -10), (-90, 0, -10)], (180, 0, 0)),
        prism([(-90, 0, -10), (-90, -10, -10), (-90, -10, -70), (-90, 0, -70)], (180, 0, 0)),
    )
    line = _straight((-90, 0, -10), (90, 0, -10))
    return MadePart(
        name="box_corner", shape=shape, joint="v_groove", line_mm=line, length_mm=180.0, up=(0.0, -1.0, 1.0)
    )


def bracket() -> MadePart:
    """Return an angle bracket with two holes and a gusset beyond the seam's end."""
    shape = fused(box((-80, -50, -10), (160, 100, 10)), box((-80, 20, 0), (160, 10, 60)))
    shape = less(shape, cylinder((-40, -25, -20), 8.0, 40.0), cylinder((40, -25, -20), 8.0, 40.0))
    return MadePart(name="bracket", shape=shape, line_mm=_straight((-80, 20, 0), (80, 20, 0)), length_mm=160.0)


def bent_sheet() -> MadePart:
    """Return a sheet bent over a radius of 300 mm with a straight web across it: the seam bends in the web's plane."""
    half = math.asin(90.0 / 300.0)
    sheet = turned(
        [
            (-300 * math.sin(half), -60, 300 * math.cos(half)),
            (-300 * math.sin(half), 60, 300 * math.cos(half)),
            (-290 * math.sin(half), 60, 290 * math.cos(half)),
            (-290 * math.sin(half), -60, 290 * math.cos(half)),
        ],
        (0, 0, 0),
        (0, 1, 0),
        2.0 * half,
    )
    web = less(box((-80, -4, 280), (160, 8, 60)), cylinder((0, -100, 0), 295.0, 200.0, (0, 1, 0)))
    shape = fused(sheet, web)
    a = np.linspace(-math.asin(80.0 / 300.0), math.asin(80.0 / 300.0), 33)
    line = np.column_stack([300.0 * np.sin(a), np.full(len(a), -4.0), 300.0 * np.cos(a)]) - [0.0, 0.0, 300.0]
    return MadePart(
        name="bent_sheet", shape=moved(shape, (0, 0, -300)), line_mm=line, length_mm=600.0 * math.asin(80.0 / 300.0)
    )


def lap() -> MadePart:
    """Return a sheet of 6 mm on another: the seam runs along the upper sheet's edge."""
    shape = assembly(box((-100, -80, -6), (200, 100, 6)), box((-100, 0, 0), (200, 80, 6)))
    return MadePart(name="lap", shape=shape, joint="lap", line_mm=_straight((-100, 0, 0), (100, 0, 0)), length_mm=200.0)


def straight_web() -> MadePart:
    """Return a T of a plate and a web of 10 mm, one solid."""
    shape = fused(box((-100, -60, -10), (200, 120, 10)), box((-100, -5, 0), (200, 10, 50)))
    return MadePart(name="straight_web", shape=shape, line_mm=_straight((-100, -5, 0), (100, -5, 0)), length_mm=200.0)


def curved_web() -> MadePart:
    """Return a T whose web follows an arc of radius 200 mm; the seam lies on its outside."""
    half = math.radians(25.0)
    web = turned([(190, 0, -1), (200, 0, -1), (200, 0, 45), (190, 0, 45)], (0, 0, 0), (0, 0, 1), 2.0 * half)
    shape = fused(box((130, -100, -10), (120, 200, 10)), turned_about_z(web, -half))
    line = _arc(200.0, -half, half, 0.0)
    return MadePart(name="curved_web", shape=shape, line_mm=line, length_mm=400.0 * half)


def butt() -> MadePart:
    """Two plates side by side with a gap of 3 mm."""
    shape = assembly(box((-100, 1.5, -10), (200, 60, 10)), box((-100, -61.5, -10), (200, 60, 10)))
    return MadePart(
        name="butt",
        shape=shape,
        joint="butt",
        line_mm=_straight((-100, 0.2, 0), (100, 0.2, 0)),
        length_mm=200.0,
        opening_deg=180.0,
        up=(0.0, 0.0, 1.0),
    )


def two_solids() -> MadePart:
    """Return a T as an assembly: the web rests on the plate as a body of its own."""
    shape = assembly(box((-90, -60, -10), (180, 120, 10)), box((-90, 0, 0), (180, 8, 60)))
    return MadePart(name="two_solids", shape=shape, line_mm=_straight((-90, 0, 0), (90, 0, 0)), length_mm=180.0)


def bevelled_plates() -> MadePart:
    """Two plates with bevels of 30 deg and a root gap of 1 mm: the root is where the bevels would meet."""
    w = 12.0 * math.tan(math.radians(30.0))
    right = prism([(-90, -0.5, -12), (-90, -60, -12), (-90, -60, 0), (-90, -0.5 - w, 0)], (180, 0, 0))
    left = prism([(-90, 0.5, -12), (-90, 60, -12), (-90, 60, 0), (-90, 0.5 + w, 0)], (180, 0, 0))
    line = _straight((-90, 0, -12), (90, 0, -12))
    return MadePart(
        name="bevelled_plates",
        shape=assembly(left, right),
        joint="v_groove",
        line_mm=line,
        length_mm=180.0,
        opening_deg=60.0,
        up=(0.0, 0.0, 1.0),
    )


def brackets_on_plate(count: int) -> Any:
    """Return an assembly of a plate and so many brackets, each held by two bolts: 12 edges, and 26 for each bracket."""
    parts = [box((-400, -400, -20), (800, 800, 20))]
    for k in range(count):
        x, y = -380 + 90 * (k % 8), -380 + 90 * (k // 8)
        bolts = [cylinder((x + 35, y + 15 + 20 * i, 0), 5, 20) for i in (0, 1)]
        parts += [less(fused(box((x, y, 0), (60, 50, 8)), box((x, y, 0), (8, 50, 50))), *bolts), *bolts]
    return assembly(*parts)


def moved(shape: Any, by: Sequence[float]) -> Any:
    """Return a shape moved by a vector, mm."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_Transform
    from OCP.gp import gp_Trsf, gp_Vec

    X = gp_Trsf()
    X.SetTranslation(gp_Vec(*by))
    return BRepBuilderAPI_Transform(shape, X, True).Shape()


def turned_about_z(shape: Any, angle_rad: float) -> Any:
    """Return a shape turned about the z axis."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_Transform
    from OCP.gp import gp_Ax1, gp_Dir, gp_Pnt, gp_Trsf

    X = gp_Trsf()
    X.SetRotation(gp_Ax1(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1)), angle_rad)
    return BRepBuilderAPI_Transform(shape, X, True).Shape()


PARTS: dict[str, Callable[[], MadePart]] = {
    make.__name__: make
    for make in (
        *(grooved_plate, curved_groove, pipe_on_plate, box_corner, bracket, bent_sheet, lap, straight_web, curved_web),
        *(butt, two_solids, bevelled_plates),
    )
}
