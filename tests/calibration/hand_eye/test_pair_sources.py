"""Pairs of poses in the forms of calibration tools, robots and loggers are read, and give the known X; the rest is
refused with advice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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


def test_two_units_are_stated_for_robot_and_camera(tmp_path: Path) -> None:
    np.savez(tmp_path / "pairs.npz", robot=scaled(A, 100.0), camera=scaled(B, 100.0))  # both lists in cm
    with pytest.raises(DatasetError, match="--unit inch,mm"):
        read_pairs(tmp_path / "pairs.npz", mounting="eye_in_hand")
    found = read_pairs(tmp_path / "pairs.npz", mounting="eye_in_hand", length="cm,cm")
    assert found.robot == pytest.approx(A)
    with pytest.raises(DatasetError, match="no unit 'inch,ell'"):
        read_pairs(tmp_path / "pairs.npz", mounting="eye_in_hand", length="inch,ell")


def test_a_set_tcp_and_a_forgotten_last_row_are_said(tmp_path: Path) -> None:
    make, mounting = READ["UR program file"]
    assert "not of the flange" not in str(read_pairs(make(tmp_path / "a"), mounting=mounting).reading)
    lines = [
        f"movel(p[{', '.join(f'{v:.6f}' for v in (*X[:3, 3], *Rotation.from_matrix(X[:3, :3]).as_rotvec()))}])"
        for X in A
    ]
    (tmp_path / "robot.script").write_text("set_tcp(p[0,0,0.15,0,0,0])\n" + "\n".join(lines))
    seen = B.copy()
    seen[:, 3, 3] = 0.0
    np.save(tmp_path / "camera.npy", seen)
    reading = read_pairs(tmp_path, mounting="eye_in_hand").reading
    assert "of the TCP 0,0,0.15,0,0,0, not of the flange" in str(reading["robot"]["form"])
    assert "last row 0, 0, 0, 0 is taken as 0, 0, 0, 1" in str(reading["camera"]["form"])


def test_objects_of_numpy_are_to_be_saved_as_arrays(tmp_path: Path) -> None:
    np.save(tmp_path / "s.npy", np.array([{"robot": A[0]}], dtype=object), allow_pickle=True)
    with pytest.raises(DatasetError, match=r"holds Python objects \(a pickle\), which may run code: save"):
        read_pairs(tmp_path / "s.npy", mounting="eye_in_hand")
