"""Twelve parts made as STEP: their edges are listed right, and their seams lie where the drawing has them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.worlds.parts.step_parts import PARTS, brackets_on_plate, write_step
from weldcal.models.errors import InputError
from weldcal.models.tool import WeldingTool
from weldcal.models.workpieces import step
from weldcal.models.workpieces.part import Part, bowed
from weldcal.models.workpieces.seam_input import SeamSource, seam_of
from weldcal.models.workpieces.shape import PartEdge
from weldcal.models.workpieces.step import CHORD_MM

if TYPE_CHECKING:
    from tests.models.workpieces.conftest import Shelf

# Concave edges of each part: count and total length in mm, by hand from its dimensions.
ARC = 150.0 * 2.0 * math.asin(90.0 / 150.0)
CONCAVE = {
    "grooved_plate": (1, 200.0),
    "curved_groove": (2, ARC),
    "pipe_on_plate": (2, 2.0 * math.pi * (80.0 + 72.0)),
    "box_corner": (2, 360.0),
    "bracket": (2, 320.0),
    "bent_sheet": (4, 2.0 * 600.0 * math.asin(80.0 / 300.0) + 16.0),
    "lap": (2, 400.0),
    "straight_web": (2, 400.0),
    "curved_web": (4, (200.0 + 190.0) * math.radians(50.0) + 20.0),
    "butt": (0, 0.0),
    "two_solids": (2, 360.0),
    "bevelled_plates": (1, 180.0),
}
# The walls' normals, left and right of the travel, in the middle of the seam.
s30, c30 = math.sin(math.radians(30.0)), math.cos(math.radians(30.0))
s22, c22 = math.sin(math.radians(22.5)), math.cos(math.radians(22.5))
WALLS = {
    "grooved_plate": ((0, -c22, s22), (0, c22, s22)),
    "curved_groove": ((c30, 0, s30), (-c30, 0, s30)),
    "pipe_on_plate": ((0, -1, 0), (0, 0, 1)),
    "box_corner": ((0, -1, 0), (0, 0, 1)),
    "bracket": ((0, -1, 0), (0, 0, 1)),
    "bent_sheet": ((0, -1, 0), (0, 0, 1)),
    "lap": ((0, -1, 0), (0, 0, 1)),
    "straight_web": ((0, -1, 0), (0, 0, 1)),
    "curved_web": ((1, 0, 0), (0, 0, 1)),
    "butt": ((0, 0, 1), (0, 0, 1)),
    "two_solids": ((0, -1, 0), (0, 0, 1)),
    "bevelled_plates": ((0, -c30, s30), (0, c30, s30)),
}


def off_root(name: str, p: np.ndarray) -> np.ndarray:
    """Distance of points (N,3) mm from the exact root line of a part."""
    x, y, z = p.T
    exact = {
        "grooved_plate": lambda: np.hypot(y, z + 8.0),
        "curved_groove": lambda: np.hypot(np.hypot(x, y) - 150.0, z + 8.0),
        "pipe_on_plate": lambda: np.hypot(np.hypot(x, y) - 80.0, z),
        "box_corner": lambda: np.hypot(y, z + 10.0),
        "bracket": lambda: np.hypot(y - 20.0, z),
        "bent_sheet": lambda: np.hypot(np.hypot(x, z + 300.0) - 300.0, y + 4.0),
        "lap": lambda: np.hypot(y, z),
        "straight_web": lambda: np.hypot(y + 5.0, z),
        "curved_web": lambda: np.hypot(np.hypot(x, y) - 200.0, z),
        "butt": lambda: np.hypot(y, z),
        "two_solids": lambda: np.hypot(y, z),
        "bevelled_plates": lambda: np.hypot(y, z + 12.0 + 0.5 / math.tan(math.radians(30.0))),
    }
    return np.asarray(exact[name]())


@pytest.mark.parametrize("name", PARTS)
def test_the_concave_edges_of_a_step_file_are_listed(shelf: Shelf, name: str) -> None:
    _, shape, _ = shelf.get(name)
    found = [edge for edge in shape.edges if edge.kind == "concave"]
    count, length = CONCAVE[name]
    assert len(found) == count
    assert 1e3 * sum(edge.length_m for edge in found) == pytest.approx(length, abs=0.05)
    assert [edge.id for edge in shape.edges] == list(range(1, len(shape.edges) + 1))


@pytest.mark.parametrize("name", PARTS)
def test_a_rough_line_becomes_the_exact_seam(shelf: Shelf, name: str) -> None:
    made, shape, csv = shelf.get(name)
    seam = seam_of(shape, SeamSource(csv), made.joint)
    inner = 1e3 * seam.points_P[6:-6]
    assert off_root(name, inner).max() < 0.03  # the mesh's chord is 0.02 mm
    assert 1e3 * seam.length_m == pytest.approx(
        made.length_mm, abs=1.2
    )  # an oblique end is cut off where one wall ends
    assert np.ptp(np.linalg.norm(np.diff(seam.points_P, axis=0), axis=1)) < 1e-5
    middle = len(seam.points_P) // 2
    for found, drawn in zip((seam.wall_left_P, seam.wall_right_P), WALLS[name], strict=True):
        assert math.degrees(math.acos(min(1.0, float(found[middle] @ np.array(drawn))))) < 1.5
    assert math.degrees(float(np.median(seam.opening_rad))) == pytest.approx(made.opening_deg, abs=0.1)
    assert np.abs(np.sum(seam.up_P * seam.tangents_P, axis=1)).max() < 0.02
    assert seam.gap_m == pytest.approx(0.003 if name == "butt" else 0.0, abs=1e-6)


def test_the_extent_of_the_walls_is_measured(shelf: Shelf) -> None:
    lap, shape, csv = shelf.get("lap")
    left, right = seam_of(shape, SeamSource(csv), lap.joint).wall_height_m
    assert left == pytest.approx(0.006, abs=1e-6)  # the sheet on the left is 6 mm thick
    assert right > 0.02
    corner, shape, csv = shelf.get("box_corner")
    assert seam_of(shape, SeamSource(csv), corner.joint).wall_height_m == pytest.approx((0.010, 0.010), abs=1e-6)


@pytest.mark.parametrize("name", PARTS)
def test_the_tip_can_be_pressed_into_every_made_joint(shelf: Shelf, name: str) -> None:
    made, shape, csv = shelf.get(name)
    part, tool = Part(shape, seam_of(shape, SeamSource(csv), made.joint)), WeldingTool()
    press = part.press(tool, None, None)
    seated = part.seated(tool, press)
    assert 0.0005 <= press.lateral_m <= 0.002
    assert 0.0 < seated.aside_m < 0.0003
    assert 0.001 < seated.above_m < 0.008


def test_edges_by_number_give_the_same_seam_as_the_line(shelf: Shelf) -> None:
    made, shape, csv = shelf.get("straight_web")
    by_line = seam_of(shape, SeamSource(csv), made.joint)
    (id,) = [e.id for e in shape.edges if e.kind == "concave" and e.points_P[0, 1] < 0.0]
    by_edge = seam_of(shape, SeamSource(edges=(id,)), made.joint)
    if (by_edge.points_P[-1] - by_edge.points_P[0])[0] < 0.0:
        by_edge = by_edge.reversed()
    assert np.abs(by_edge.points_P - by_line.points_P).max() < 1e-6
    back = seam_of(shape, SeamSource(csv, direction="reverse", start_m=0.010, end_m=0.020), made.joint)
    assert back.length_m == pytest.approx(by_line.length_m - 0.030, abs=1e-6)
    assert back.points_P[0] == pytest.approx(by_line.points_P[-1] - [0.010, 0.0, 0.0], abs=1e-6)
    assert back.wall_left_P[5] == pytest.approx(by_line.wall_right_P[5], abs=1e-9)


def test_a_closed_edge_gives_a_closed_seam(shelf: Shelf) -> None:
    made, shape, _ = shelf.get("pipe_on_plate")
    (id,) = [e.id for e in shape.edges if e.kind == "concave" and e.radius_m == pytest.approx(0.080)]
    seam = seam_of(shape, SeamSource(edges=(id,)), made.joint)
    assert seam.closed
    assert 1e3 * seam.length_m == pytest.approx(160.0 * math.pi, abs=2.0 * math.pi * CHORD_MM)
    assert seam.points_P[0] == pytest.approx(seam.points_P[-1], abs=1e-9)
    assert off_root("pipe_on_plate", 1e3 * seam.points_P).max() < 0.03


@pytest.mark.parametrize(
    ("name", "joint", "says"),
    [
        ("straight_web", "butt", "opens 90 deg"),
        ("straight_web", "lap", "neither wall ends"),
        ("grooved_plate", "fillet", "opens 45 deg"),
        ("butt", "fillet", "two walls|opens"),
    ],
)
def test_a_joint_that_is_not_there_is_refused_with_what_is(shelf: Shelf, name: str, joint: str, says: str) -> None:
    _, shape, csv = shelf.get(name)
    with pytest.raises(InputError, match=says):
        seam_of(shape, SeamSource(csv), joint)


def test_a_line_beside_the_joint_and_off_the_part_is_refused(
    shelf: Shelf, tmp_path_factory: pytest.TempPathFactory
) -> None:
    made, shape, _ = shelf.get("straight_web")
    csv = tmp_path_factory.mktemp("lines") / "line.csv"
    for shift, says in ((8.0, "does not run along"), (500.0, "off the part")):
        np.savetxt(csv, made.line_mm - np.array([0.0, shift, 0.0]), delimiter=",")
        with pytest.raises(InputError, match=says):
            seam_of(shape, SeamSource(csv), made.joint)
    np.savetxt(csv, made.line_mm * 1.2, delimiter=",")  # it runs 20 mm beyond both ends
    with pytest.raises(InputError, match="has no fillet joint"):
        seam_of(shape, SeamSource(csv), made.joint)


def test_a_line_at_two_joints_needs_a_direction(shelf: Shelf, tmp_path_factory: pytest.TempPathFactory) -> None:
    made, shape, _ = shelf.get("box_corner")
    csv = tmp_path_factory.mktemp("lines") / "line.csv"
    np.savetxt(csv, made.line_mm, delimiter=",")
    with pytest.raises(InputError, match="2 joints at once"):
        seam_of(shape, SeamSource(csv), made.joint)


def test_where_a_joint_goes_on_its_end_is_not_waited_for(shelf: Shelf) -> None:
    made, shape, csv = shelf.get("straight_web")
    whole = Part(shape, seam_of(shape, SeamSource(csv), made.joint))
    cut = Part(shape, seam_of(shape, SeamSource(csv, end_m=0.030), made.joint))
    assert cut.end_window_m < whole.end_window_m


def test_a_bowed_part_takes_its_seam_along(shelf: Shelf) -> None:
    made, shape, csv = shelf.get("curved_web")
    part = Part(shape, seam_of(shape, SeamSource(csv), made.joint))
    out = bowed(part, 0.001, np.array([1.0, 0.0, 0.0]))
    moved = np.linalg.norm(out.seam_P - part.seam_P, axis=1)
    assert moved.max() == pytest.approx(0.001, abs=2e-5)
    assert moved[0] < 0.0005
    assert out.mesh.watertight()
    # The seam drawn anew on the bowed surface is the seam that was taken along.
    from weldcal.models.workpieces.drawing import draw_seam

    again = draw_seam(out.mesh, out.seam_P, "fillet")
    gap = np.linalg.norm(again.points_P[10:-10, None] - out.seam_P[None], axis=2).min(axis=1)
    assert gap.max() < 0.0003  # half of the points' spacing along the seam


def test_edges_of_joints_are_compared_where_they_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Twice the brackets are twice the comparisons; each edge with each would be four times as many."""
    compared, found = [0], []
    same = step._is

    def counted(edge: PartEdge, line: NDArray[np.float64]) -> bool:
        compared[0] += 1
        return same(edge, line)

    monkeypatch.setattr(step, "_is", counted)
    for count in (3, 6):
        write_step(brackets_on_plate(count), tmp_path / f"{count}.step")
        compared[0] = 0
        shape = step.read_step(tmp_path / f"{count}.step", None)
        found.append((len(shape.joints), compared[0]))
    (joints, few), (more_joints, more) = found
    assert more_joints == 2 * joints > 0
    assert 0 < more < 3 * few
