"""A cell begins with a user's own part and tool: the files lie beside it, and the seam is an edge of the part."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.worlds.parts.step_parts import assembly, box, write_step
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, extrude
from weldcal.models.tools.loading import WELDING
from weldcal.models.workpieces.reading import read_shape
from weldcal.systems.jobs.weld.job import seam_planning
from weldcal.systems.jobs.weld.seam_planning import plan_drawn_seam
from weldcal.systems.jobs.weld.settings import servo_config
from weldcal.systems.messages import PlannedSeam
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.parts import part_of
from weldcal.systems.scenario.schema import Scenario, ToolFile
from weldcal.systems.station import make_station
from weldcal.tools.cli.app import app
from weldcal.tools.commands.cell.new import OwnPart, edge_numbers, write_cell

ANGLE = np.array([[0.0, 0.0], [80.0, 0.0], [80.0, 10.0], [10.0, 10.0], [10.0, 60.0], [0.0, 60.0]])  # an L, mm


@pytest.fixture
def angle(tmp_path: Path) -> Path:
    path = tmp_path / "angle.obj"
    path.write_text(extrude(ANGLE, 0.0, 150.0).to_obj())
    return path


def test_the_longest_concave_edge_of_a_part_becomes_the_seam(angle: Path, tmp_path: Path) -> None:
    cell, _ = write_cell(tmp_path / "cell", "s_groove", OwnPart(angle), WELDING)
    scenario = load_scenario(str(cell))
    assert scenario.workpiece is not None
    assert scenario.workpiece.joint == "fillet"
    assert scenario.workpiece.file == str(cell.parent / "angle.obj")
    seam = part_of(scenario.workpiece).seam
    assert seam.points_P[[0, -1], :2] == pytest.approx(np.array([[0.01, 0.01], [0.01, 0.01]]), abs=1e-6)
    assert scenario.tool == ToolFile(str(cell.parent / "tool.yaml"))
    assert (cell.parent / "tool.yaml").read_text() == WELDING.read_text()


def test_the_part_stands_on_the_table_under_the_scanner(angle: Path, tmp_path: Path) -> None:
    guess = load_scenario(str(write_cell(tmp_path / "cell", "s_groove", OwnPart(angle))[0])).workpiece
    assert guess is not None
    assert guess.pose_guess.pose().multiply([0.04, 0.03, 0.0]) == pytest.approx([0.65, 0.0, 0.0], abs=1e-4)


def test_the_part_lies_elsewhere_than_guessed_so_the_scan_has_to_find_it(angle: Path, tmp_path: Path) -> None:
    part = load_scenario(str(write_cell(tmp_path / "cell", "s_groove", OwnPart(angle))[0])).workpiece
    assert part is not None
    assert part.located_by == "scan"
    assert part.placement_error.translation_mm > 3.0
    assert part.placement_error.rotation_deg > 1.0


def test_of_two_joints_the_seam_is_the_one_above(tmp_path: Path) -> None:
    """A lap of two sheets has a corner below too, as long as the one above; the way to it leads through the part."""
    lap = np.array([[-80, -6], [20, -6], [20, 0], [80, 0], [80, 6], [0, 6], [0, 0], [-80, 0]], dtype=float)
    upright = extrude(lap, -70.0, 70.0)
    path = tmp_path / "lap.obj"
    path.write_text(TriMesh(upright.vertices[:, [2, 0, 1]], upright.triangles).to_obj())
    scenario = load_scenario(str(write_cell(tmp_path / "above", "s_groove", OwnPart(path))[0]))
    assert scenario.workpiece is not None
    assert part_of(scenario.workpiece).seam.up_P[:, 2].min() > 0.5
    assert planned(scenario).reason is None
    chosen = scenario.workpiece.seams[0].edges
    below = next(edge.id for edge in read_shape(path).edges if edge.kind == "concave" and [edge.id] != chosen)
    scenario = load_scenario(str(write_cell(tmp_path / "below", "s_groove", OwnPart(path, (below,)))[0]))
    assert re.search("would touch the part on its way to the seam, even 100 mm above", str(planned(scenario).reason))


def planned(scenario: Scenario) -> PlannedSeam:
    station = make_station(scenario, 0)
    try:
        return plan_drawn_seam(seam_planning(scenario, station, servo_config(scenario, station)), 1)
    finally:
        station.close()


def test_edges_and_joint_can_be_chosen(angle: Path, tmp_path: Path) -> None:
    chosen = load_scenario(str(write_cell(tmp_path / "cell", "s_groove", OwnPart(angle, (1,), "lap"))[0])).workpiece
    assert chosen is not None
    assert (chosen.seams[0].edges, chosen.joint) == ([1], "lap")


def test_a_part_that_cannot_begin_a_cell_is_refused_in_a_sentence(angle: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'angle.obj' has no edge 99: its edges are 1 to 18"):
        write_cell(tmp_path / "a", "s_groove", OwnPart(angle, (99,)))
    box = tmp_path / "box.obj"
    box.write_text(extrude(ANGLE[[0, 1, 2]], 0.0, 20.0).to_obj())
    with pytest.raises(InputError, match=r"box.obj has no concave edge: choose edges with 'weldcal part"):
        write_cell(tmp_path / "b", "s_groove", OwnPart(box))
    with pytest.raises(InputError, match="--edges must be numbers with commas between them"):
        edge_numbers("12;13")
    assert edge_numbers(" 12, 13 ") == [12, 13]


def test_a_part_that_no_place_lets_the_arm_weld_is_no_cell(tmp_path: Path) -> None:
    channel = np.array([[0, 0], [60, 0], [60, 60], [50, 60], [50, 10], [10, 10], [10, 60], [0, 60]], dtype=float)
    path = tmp_path / "tube.obj"
    path.write_text(extrude(channel, 0.0, 150.0).to_obj())
    folder = tmp_path / "cell"
    words = ["new", str(folder), "--part", str(path), "--json"]
    finished = CliRunner().invoke(app, words)
    found = json.loads(finished.stdout.splitlines()[-1])
    assert finished.exit_code == 1
    assert found["state"] == "unfinished"
    assert found["reason"].startswith("The arm cannot weld tube.obj in any of the poses that were tried: ")
    assert not (folder / "cell.yaml").exists()
    text = (folder / "unfinished.yaml").read_text()
    assert "It runs as it is" not in text
    assert "the arm cannot weld the seam of its part yet" in text
    assert load_scenario(str(folder / "unfinished.yaml")).workpiece is not None


def test_a_seam_that_begins_at_the_table_is_no_cell(angle: Path, tmp_path: Path) -> None:
    """The angle stands on its end: the arm reaches the seam, and the tool would meet the table beside it."""
    written, reason = write_cell(tmp_path / "cell", "s_groove", OwnPart(angle))
    assert written.name == "unfinished.yaml"
    assert re.search("would touch the table near .* at 0 mm of the seam: raise the part", reason)


def test_the_next_seam_is_taken_where_the_longest_cannot_be_welded(tmp_path: Path) -> None:
    """A long slot that no tool enters, and a shorter T beside it."""
    plate = box((0, 0, -10), (250, 160, 10))
    slot = [box((0, y, 0), (250, 6, 60)) for y in (20, 36)]
    write_step(assembly(plate, *slot, box((40, 110, 0), (170, 6, 40))), tmp_path / "slot.step")
    found = write_cell(tmp_path / "cell", "s_groove", OwnPart(tmp_path / "slot.step"))
    scenario = load_scenario(str(found[0]))
    assert found[1] == ""
    assert scenario.workpiece is not None
    assert planned(scenario).reason is None
    y = part_of(scenario.workpiece).seam.points_P[:, 1]
    assert not ((y > 0.0255) & (y < 0.0365)).any()


def test_new_takes_the_unit_of_a_mesh(angle: Path, tmp_path: Path) -> None:
    path = tmp_path / "metres.obj"
    path.write_text(extrude(1e-3 * ANGLE, 0.0, 0.15).to_obj())
    with pytest.raises(InputError, match="Its unit may be m"):
        write_cell(tmp_path / "a", "s_groove", OwnPart(path))
    cell, _ = write_cell(tmp_path / "b", "s_groove", OwnPart(path, (1,), units="m"))
    part = load_scenario(str(cell)).workpiece
    assert part is not None
    assert part.units == "m"
    assert part_of(part).seam.length_m == pytest.approx(0.15, abs=1e-4)
