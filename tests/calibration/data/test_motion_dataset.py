"""Recordings in motion: what is written is read back; wrong files get one sentence, single frames are refused by
name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from weldcal.calibration.data.checks import is_motion
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.header import DatasetHeader, ScannerGuess
from weldcal.calibration.data.motion_dataset import FrameTime, RobotStream, load_motion_dataset, save_motion_dataset
from weldcal.calibration.errors import DatasetError
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import chain_poses, forward_kinematics

HEADER = DatasetHeader(robot="ur10e", flange="iso9409-1-50-4-m6", scanner="phoxi_m", configuration="eye_on_base")
JOINTS = np.linspace([0.1, -1.2, 1.8, -2.0, -1.4, 0.3], [0.3, -1.1, 1.7, -2.1, -1.5, 0.5], 101)
TIMES = np.linspace(7.0, 7.2, 101)


def record(folder: Path, *, joints: bool = False, device: bool = True) -> Path:
    """A recording of 0.2 s with four frames of noise."""
    poses = chain_poses(load_chain("ur10e"), JOINTS)
    stream = RobotStream(TIMES, poses, JOINTS if joints else None)
    frames = [FrameTime(f"f{k}", 7.05 + 0.05 * k, 1.7e9 + 0.05 * k if device else None) for k in range(4)]
    rng = np.random.default_rng(1)
    clouds = ((f.id, rng.uniform(0.1, 0.5, (100, 3))) for f in frames)
    save_motion_dataset(folder, HEADER, stream, frames, clouds)
    return folder


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize("joints", [False, True])
def test_read_back(tmp_path: Path, joints: bool) -> None:
    data = load_motion_dataset(record(tmp_path, joints=joints))
    assert is_motion(tmp_path)
    assert (data.stream.joints is not None) == joints
    assert np.array_equal(data.stream.time, TIMES)
    one = forward_kinematics(load_chain("ur10e"), JOINTS[7]).GetAsMatrix4()
    assert np.allclose(data.stream.poses[7], one, atol=1e-9)
    assert [f.id for f in data.frames] == ["f0", "f1", "f2", "f3"]
    assert data.frames[2].device == 1.7e9 + 0.1
    assert all(f.device is not None for f in data.frames)
    assert data.cloud("f1").shape == (100, 3)
    assert data.header.mode == "motion"
    assert not data.refused
    assert not data.warnings


def test_guess_is_written(tmp_path: Path) -> None:
    stream = RobotStream(TIMES, chain_poses(load_chain("ur10e"), JOINTS))
    header = replace(HEADER, scanner_guess=ScannerGuess([0.4, 0.2, 1.0], [0.0, 1.0, 0.0, 0.0], 0.1))
    cloud = np.random.default_rng(0).uniform(0.1, 0.5, (100, 3))
    save_motion_dataset(tmp_path, header, stream, [FrameTime("f", 7.1)], [("f", cloud)])
    guess = load_motion_dataset(tmp_path).X_BC_guess
    assert guess is not None
    assert np.allclose(guess.translation(), [0.4, 0.2, 1.0])


def test_rows_in_any_order_repeated_and_empty(tmp_path: Path) -> None:
    record(tmp_path, device=False)
    head, *rows = (tmp_path / "stream.csv").read_text().splitlines()
    (tmp_path / "stream.csv").write_text("\n".join([head, *rows[::-1], rows[4], "7.0811,,,,,,,"]) + "\n")
    head, *rows = (tmp_path / "frames.csv").read_text().splitlines()
    (tmp_path / "frames.csv").write_text("\n".join([head, *rows[::-1], "f9,7.19", "f8,"]) + "\n")
    data = load_motion_dataset(tmp_path)
    assert np.array_equal(data.stream.time, TIMES)
    assert [f.id for f in data.frames] == ["f0", "f1", "f2", "f3"]
    assert any(f.device is None for f in data.frames)
    assert {id for id, _ in data.refused} == {"f8", "f9"}
    assert len(data.warnings) == 2


def test_repeated_cloud_is_refused(tmp_path: Path) -> None:
    record(tmp_path)
    (tmp_path / "clouds" / "f2.npz").write_bytes((tmp_path / "clouds" / "f1.npz").read_bytes())
    (tmp_path / "clouds" / "extra.ply").write_text("ply")
    data = load_motion_dataset(tmp_path)
    assert [id for id, _ in data.refused] == ["f2"]
    assert "1 clouds have no row" in data.warnings[0]


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("dataset.yaml", "mode: motion", "mode: moving", "write static or motion"),
        ("stream.csv", "time,x", "stamp,x", "needs time,x,y,z"),
        ("stream.csv", "7.002,", "seven,", "'seven' in column time of its row 2"),
        ("frames.csv", "arrival", "when", "lacks the column arrival"),
        ("frames.csv", "7.05,", "7050.0,", None),
        ("frames.csv", "f1,7.1", "f1,soon", "'soon' in column arrival of 'f1'"),
    ],
)
def test_wrong_files(tmp_path: Path, file: str, old: str, new: str, said: str | None) -> None:
    record(tmp_path)
    change(tmp_path / file, old, new)
    if said is None:  # one late frame is no reason to refuse the recording
        assert len(load_motion_dataset(tmp_path).frames) == 4
        return
    with pytest.raises(DatasetError, match=said):
        load_motion_dataset(tmp_path)


def test_other_clocks_and_units(tmp_path: Path) -> None:
    record(tmp_path)
    lines = (tmp_path / "frames.csv").read_text().splitlines()
    (tmp_path / "frames.csv").write_text("\n".join([lines[0], *(f"f{k},{7050 + 50 * k}," for k in range(4))]) + "\n")
    with pytest.raises(DatasetError, match="in seconds"):
        load_motion_dataset(tmp_path)
    lines = (tmp_path / "stream.csv").read_text().splitlines()
    slow = [lines[0], *(f"{1000.0 * float(line.split(',')[0])},{line.split(',', 1)[1]}" for line in lines[1:])]
    (tmp_path / "stream.csv").write_text("\n".join(slow))
    with pytest.raises(DatasetError, match="2 apart in time"):
        load_motion_dataset(tmp_path)


def test_joints_need_a_known_robot(tmp_path: Path) -> None:
    record(tmp_path, joints=True)
    change(tmp_path / "dataset.yaml", "robot: ur10e", "robot: my_arm")
    with pytest.raises(DatasetError, match="'my_arm' is not known; use poses"):
        load_motion_dataset(tmp_path)
    assert load_motion_dataset(tmp_path, robot="ur10e").stream.joints is not None
    with pytest.raises(DatasetError, match="7 joints"):
        load_motion_dataset(tmp_path, robot="franka")


def test_static_commands_say_what_reads_it(tmp_path: Path) -> None:
    record(tmp_path)
    with pytest.raises(DatasetError, match="weldcal monitor"):
        load_dataset(tmp_path)
    change(tmp_path / "dataset.yaml", "mode: motion", "mode: static")
    with pytest.raises(DatasetError, match="add 'mode: motion'"):
        load_dataset(tmp_path)
    assert not is_motion(tmp_path)
