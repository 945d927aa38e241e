"""What `weldcal import` writes is read again as the same poses; the sources are written here by SciPy."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from tests.calibration.hand_eye.stated_forms import truth
from tests.documents.scans import write_scans
from tests.tools.test_verify_pairs import pairs
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.hand_eye.pairs.files import read_pairs
from weldcal.tools.cli.app import app


def imported(*words: str) -> dict[str, object]:
    run = CliRunner().invoke(app, ["import", *words, "--json"])
    assert run.exit_code == 0, run.output
    return dict(json.loads(run.stdout.splitlines()[-1]))


def test_two_tables_in_other_conventions_become_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    A, B, _ = pairs(12, 0, truth(0))
    angles = Rotation.from_matrix(A[:, :3, :3]).as_euler("ZYX", degrees=True)
    vectors = Rotation.from_matrix(B[:, :3, :3]).as_rotvec()
    robot = np.hstack([1e3 * A[:, :3, 3], angles])
    camera = np.hstack([B[:, :3, 3], vectors])
    camera[4] = np.nan
    for name, table in (("first.csv", robot), ("second.csv", camera)):
        np.savetxt(name, table, delimiter=",", header="x,y,z,rx,ry,rz", comments="")
    found = imported("first.csv", "second.csv", "--mounting", "eye_in_hand", "--out", "mine")
    again = read_pairs(tmp_path / "mine")
    rows = [k for k in range(12) if k != 4]
    assert again.mode == "eye_in_hand"
    assert np.abs(again.robot - A[rows]).max() < 1e-9
    assert np.abs(again.camera - B[rows]).max() < 1e-9
    assert found["lines"]["robot"].startswith("first.csv")  # type: ignore[index]
    assert "euler_ZYX,deg" in found["lines"]["robot"]  # type: ignore[index]
    assert "row 5" in found["lines"]["left out"]  # type: ignore[index]
    table = np.genfromtxt("mine/table.csv", delimiter=",", names=True)
    assert np.abs(table["robot_x"] - A[rows, 0, 3]).max() < 1e-9
    assert np.abs(table["camera_z"] - B[rows, 2, 3]).max() < 1e-9


def test_without_a_mounting_the_pairs_state_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    A, B, _ = pairs(10, 1, truth(1))
    np.savez("some.npz", robot=A, camera=B)
    imported("some.npz", "--out", "mine")
    assert "mode" not in np.load("mine/pairs.npz")
    assert np.abs(read_pairs(tmp_path / "mine", mounting="eye_in_hand").robot - A).max() < 1e-9


def test_an_import_never_overwrites_something(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    A, B, _ = pairs(10, 1, truth(1))
    np.savez("some.npz", robot=A, camera=B)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "note.txt").write_text("mine")
    run = CliRunner().invoke(app, ["import", "some.npz", "--out", "mine"])
    assert run.exit_code == 1
    assert "is not empty" in run.stderr
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["note.txt"]


def test_scans_of_another_form_become_a_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_scans(tmp_path / "scans", 6, 0)
    plain = load_dataset(tmp_path / "scans")
    ids = list(plain.poses)
    X = np.array([plain.poses[i].GetAsMatrix4() for i in ids])
    other = tmp_path / "other"
    shutil.copytree(tmp_path / "scans" / "clouds", other / "clouds")
    rows = np.hstack([1e3 * X[:, :3, 3], Rotation.from_matrix(X[:, :3, :3]).as_euler("ZYX", degrees=True)])
    lines = [
        "id,x,y,z,rx,ry,rz",
        *(",".join([i, *map(repr, map(float, row))]) for i, row in zip(ids, rows, strict=True)),
    ]
    (other / "poses.csv").write_text("\n".join(lines) + "\n")
    found = imported("other", "--flange", "iso9409-1-50-4-m6", "--out", "mine")
    again = load_dataset(tmp_path / "mine")
    assert found["kind"] == "scans"
    assert sorted(again.clouds) == sorted(ids)
    assert again.header.flange == "iso9409-1-50-4-m6"
    for i, M in zip(ids, X, strict=True):
        assert np.abs(again.poses[i].GetAsMatrix4() - M).max() < 1e-6
        assert np.array_equal(again.cloud(i), plain.cloud(i), equal_nan=True)


def test_pairs_of_centres_stay_what_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    source = tmp_path / "centres"
    source.mkdir()
    (source / "dataset.yaml").write_text("schema: 1\nconfiguration: eye_on_base\nunits: {poses: mm, clouds: mm}\n")
    rng = np.random.default_rng(0)
    rows = [f"p{k}," + ",".join(f"{v:.3f}" for v in rng.uniform(200, 900, 6)) for k in range(6)]
    (source / "pairs.csv").write_text("id,base_x,base_y,base_z,camera_x,camera_y,camera_z\n" + "\n".join(rows) + "\n")
    imported("centres", "--out", "mine")
    before, after = load_dataset(source).pairs, load_dataset(tmp_path / "mine").pairs
    assert [p.id for p in before] == [p.id for p in after]
    for a, b in zip(before, after, strict=True):
        assert np.abs(a.p_CR - b.p_CR).max() < 1e-12
        assert a.X_BR.IsNearlyEqualTo(b.X_BR, 1e-12)
