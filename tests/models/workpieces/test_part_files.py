"""Files of parts: units, sizes, meshes, and every file that cannot be used refused by one sentence."""

from __future__ import annotations

import math
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from OCP.BRepAdaptor import BRepAdaptor_Curve

from tests.worlds.parts.step_parts import PARTS, assembly, box, write_step
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, extrude, merge
from weldcal.models.workpieces import joints, reading, step
from weldcal.models.workpieces.brep import MeshBody, MeshFace, parts_of
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.seam_input import SeamSource, chained, read_polyline, seam_of
from weldcal.models.workpieces.step import referenced
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.cell.new import OwnPart, write_cell

if TYPE_CHECKING:
    from tests.models.workpieces.conftest import Shelf

# The section of a T: a plate of 120 x 10 and a web of 10 x 50, mm.
T_SECTION = np.array([(-60, -10), (60, -10), (60, 0), (5, 0), (5, 50), (-5, 50), (-5, 0), (-60, 0)], dtype=float)


def t_mesh(scale: float = 1.0) -> TriMesh:
    """A T of 200 mm along z, in mm (times a scale)."""
    fine = []
    for a, b in zip(T_SECTION, np.roll(T_SECTION, -1, axis=0), strict=True):
        fine += [a + k / 12.0 * (b - a) for k in range(12)]
    return extrude(scale * np.array(fine), 0.0, scale * 200.0)


def write_stl(path: Path, mesh: TriMesh) -> None:
    rows = ["solid part"]
    for triangle, normal in zip(mesh.vertices[mesh.triangles], mesh.normals, strict=True):
        rows.append("facet normal {} {} {}\nouter loop".format(*normal))
        rows += ["vertex {} {} {}".format(*corner) for corner in triangle]
        rows.append("endloop\nendfacet")
    path.write_text("\n".join([*rows, "endsolid part"]))


def test_a_mesh_lists_its_sharp_edges_and_gives_its_seam(tmp_path: Path) -> None:
    stl, obj = tmp_path / "t.stl", tmp_path / "t.obj"
    write_stl(stl, t_mesh())
    obj.write_text(t_mesh().to_obj())
    for path in (stl, obj):
        shape = read_shape(path)
        concave = [edge for edge in shape.edges if edge.kind == "concave"]
        assert [edge.id for edge in concave] == [1, 2]
        assert [edge.length_m for edge in concave] == pytest.approx([0.2, 0.2], abs=1e-6)
        assert [math.degrees(edge.angle_rad) for edge in concave] == pytest.approx([90.0, 90.0], abs=1e-3)
        seam = seam_of(shape, SeamSource(edges=(1,)), "fillet")
        assert seam.length_m == pytest.approx(0.2, abs=1e-4)
        assert np.abs(np.abs(seam.points_P[:, 0]) - 0.005).max() < 1e-5
        assert np.abs(seam.points_P[:, 1]).max() < 1e-5
    assert read_shape(stl, "inch").mesh.bounds[1, 2] == pytest.approx(200.0 * 0.0254)


def brick(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriMesh:
    corners = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
    return extrude(corners, low[2], high[2])


@pytest.mark.parametrize(
    "other",
    [
        ((0.0, 0.0, 10.0), (100.0, 60.0, 30.0)),  # a whole face
        ((0.0, 60.0, 10.0), (100.0, 90.0, 30.0)),  # one edge
        ((0.0, 60.0, 0.0), (100.0, 90.0, 10.0)),  # side by side
    ],
)
def test_the_bodies_of_a_mesh_may_touch_in_faces_and_edges(other: tuple, tmp_path: Path) -> None:
    first, second = brick((0, 0, 0), (100, 60, 10)), brick(*other)
    write_stl(tmp_path / "two.stl", merge(first, second))
    shape = read_shape(tmp_path / "two.stl")
    assert shape.bodies == 2
    assert shape.mesh.volume == pytest.approx(1e-9 * (first.volume + second.volume), rel=1e-6)
    assert len(shape.edges) == 24
    assert sum(edge.kind == "convex" for edge in shape.edges) == 22  # and two seams
    assert sum(edge.length_m for edge in shape.edges) == pytest.approx(
        4e-3 * sum(np.ptp(mesh.vertices, axis=0).sum() for mesh in (first, second))
    )


def test_a_circle_on_a_mesh_has_its_radius(shelf: Shelf, tmp_path: Path) -> None:
    _, shape, _ = shelf.get("pipe_on_plate")
    path = tmp_path / "pipe.stl"
    write_stl(path, TriMesh(1e3 * shape.mesh.vertices, shape.mesh.triangles))
    radii = sorted(e.radius_m for e in read_shape(path).edges if e.kind == "concave" and e.radius_m is not None)
    assert radii == pytest.approx([0.072, 0.080], abs=2e-5)


@pytest.mark.parametrize(("unit", "word"), [("INCH", "inch"), ("M", "m"), ("MM", "mm")])
def test_a_step_file_states_its_unit(tmp_path: Path, unit: str, word: str) -> None:
    made, path = PARTS["straight_web"](), tmp_path / "part.step"
    write_step(made.shape, path, unit)
    for units in (None, word):
        shape = read_shape(path, units)
        assert np.ptp(shape.mesh.vertices, axis=0) == pytest.approx([0.2, 0.12, 0.06], abs=1e-6)
        assert shape.unit_m == {"mm": 1e-3, "m": 1.0, "inch": 0.0254}[word]
    other = "m" if word != "m" else "mm"
    with pytest.raises(InputError, match=f"is in {word}, not in {other}"):
        read_shape(path, other)


def test_a_seam_is_in_the_unit_of_its_part(tmp_path: Path) -> None:
    made = PARTS["straight_web"]()
    write_step(made.shape, tmp_path / "part.step", "INCH")
    np.savetxt(tmp_path / "seam.csv", made.line_mm / 25.4, delimiter=",")
    seam = seam_of(read_shape(tmp_path / "part.step"), SeamSource(tmp_path / "seam.csv"), "fillet")
    assert seam.length_m == pytest.approx(0.2, abs=1e-5)


@pytest.mark.parametrize(
    ("scale", "units", "says"),
    [(1e-3, "mm", "0.2 mm long.* Its unit may be m"), (1.0, "m", "200 m long.* Its unit may be mm")],
)
def test_a_part_of_a_wrong_unit_is_refused_with_the_likely_one(
    tmp_path: Path, scale: float, units: str, says: str
) -> None:
    path = tmp_path / "t.stl"
    write_stl(path, t_mesh(scale))
    with pytest.raises(InputError, match=says):
        read_shape(path, units)


def test_files_that_are_no_part_are_refused(tmp_path: Path) -> None:
    def file(name: str, content: str | bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    open_mesh = t_mesh()
    write_stl(tmp_path / "open.stl", TriMesh(open_mesh.vertices, open_mesh.triangles[:-3]))
    good = tmp_path / "good.step"
    write_step(PARTS["lap"]().shape, good)
    cases = [
        (tmp_path / "none.step", "no file"),
        (tmp_path, "no part|folder"),
        (file("part.igs", "x"), r"ends in \.step"),
        (file("text.step", "hello"), "not a STEP file"),
        (file("empty.step", ""), "not a STEP file"),
        (file("half.step", good.read_bytes()[: len(good.read_bytes()) // 2]), "cut off"),
        (file("hole.step", good.read_bytes().replace(b"CLOSED_SHELL", b"#99999 =X(#88888)", 1)), "damaged|refers"),
        (
            file("header.step", "ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\nENDSEC;\nEND-ISO-10303-21;\n"),
            "without any shape",
        ),
        (file("empty.stl", ""), "is empty"),
        (file("text.stl", "hello world"), "text.stl"),
        (file("noise.ply", bytes(range(256)) * 9), "noise.ply"),
        (file("points.obj", "v 0 0 0\nv 1 0 0\n"), "no triangles"),
        (tmp_path / "open.stl", "not a closed surface"),
    ]
    for path, says in cases:
        with pytest.raises(InputError, match=says):
            read_shape(path)
    with pytest.raises(InputError, match="units must be"):
        read_shape(good, "furlong")


def test_a_sheet_without_a_volume_is_no_solid(tmp_path: Path) -> None:
    from tests.worlds.parts.step_parts import _face

    path = tmp_path / "face.step"
    write_step(_face([(0, 0, 0), (100, 0, 0), (100, 100, 0)]), path)
    with pytest.raises(InputError, match="no solid"):
        read_shape(path)


def _unfinished_box(missing: int, apart_mm: float = 0.0) -> object:
    """The faces of a box without some, each moved away from its neighbours."""
    from OCP.BRep import BRep_Builder
    from OCP.gp import gp_Trsf, gp_Vec
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopoDS import TopoDS_Compound

    builder, found = BRep_Builder(), TopoDS_Compound()
    builder.MakeCompound(found)
    for k, face in enumerate(parts_of(box((0, 0, 0), (100, 80, 60)), TopAbs_ShapeEnum.TopAbs_FACE)[missing:]):
        move = gp_Trsf()
        move.SetTranslation(gp_Vec(0.0, 0.0, apart_mm if k == 5 else 0.0))
        builder.Add(found, face.Moved(TopLoc_Location(move)))
    return found


@pytest.mark.parametrize("apart_mm", [0.0, 0.08])
def test_surfaces_that_close_are_sewn_and_it_is_said(tmp_path: Path, apart_mm: float) -> None:
    write_step(_unfinished_box(0, apart_mm), tmp_path / "box.step")
    shape = read_shape(tmp_path / "box.step")
    assert (shape.bodies, shape.mesh.volume) == (1, pytest.approx(0.1 * 0.08 * 0.06, rel=0.002))
    assert shape.notes == ("The file holds surfaces only: 6 of them were sewn to a solid (within 0.1 mm).",)


@pytest.mark.parametrize(
    ("missing", "apart_mm", "says"),
    [(1, 0.0, "4 edges are free"), (0, 0.7, "8 edges are free, the widest gap is 0.7 mm")],
)
def test_surfaces_that_stay_open_are_refused_with_the_gap(
    tmp_path: Path, missing: int, apart_mm: float, says: str
) -> None:
    write_step(_unfinished_box(missing, apart_mm), tmp_path / "box.step")
    with pytest.raises(InputError, match=rf"do not close within 0\.1 mm: {says}"):
        read_shape(tmp_path / "box.step")


def _without_surface() -> object:
    """A solid with a face that has no surface, as a damaged file leaves it."""
    from OCP.BRep import BRep_Builder
    from OCP.TopoDS import TopoDS_Face, TopoDS_Shell, TopoDS_Solid

    builder, face, shell, solid = BRep_Builder(), TopoDS_Face(), TopoDS_Shell(), TopoDS_Solid()
    builder.MakeFace(face)
    builder.MakeShell(shell)
    builder.Add(shell, face)
    builder.MakeSolid(solid)
    builder.Add(solid, shell)
    return solid


def test_a_body_that_cannot_be_evaluated_is_left_out_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plates = box((0, 0, -8), (100, 80, 8)), box((10, 37, 0), (80, 6, 40))
    write_step(assembly(*plates), tmp_path / "t.step")
    whole = assembly(plates[0], _without_surface(), plates[1])
    monkeypatch.setattr(step, "_transferred", lambda path: (whole, "mm", ["plate", "knob", "web"]))
    shape = read_shape(tmp_path / "t.step")
    assert shape.notes == ("Left out, for OpenCascade cannot evaluate its surfaces (Standard_NullObject): 'knob'.",)
    assert (shape.bodies, {joint.bodies for joint in shape.joints}) == (2, {("plate", "web")})


def test_an_internal_error_of_opencascade_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a part without any sound body, of a pair of bodies, and anywhere else."""
    from OCP.gp import gp_Dir

    write_step(assembly(box((0, 0, -8), (100, 80, 8)), box((10, 37, 0), (80, 6, 40))), tmp_path / "t.step")
    with monkeypatch.context() as m:
        m.setattr(joints, "_met", lambda *_: gp_Dir(0.0, 0.0, 0.0))
        said = "OpenCascade finds no joints of body 1 and body 2: repair their surfaces and export them again."
        assert read_shape(tmp_path / "t.step").notes == (said,)
    reading._read.cache_clear()
    with monkeypatch.context() as m:
        m.setattr(step, "_mesh", lambda *_: gp_Dir(0.0, 0.0, 0.0))
        with pytest.raises(
            InputError, match=r"cannot evaluate 't.step' \(Standard_ConstructionError: .*repair the part"
        ):
            read_shape(tmp_path / "t.step")
    monkeypatch.setattr(step, "_transferred", lambda path: (_without_surface(), "mm", []))
    with pytest.raises(InputError, match=r"cannot evaluate the surfaces of 't.step' \(Standard_NullObject\)"):
        read_shape(tmp_path / "t.step")


def test_after_the_time_the_joints_of_the_largest_bodies_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The small boss comes first in the file."""
    solids = box((80, 10, 0), (10, 10, 10)), box((0, 0, -8), (100, 80, 8)), box((10, 37, 0), (80, 6, 40))
    write_step(assembly(*solids), tmp_path / "t.step")
    times = iter([0.0] * 5 + [99.0] * 1000)
    monkeypatch.setattr(joints.time, "process_time", lambda: next(times))
    shape = read_shape(tmp_path / "t.step")
    assert shape.notes[0].startswith("The joints of 1 of 2 pairs of bodies were found within 25 s of processor time")
    assert {round(1e3 * joint.length_m) for joint in shape.joints} <= {80, 172}


def test_without_opencascade_the_sentence_says_what_to_type(
    shelf: Shelf, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shelf.get("lap")[0].write(tmp_path)
    monkeypatch.setitem(sys.modules, "OCP.STEPControl", None)
    with pytest.raises(InputError, match=r"pip install 'weldcal\[parts\]'"):
        read_shape(tmp_path / "lap.step")


@pytest.mark.parametrize(
    "text",
    [
        "x,y,z\n0,0,0\n10,0,0\n10,5,0\n",
        "0 0 0\n10 0 0\n10 5 0",
        "\ufeffx;y;z\n0;0;0\n\n10;0;0 # corner\n10;5;0\n",
        "# made by hand\n0,0,0,0,0,2\n10,0,0,0,0,2\n10,5,0,0,0,2\n",
    ],
)
def test_a_polyline_is_read_in_every_usual_form(tmp_path: Path, text: str) -> None:
    path = tmp_path / "seam.csv"
    path.write_text(text, encoding="utf-8")
    points, normals = read_polyline(path)
    assert points.tolist() == [[0, 0, 0], [10, 0, 0], [10, 5, 0]]
    if normals is not None:
        assert normals.tolist() == [[0, 0, 1]] * 3


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x,y,z\n0,0,0\n", "holds 1 points"),
        ("", "holds 0 points"),
        ("0,0\n1,0\n", "line 1 has 2 numbers"),
        ("0,0,0\n1,0,0,0,0,1\n", "line 2 has 6 numbers"),
        ("0,0,0\nx,y,z\n", "line 2 is not numbers"),
        ("0,0,0\n1,nan,0\n", "line 2 holds a number"),
        ("0,0,0\n1e30,0,0\n", "line 2 holds a number"),
        ("0,0,0,0,0,0\n1,0,0,0,0,1\n", "no length in row 1"),
    ],
)
def test_a_polyline_that_is_wrong_names_its_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "seam.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=says):
        read_polyline(path)


def test_edges_chain_in_their_order_or_are_refused(shelf: Shelf) -> None:
    _, shape, _ = shelf.get("grooved_plate")
    by_ends = {
        tuple(np.round(1e3 * np.sort(e.points_P[[0, -1], 0]), 3)): e.id for e in shape.edges if e.length_m > 0.15
    }
    assert by_ends
    first = next(e for e in shape.edges if e.length_m > 0.15)
    touching = [
        e.id
        for e in shape.edges
        if e.id != first.id
        and np.linalg.norm(e.points_P[[0, -1]][:, None] - first.points_P[[0, -1]], axis=2).min() < 1e-6
    ]
    line, closed = chained(shape, [touching[0], first.id])
    assert not closed
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    assert steps == pytest.approx(first.length_m + shape.edge(touching[0]).length_m)
    apart = next(
        e.id
        for e in shape.edges
        if np.linalg.norm(e.points_P[[0, -1]][:, None] - first.points_P[[0, -1]], axis=2).min() > 0.001
    )
    for ids, says in (
        ([first.id, apart], "does not follow"),
        ([first.id, first.id], "twice"),
        ([999], "has no edge 999"),
    ):
        with pytest.raises(InputError, match=says):
            chained(shape, ids)


def test_a_seam_says_either_its_line_or_its_edges() -> None:
    for wrong in ({}, {"polyline": Path("a.csv"), "edges": (1,)}):
        with pytest.raises(InputError, match="either polyline"):
            SeamSource(**wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="forward or reverse"):
        SeamSource(edges=(1,), direction="left")
    with pytest.raises(InputError, match="0 or more"):
        SeamSource(edges=(1,), start_m=-0.001)


def write_in_files(shape: object, path: Path) -> None:
    """Write an assembly as CAD systems do where each body has a file: the assembly names them as external documents."""
    from OCP.STEPCAFControl import STEPCAFControl_Writer
    from OCP.STEPControl import STEPControl_StepModelType
    from OCP.TCollection import TCollection_ExtendedString
    from OCP.TDocStd import TDocStd_Document
    from OCP.XCAFDoc import XCAFDoc_DocumentTool

    document = TDocStd_Document(TCollection_ExtendedString("parts"))
    XCAFDoc_DocumentTool.ShapeTool_s(document.Main()).AddShape(shape, True)
    writer = STEPCAFControl_Writer()
    writer.Transfer(document, STEPControl_StepModelType.STEPControl_AsIs, "body_")
    writer.Write(str(path))


def test_an_assembly_takes_its_bodies_from_the_files_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shape = assembly(box((0, 0, -8), (100, 80, 8)), box((10, 37, 0), (80, 6, 40)))
    whole, top = tmp_path / "whole.step", tmp_path / "parts" / "top.step"
    top.parent.mkdir()
    write_step(shape, whole)
    monkeypatch.chdir(top.parent)  # the writer puts the bodies there
    write_in_files(shape, top)
    names = sorted(file.name for file in referenced(top))
    assert len(names) == 2
    found, known = read_shape(top), read_shape(whole)
    assert (found.bodies, len(found.joints)) == (2, len(known.joints))
    assert found.mesh.bounds == pytest.approx(known.mesh.bounds, abs=1e-9)
    assert found.joints[0].length_m == pytest.approx(known.joints[0].length_m, abs=1e-9)
    cell, note = write_cell(tmp_path / "cell", "s_groove", OwnPart(top))
    assert (cell.name, sorted(file.name for file in referenced(cell.parent / "top.step"))) == ("cell.yaml", names)
    assert load_scenario(str(cell)).calibration.maximum_scans == 20  # after 12 a saddle expected 0.172 mm of 0.150
    assert re.match(r"Without edges \d+, \d+: shorter than the 20 mm that the tip needs\.", note)  # the web's ends
    (top.parent / names[1]).unlink()
    with pytest.raises(InputError, match=f"takes a body from '{names[1]}': put that file beside it"):
        read_shape(top)


def test_the_frame_of_a_part_may_lie_out_of_the_arms_reach(tmp_path: Path) -> None:
    plate, web = box((3000, 1000, -10), (240, 120, 10)), box((3000, 1055, 0), (240, 10, 60))
    write_step(assembly(plate, web), tmp_path / "t.step")
    path, reason = write_cell(tmp_path / "cell", "s_groove", OwnPart(tmp_path / "t.step"))
    assert (path.name, reason) == ("cell.yaml", "")


@pytest.mark.parametrize("damage", [False, True])
def test_a_large_file_is_read_in_a_process_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: bool
) -> None:
    """Its shape is the same; a reader that ends without one is a sentence."""
    write_step(assembly(box((0, 0, -8), (100, 80, 8)), box((10, 37, 0), (80, 6, 40))), tmp_path / "t.step")
    known = read_shape(tmp_path / "t.step")
    monkeypatch.setattr(reading, "LARGE_BYTES", 0)
    if damage:
        monkeypatch.setattr(reading.sys, "executable", "/bin/false")
    reading._read.cache_clear()
    if damage:
        with pytest.raises(InputError, match=r"'t.step' makes its reader crash: .* Export only the bodies"):
            read_shape(tmp_path / "t.step")
        return
    found = read_shape(tmp_path / "t.step")
    assert found is not known
    assert (found.bodies, len(found.edges)) == (known.bodies, len(known.edges))
    assert [joint.edges for joint in found.joints] == [joint.edges for joint in known.joints]
    assert found.mesh.vertices == pytest.approx(known.mesh.vertices)


def test_a_reader_that_hangs_is_ended(tmp_path: Path) -> None:
    """Also one that is busy and answers no signal."""
    code = (
        "import signal; from weldcal.models.workpieces import reading; reading.MOST_S = 1\n"
        "def busy(*_):\n    signal.signal(signal.SIGTERM, signal.SIG_IGN)\n    while True: pass\n"
        f"reading._parsed = busy; reading.send('t.step', None, {str(tmp_path / 'shape')!r})"
    )
    ended = subprocess.run([sys.executable, "-c", code], check=False, timeout=60)
    assert ended.returncode in (-signal.SIGXCPU, -signal.SIGKILL)
    assert not (tmp_path / "shape").exists()


def test_joints_that_take_too_long_are_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between bodies, and inside one body."""
    write_step(assembly(box((0, 0, -8), (100, 80, 8)), box((10, 37, 0), (80, 6, 40))), tmp_path / "t.step")
    write_stl(tmp_path / "t.stl", t_mesh())
    monkeypatch.setattr(joints, "MOST_S", 0.0)
    for name, faces in (("t.step", 12), ("t.stl", 10)):
        with pytest.raises(
            InputError, match=f"joints between {faces} faces are not found within 0 s .*export only the bodies"
        ):
            read_shape(tmp_path / name)


def test_a_border_that_repeats_a_corner_is_one_edge() -> None:
    """A sliver of two regions: there, twice within 1e-5 mm at the end, and back."""
    p, q = np.zeros(3), np.array([30.0, 40.0, 0.0])
    triangles = np.array([[p, q, np.array([30.0, 40.0, 5.0])]])
    body = MeshBody(triangles, [MeshFace(triangles, None)], [(np.array([p, q, q + 1e-5, p]), [0])])
    ((edge, _),) = body.edges
    curve = BRepAdaptor_Curve(edge)
    assert curve.LastParameter() - curve.FirstParameter() == pytest.approx(50.0)


def test_a_part_is_read_once_until_its_file_is_written_again(tmp_path: Path) -> None:
    path = tmp_path / "t.stl"
    write_stl(path, t_mesh())
    first = read_shape(path)
    assert read_shape(path) is first
    (tmp_path / "copy").mkdir()
    copied = Path(shutil.copy(path, tmp_path / "copy"))
    assert read_shape(copied) is first
    assert read_shape(path, "inch") is not first
    write_stl(path, t_mesh(2.0))
    assert read_shape(path).mesh.bounds[1, 2] == pytest.approx(0.4)
