"""An example dataset in every form that `weldcal new --dataset --format` writes is the same dataset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.writing import save_dataset
from weldcal.calibration.errors import DatasetError
from weldcal.models.errors import InputError
from weldcal.tools.commands.cell.dataset_forms import FORMS, rewrite, write_bag
from weldcal.tools.commands.cell.new import FILES, write_example

RNG = np.random.default_rng(4)
POSES = {
    f"pose{k:02d}": RigidTransform(RollPitchYaw(RNG.uniform(-1, 1, 3)), RNG.uniform(0.2, 0.7, 3)) for k in range(5)
}
CLOUDS = {id: RNG.uniform(0.3, 0.6, (6, 9, 3)) for id in POSES}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    header = DatasetHeader(robot="ur10e", flange="iso9409-1-50-4-m6", configuration="eye_on_base")
    save_dataset(tmp_path / "scans", header, POSES, CLOUDS)
    return tmp_path / "scans"


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_the_same_dataset(folder: Path, form: str) -> None:
    if form == "mcap":
        pytest.importorskip("rosbags", reason="the extra ros is not installed")
    plain = load_dataset(folder)
    before = [(plain.poses[id].GetAsMatrix4(), plain.cloud(id)) for id in plain.clouds]
    data = load_dataset(rewrite(folder, form))
    assert data.header.flange == plain.header.flange
    assert len(data.clouds) == len(before)
    for id, (X, points) in zip(data.clouds, before, strict=True):
        assert data.poses[id].GetAsMatrix4() == pytest.approx(X, abs=1e-12)
        assert data.cloud(id) == pytest.approx(points, abs=1e-9)
    assert not (folder / "poses.csv").exists()


def test_an_unknown_form_is_named_before_any_scan(tmp_path: Path) -> None:
    assert set(FILES) == set(FORMS)
    with pytest.raises(InputError, match="no form 'kuka': use ur, matrices"):
        write_example(tmp_path / "x", "kuka")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_a_recording_gives_the_scans_at_rest_one_for_each_pose(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    poses = np.array([X.GetAsMatrix4() for X in POSES.values()])
    twice = np.concatenate([poses, poses[:1]])
    write_bag(tmp_path / "bag", twice, [*CLOUDS.values(), CLOUDS["pose00"] + 0.001], kind=kind)
    data = load_dataset(tmp_path / "bag")
    assert len(data.clouds) == 5
    assert data.refused == (("scan06", "It was taken at the same pose as an earlier one; it counts once."),)
    assert data.poses["scan03"].GetAsMatrix4() == pytest.approx(poses[2], abs=1e-9)
    assert data.cloud("scan03") == pytest.approx(CLOUDS["pose02"])


def test_a_recording_without_its_reader_says_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    (folder / "poses.csv").unlink()
    (folder / "run.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(DatasetError, match=r"install the package for it: pip install 'weldcal\[ros\]'"):
        load_dataset(folder)
