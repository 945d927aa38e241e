"""Lists of poses in the text that robots, cameras and other programs write; each gives the same ten poses."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.calibration.data.pose_texts import TEXTS, TURN, N, P, Q, V, join
from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.listing import _orthonormal
from weldcal.calibration.data.poses.lists import folder_lists, read_lists, two_lists
from weldcal.calibration.data.poses.storage import matlab_arrays
from weldcal.calibration.data.poses.text import lists_of_text
from weldcal.calibration.errors import DatasetError


@pytest.mark.parametrize("name", TEXTS)
def test_each_form_holds_the_same_poses(name: str) -> None:
    text, form, unit = TEXTS[name]
    (found,) = lists_of_text(text, "poses.txt")
    assert len(found) == N
    assert found.unit == unit
    X = next(one for one in found.readings if one.form == form).X
    scale = 1e-3 if np.median(np.abs(X[:, :3, 3])) > 10.0 else 1.0
    assert scale * X[:, :3, 3] == pytest.approx(P, abs=1e-6)
    assert X[:, :3, :3] == pytest.approx(TURN.as_matrix(), abs=1e-5)


def test_rows_with_two_labels_are_two_lists() -> None:
    text = "".join(f"hand,{join(P[k], V[k])}\neye,{join(-P[k], V[k])}\n" for k in range(N))
    hand, eye = lists_of_text(text, "a.csv")
    assert (len(hand), len(eye)) == (N, N)
    assert hand.name.endswith("hand")
    assert eye.readings[0].X[:, :3, 3] == pytest.approx(-P, abs=1e-8)


def test_rows_without_a_pose_are_left_out_with_the_reason() -> None:
    rows = [join(P[k], Q[k]) for k in range(N)]
    rows[3], rows[5], rows[7] = "nan,0.1,0.2,0,0,0,1", "0,0,0,0,0,0,1", "0,0,0,0,0,0,0"
    (found,) = lists_of_text("x,y,z,qx,qy,qz,qw\n" + "\n".join(rows), "a.csv")
    assert [row for row, _ in found.left_out] == [3, 5, 7]
    assert "missing" in found.left_out[0][1]
    assert all("nothing was detected" in why for _, why in found.left_out[1:])


def test_colmap_is_refused_with_what_to_write() -> None:
    with pytest.raises(DatasetError, match="no unit of length"):
        lists_of_text("# Image list with two lines of data per image:\n1 1 0 0 0 0 0 0 1 a.png\n\n", "images.txt")


def test_matlab_arrays_with_the_poses_last_are_read(tmp_path: Path) -> None:
    from scipy.io import savemat

    X = np.zeros((N, 4, 4))
    X[:, :3, :3], X[:, :3, 3], X[:, 3, 3] = TURN.as_matrix(), P, 1.0
    savemat(tmp_path / "a.mat", {"A": np.moveaxis(X, 0, 2), "B": np.moveaxis(X, 0, 2)})
    lists = read_lists(tmp_path / "a.mat")
    assert {one.name for one in lists} == {"a.mat, A", "a.mat, B"}
    assert pytest.approx(X) == lists[0].readings[0].X


def test_a_sample_that_is_no_file_is_refused_and_not_skipped(tmp_path: Path) -> None:
    X = np.eye(4)
    for k in range(6):
        X[0, 3] = 0.1 * k
        (tmp_path / f"sample_{k}.json").write_text(json.dumps({"robot": X.tolist(), "camera": X.tolist()}))
    for one in folder_lists(tmp_path):
        assert len(one) == 6
        assert [row for row, _ in one.left_out] == [0]
        assert "nothing was detected" in one.left_out[0][1]
    (tmp_path / "sample_3.json").unlink()
    assert [len(one) for one in folder_lists(tmp_path)] == [5, 5]
    for other in (lambda p: p.mkdir(), lambda p: p.symlink_to("nothing.json"), lambda p: p.symlink_to("/dev/zero")):
        other(tmp_path / "sample_3.json")
        with pytest.raises(DatasetError, match=r"'sample_3\.json' is no file"):
            folder_lists(tmp_path)
        (tmp_path / "sample_3.json").rmdir() if (tmp_path / "sample_3.json").is_dir() else (
            tmp_path / "sample_3.json"
        ).unlink()


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_numbers_whose_squares_overflow_are_no_rotation() -> None:
    assert not _orthonormal(np.full((3, 3, 3), 1e200))
    assert _orthonormal(TURN.as_matrix())


def test_a_stated_form_holds_for_one_order_of_position_and_rotation(tmp_path: Path) -> None:
    rows = "\n".join(join(P[k], np.degrees(V[k])) for k in range(N))
    (found,) = lists_of_text(rows + "\n", "a.txt")
    assert len(found.numbers) == 2  # the rotation may come first
    for form, turn in (("rotation_vector,deg", TURN), ("euler_xyz,deg", Rotation.from_euler("xyz", V))):
        (reading,) = found.stated(PoseForm(rotation=form), "--as robot-form").readings
        assert pytest.approx(turn.as_matrix(), abs=1e-6) == reading.X[:, :3, :3]


def test_two_blocks_of_as_many_rows_are_the_robots_and_the_cameras() -> None:
    blocks = ["\n".join(join(sign * P[k], Q[k]) for k in range(N)) for sign in (1.0, -1.0)]
    robot, camera = lists_of_text("\n\n\n".join(blocks) + "\n", "a.txt")
    assert robot.name.endswith("robot")
    assert camera.readings[0].X[:, :3, 3] == pytest.approx(-P, abs=1e-6)
    (one,) = lists_of_text("\n\n".join([blocks[0], *blocks[1].splitlines()[:2]]) + "\n", "a.txt")
    assert len(one) == N + 2


def test_files_with_a_number_a_line_are_poses(tmp_path: Path) -> None:
    for k in range(N):
        (tmp_path / f"pos{k}.txt").write_text("\n".join(map(str, (*np.degrees(V[k]), *(1e3 * P[k])))) + "\n")
    (found,) = folder_lists(tmp_path, needed=1)
    assert any(one.X[:, :3, 3] == pytest.approx(1e3 * P) for one in found.readings)


def test_a_table_that_matlab_saves_as_text_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.mat").write_text("\n".join("   ".join(f"{v:.8e}" for v in (*P[k], *Q[k])) for k in range(N)) + "\n")
    (found,) = read_lists(tmp_path / "a.mat")
    assert found.readings[0].X[:, :3, 3] == pytest.approx(P, abs=1e-7)


def test_a_matrix_and_two_vectors_in_one_document_are_two_lists(tmp_path: Path) -> None:
    for k in range(N):
        X = np.eye(4)
        X[:3, :3], X[:3, 3] = TURN.as_matrix()[k], P[k]
        sample = {
            "O_T_EE": X.ravel().tolist(),
            "T_cam_target_rvec": V[k][:, None].tolist(),
            "T_cam_target_tvec": (-P[k])[:, None].tolist(),
            "detected": True,
        }
        (tmp_path / f"pose_{k:02d}").mkdir()
        (tmp_path / f"pose_{k:02d}" / "data.json").write_text(json.dumps(sample))
    robot, camera = two_lists(folder_lists(tmp_path), "a")
    assert robot.readings[0].X[:, :3, 3] == pytest.approx(P)
    assert camera.readings[0].X[:, :3, 3] == pytest.approx(-P)


@pytest.mark.parametrize("packed", [False, True])
def test_matlab_files_are_read_as_scipy_reads_them(packed: bool) -> None:
    from scipy.io import loadmat, savemat

    cells = np.empty((1, 3), dtype=object)
    for k in range(3):
        cells[0, k] = np.arange(16.0).reshape(4, 4) + k
    given = {
        "A": np.arange(24.0).reshape(2, 3, 4),
        "n": np.int16([[1, 2], [3, 4]]),
        "one": 5.0,
        "cells": cells,
        "s": {"R": np.eye(3), "word": "x"},
    }
    stream = io.BytesIO()
    savemat(stream, given, do_compression=packed)
    found, scipys = matlab_arrays(stream.getvalue(), "a.mat"), loadmat(stream, simplify_cells=True)
    for key in ("A", "n", "one"):
        np.testing.assert_array_equal(found[key], scipys[key])
    np.testing.assert_array_equal(np.array(found["cells"]), np.stack(list(scipys["cells"])))
    np.testing.assert_array_equal(found["s"]["R"], np.eye(3))
    with pytest.raises(DatasetError, match=r"save it with save\('a.mat', '-v7'\)"):
        matlab_arrays(b"MATLAB 7.3 MAT-file", "a.mat")


def test_damaged_matlab_files_are_refused_or_read() -> None:
    from scipy.io import savemat

    stream = io.BytesIO()
    savemat(stream, {"A": np.arange(48.0).reshape(3, 4, 4)}, do_compression=False)
    content, refused = stream.getvalue(), 0
    rng = np.random.default_rng(0)
    for _ in range(400):
        damaged = bytearray(content)
        for at in rng.integers(126, 200, 2):
            damaged[at] ^= 1 << int(rng.integers(8))
        try:
            matlab_arrays(bytes(damaged[: int(rng.integers(128, len(content) + 1))]), "a.mat")
        except DatasetError:
            refused += 1
    assert 200 < refused < 400


def test_joint_angles_and_a_result_beside_the_lists_are_no_lists(tmp_path: Path) -> None:
    X = np.tile(np.eye(4), (N, 1, 1))
    X[:, :3, :3], X[:, :3, 3] = TURN.as_matrix(), P
    pairs = [[a.tolist(), a.tolist()] for a in X]
    log = {
        "Result in Pose Format": [*P[1], *Q[1]],
        "Joint Dataset": np.column_stack([V, P]).tolist(),
        "Transform Dataset": pairs,
    }
    (tmp_path / "log.json").write_text(json.dumps(log))
    robot, camera = two_lists(read_lists(tmp_path / "log.json"), "log.json")
    assert (robot.name, camera.name) == tuple(f"log.json, Transform Dataset, {who}" for who in ("robot", "camera"))
