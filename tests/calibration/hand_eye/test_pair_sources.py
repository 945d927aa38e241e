"""Pairs of poses in the forms of calibration tools, robots and loggers are read, and give the known X; the rest is
refused with advice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.calibration.hand_eye.pair_sources import NAMED, READ, REFUSED
from tests.calibration.hand_eye.pair_world import BASE, X_BASE, A, B, X
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.hand_eye.pairs.files import read_pairs
from weldcal.calibration.hand_eye.pairs.importing import StatedForms
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import solve_problem


def error_mm(path: Path, mounting: str, stated: StatedForms | None = None) -> float:
    pairs = read_pairs(path, mounting=mounting, stated=stated)
    found = solve_problem(full_problem(pairs.F, pairs.G)).X.GetAsMatrix4()
    return 1e3 * float(np.linalg.norm(found[:3, 3] - (X_BASE if mounting == BASE else X)[:3, 3]))


@pytest.mark.parametrize("name", READ)
def test_the_form_is_read_and_gives_the_known_pose(name: str, tmp_path: Path) -> None:
    make, mounting = READ[name]
    assert error_mm(make(tmp_path), mounting) < 0.5


@pytest.mark.parametrize("name", NAMED)
def test_lists_without_names_are_named_by_options(name: str, tmp_path: Path) -> None:
    make, mounting, robot, camera = NAMED[name]
    path = make(tmp_path)
    with pytest.raises(DatasetError, match=f"{robot}.*{camera}.*--robot-poses and --camera-poses"):
        read_pairs(path, mounting=mounting)
    assert error_mm(path, mounting, StatedForms(robot_poses=robot, camera_poses=camera)) < 0.5


@pytest.mark.parametrize("name", REFUSED)
def test_what_holds_no_metric_poses_is_refused_with_advice(name: str, tmp_path: Path) -> None:
    make, mounting, words = REFUSED[name]
    with pytest.raises(DatasetError, match=words):
        read_pairs(make(tmp_path), mounting=mounting)


def scaled(poses: np.ndarray, factor: float) -> np.ndarray:
    found = poses.copy()
    found[:, :3, 3] *= factor
    return found


@pytest.mark.parametrize("factors", [(1e3, 1.0), (1.0, 1e3)])
def test_two_robots_in_two_units_are_named(tmp_path: Path, factors: tuple[float, float]) -> None:
    path = tmp_path / "pairs.npz"
    np.savez(path, A=scaled(A, factors[0]), B=B, C=scaled(A, factors[1]))
    with pytest.raises(DatasetError, match="write the positions of both robots in one unit"):
        read_pairs(path, mounting="co_manipulation")


@pytest.mark.parametrize(("factor", "words"), [(0.037, "another unit, or an unknown scale"), (0.6, "squares")])
def test_only_a_small_factor_is_a_wrong_board(tmp_path: Path, factor: float, words: str) -> None:
    path = tmp_path / "pairs.npz"
    np.savez(path, A=A, B=scaled(B, factor))
    with pytest.raises(InconsistentPoses, match=words):
        read_pairs(path, mounting="eye_in_hand")
