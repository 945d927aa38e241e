"""The pose of a finished calibration is read from the files of other programs; SciPy writes them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.calibration.hand_eye.stated_forms import FORMS, truth, write
from weldcal.calibration.data.stated_pose import read_stated_pose
from weldcal.calibration.errors import DatasetError


@pytest.mark.parametrize("form", FORMS)
def test_pose_of_another_program_is_among_the_readings(form: str, tmp_path: Path) -> None:
    for seed in range(5):
        X = truth(seed)
        found = read_stated_pose(write(form, X, tmp_path))
        off = min(float(np.abs(one.X - X).max()) for one in found.readings)
        assert off < 2e-6, (seed, found.form, [one.form for one in found.readings])


@pytest.mark.parametrize("form", [f for f in FORMS if f not in ("quaternion wxyz first",)])
def test_usual_reading_comes_first(form: str, tmp_path: Path) -> None:
    X = truth(3)
    assert np.abs(read_stated_pose(write(form, X, tmp_path)).readings[0].X - X).max() < 2e-6


def test_mounting_of_the_file_is_known(tmp_path: Path) -> None:
    for form in ("easy_handeye", "easy_handeye2", "MoveIt 2 launch"):
        assert read_stated_pose(write(form, truth(), tmp_path)).mounting == "eye_in_hand"
    for form in ("matrix txt", "URDF"):
        assert read_stated_pose(write(form, truth(), tmp_path)).mounting is None


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        (
            "two.json",
            '{"T_a": [[1,0,0,1],[0,1,0,0],[0,0,1,0],[0,0,0,1]], "T_b": [[1,0,0,0],[0,1,0,2],[0,0,1,0],[0,0,0,1]]}',
            "--pose",
        ),
        ("none.txt", "nothing here\n", "no poses"),
        ("eye.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "identity"),
        ("x.urdf", '<origin xyz="${a} 0 0" rpy="0 0 0"/>', "write the numbers themselves"),
    ],
)
def test_files_without_one_pose_are_refused_in_a_sentence(name: str, text: str, match: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(DatasetError, match=match):
        read_stated_pose(tmp_path / name)


def test_named_pose_is_taken_where_there_are_several(tmp_path: Path) -> None:
    X = truth()
    (tmp_path / "two.yaml").write_text(f"T_a: {X.tolist()}\nT_b: {np.linalg.inv(X).tolist()}\n")
    assert np.abs(read_stated_pose(tmp_path / "two.yaml", "T_a").readings[0].X - X).max() < 1e-9


def test_one_of_several_cameras_is_named_by_its_serial(tmp_path: Path) -> None:
    poses = {f"{serial}_left": {"pose": [0.9, y, 0.8, -2.77, 0.39, -0.6]} for serial, y in (("22", -0.35), ("24", 0.5))}
    (tmp_path / "cameras.json").write_text(json.dumps(poses))
    assert read_stated_pose(tmp_path / "cameras.json", "24_left").readings[0].X[1, 3] == pytest.approx(0.5)
    with pytest.raises(DatasetError, match=r"holds 2 poses: 22_left, 24_left\. Name the camera's with --pose"):
        read_stated_pose(tmp_path / "cameras.json")
