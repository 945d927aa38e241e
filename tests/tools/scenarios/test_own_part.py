"""A cell begins with a user's own part and tool: the files lie beside it, and the seam is an edge of the part."""

from pathlib import Path

import numpy as np
import pytest

from weldcal.models.errors import InputError
from weldcal.models.mesh import extrude
from weldcal.models.tools.loading import WELDING
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import ToolFile
from weldcal.systems.scenario.workpiece import part_of
from weldcal.tools.cli.scenarios import edge_numbers
from weldcal.tools.scenarios.new_cell import OwnPart, write_cell

ANGLE = np.array([[0.0, 0.0], [80.0, 0.0], [80.0, 10.0], [10.0, 10.0], [10.0, 60.0], [0.0, 60.0]])  # an L, mm


@pytest.fixture
def angle(tmp_path: Path) -> Path:
    path = tmp_path / "angle.obj"
    path.write_text(extrude(ANGLE, 0.0, 150.0).to_obj())
    return path


def test_the_longest_concave_edge_of_a_part_becomes_the_seam(angle: Path, tmp_path: Path) -> None:
    cell = write_cell(tmp_path / "cell", "s_groove", OwnPart(angle), WELDING)
    scenario = load_scenario(str(cell))
    assert scenario.workpiece is not None
    assert scenario.workpiece.joint == "fillet"
    assert scenario.workpiece.file == str(cell.parent / "angle.obj")
    seam = part_of(scenario.workpiece).seam
    assert seam.points_P[[0, -1], :2] == pytest.approx(np.array([[0.01, 0.01], [0.01, 0.01]]), abs=1e-6)
    assert scenario.tool == ToolFile(str(cell.parent / "tool.yaml"))
    assert (cell.parent / "tool.yaml").read_text() == WELDING.read_text()


def test_the_part_stands_on_the_table_under_the_scanner(angle: Path, tmp_path: Path) -> None:
    guess = load_scenario(str(write_cell(tmp_path / "cell", "s_groove", OwnPart(angle)))).workpiece
    assert guess is not None
    assert guess.pose_guess.xyz_m == pytest.approx([0.65 - 0.04, -0.03, 0.0])


def test_edges_and_joint_can_be_chosen(angle: Path, tmp_path: Path) -> None:
    chosen = load_scenario(str(write_cell(tmp_path / "cell", "s_groove", OwnPart(angle, (1,), "lap")))).workpiece
    assert chosen is not None
    assert (chosen.seams[0].edges, chosen.joint) == ([1], "lap")


def test_a_part_that_cannot_begin_a_cell_is_refused_in_a_sentence(angle: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"angle.obj has no edge 99: see weldcal part"):
        write_cell(tmp_path / "a", "s_groove", OwnPart(angle, (99,)))
    box = tmp_path / "box.obj"
    box.write_text(extrude(ANGLE[[0, 1, 2]], 0.0, 20.0).to_obj())
    with pytest.raises(InputError, match=r"box.obj has no concave edge: choose edges with weldcal part"):
        write_cell(tmp_path / "b", "s_groove", OwnPart(box))
    with pytest.raises(InputError, match="--edges must be numbers with commas between them"):
        edge_numbers("12;13")
    assert edge_numbers(" 12, 13 ") == [12, 13]
