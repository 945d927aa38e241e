"""The study of pictures draws boards where their descriptions place them, and counts regions that hold the truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.calibration.hand_eye import rendering as draw
from tests.figures.__main__ import app
from tests.worlds.board_pictures import BOARDS, printed, render, views
from weldcal.calibration.hand_eye.pictures.boards import find_board, parse_board, with_layout


@pytest.mark.parametrize("text", BOARDS)
def test_a_printed_board_is_rendered_where_the_lens_equation_places_it(text: str) -> None:
    drawing, board = printed(text), parse_board(text)
    C = views(drawing, np.random.default_rng(1), 1, eye_in_hand=True, deg=0.0, mm=0.0).camera[0]
    picture = render(drawing, C, np.random.default_rng(2))
    board = with_layout([picture], board)
    found = find_board(picture, board)
    truth = draw.project(board.points, C, draw.K, draw.DIST)
    off = found[min(board.symmetries, key=lambda order: float(np.abs(found[order] - truth).max()))] - truth
    assert np.sqrt((off**2).mean()) < 0.1


def test_the_stated_poses_of_the_robot_are_those_of_the_truth() -> None:
    world = views(printed(BOARDS[0]), np.random.default_rng(0), 3, eye_in_hand=False, deg=0.0, mm=0.0)
    assert np.allclose(np.linalg.inv(world.robot) @ world.X @ world.camera, world.Y)


def test_the_command_counts_truths_inside_the_region(tmp_path: Path) -> None:
    call = ["benchmark", "hand-eye-pictures", "--corners", "6", "--pictures", "0", "--json", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout.splitlines()[-1])["cells"]["corners, all"]
    assert (found["runs"], found["solved"], found["right_percent"]) == (6, 6, 100.0)
    assert found["inside_percent"] >= 50.0
    assert 0.2 < found["nees"] < 3.0
