"""A result survives the disk, is written whole or not at all, and says the same in every export."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d
import pytest
import yaml
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from typer.testing import CliRunner

import weldcal
from weldcal.calibration.data.clouds import read_cloud
from weldcal.calibration.data.results import (
    CalibrationResult,
    IcpRecord,
    PoseRecord,
    correction_note,
    export_all,
    export_json,
    export_ros2,
    export_ur_pose,
    export_urdf,
    load_result,
    save_result,
)
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.models.errors import InputError
from weldcal.models.files import write_atomic
from weldcal.tools.cli.app import app

X_BC = RigidTransform(RollPitchYaw(3.0, 0.2, 0.7), [-0.6, -0.3, 1.1])


@pytest.fixture
def result() -> CalibrationResult:
    return CalibrationResult(
        X_BC=X_BC,
        covariance=np.diag([1e-8, 2e-8, 3e-8, 4e-9, 5e-9, 6e-9]),
        held_out_mm={"median": 0.2, "mean": 0.3, "p95": 0.5},
        tilt_deg={"median": 0.08, "p95": None},
        poses=(
            PoseRecord(
                id="a", used=True, reason="", residual_mm=0.1, held_out_mm=0.2, tilt_deg=0.01, held_out_tilt_deg=0.02
            ),
            PoseRecord(id="b", used=False, reason="no plane"),
        ),
        icp=(
            IcpRecord(
                id="a",
                method="point_to_point",
                rotation_deg=(0.0, 0.1, 0.2),
                translation_mm=(0.1, 0.2, 0.3),
                translation_norm_mm=0.37,
                unseen=("rotation",),
                true_error_mm=0.4,
            ),
        ),
        unobservable=("a bias",),
        warnings=("one",),
        robot="ur10e",
        seed=7,
        data_hashes={"poses.csv": "ab" * 32},
    )


def test_what_is_read_back_is_what_was_written(result: CalibrationResult, tmp_path: Path) -> None:
    save_result(result, tmp_path / "new")
    back = load_result(tmp_path / "new")
    assert np.allclose(back.X_BC.GetAsMatrix34(), X_BC.GetAsMatrix34(), atol=1e-14)
    assert np.array_equal(back.covariance, result.covariance)
    assert back.poses == result.poses
    assert back.icp == result.icp
    assert back.held_out_mm == result.held_out_mm
    assert back.tilt_deg == result.tilt_deg
    assert (back.seed, back.robot, back.data_hashes) == (7, "ur10e", result.data_hashes)
    assert back.software.startswith("weldcal")


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "f.txt"
    write_atomic(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_atomic(path, "new \ud800")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["f.txt"]


def test_every_export_says_the_same_pose(result: CalibrationResult, tmp_path: Path) -> None:
    numbers = r"-?\d+\.\d+"
    urdf = export_urdf(X_BC)
    xyz, rpy = re.findall(rf'"({numbers} {numbers} {numbers})"', urdf)
    from_urdf = RigidTransform(RollPitchYaw(*map(float, rpy.split())), list(map(float, xyz.split())))
    ur = [float(v) for v in re.findall(numbers, export_ur_pose(X_BC))]
    from_ur = RigidTransform(RotationMatrix(exp_rotation(np.array(ur[3:]))), ur[:3])
    ros = dict(re.findall(rf"--(\S+) ({numbers})", export_ros2(X_BC)))
    # nine decimals
    assert np.allclose(from_urdf.GetAsMatrix34(), X_BC.GetAsMatrix34(), atol=1e-8)
    assert np.allclose(from_ur.GetAsMatrix34(), X_BC.GetAsMatrix34(), atol=1e-8)
    assert np.allclose([float(ros[k]) for k in "xyz"], X_BC.translation(), atol=1e-8)
    q = X_BC.rotation().ToQuaternion()
    assert np.allclose([float(ros[k]) for k in ("qw", "qx", "qy", "qz")], q.wxyz(), atol=1e-8)
    assert np.allclose(json.loads(export_json(result))["X_BC"], X_BC.GetAsMatrix4())
    assert all(path.is_file() for path in export_all(result, tmp_path / "exports"))


def test_the_urdf_is_one_xml_document_with_its_note_inside(result: CalibrationResult, tmp_path: Path) -> None:
    corrected = replace(result, scanner_correction={"scale": 1.002, "gradient_per_m": [0.01, -0.01]})
    for k, one in enumerate((result, corrected)):
        export_all(one, tmp_path / str(k))
        root = ET.parse(tmp_path / str(k) / "scanner.urdf.xacro").getroot()
        assert root.tag == "robot"
        assert [e.tag for e in root] == ["link", "joint"]
        assert ("multiply every point" in (tmp_path / str(k) / "scanner.urdf.xacro").read_text()) == (one is corrected)


def test_every_export_says_what_of_a_refinement_it_cannot_hold(result: CalibrationResult, tmp_path: Path) -> None:
    refined = replace(result, local_field={"length_m": 0.1}, kinematics_file="kinematics.yaml")
    for path in export_all(refined, tmp_path):
        text = path.read_text()
        assert "cannot hold the local field" in text, path.name
        assert "the kinematics of kinematics.yaml" in text, path.name
    assert load_result(save_result(refined, tmp_path)).local_field == {"length_m": 0.1}


@pytest.mark.parametrize(
    ("old", "new", "sentence"), [("schema: 1", "schema: 9", "schema 1"), ("X_BC:", "X_BD:", "not a calibration result")]
)
def test_a_file_that_is_no_calibration_is_named(
    result: CalibrationResult, tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    path = save_result(result, tmp_path)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=sentence):
        load_result(path)


def test_a_rotation_changed_by_hand_is_noticed(result: CalibrationResult, tmp_path: Path) -> None:
    path = save_result(result, tmp_path)
    text = path.read_text()
    first = f"{X_BC.rotation().matrix()[0, 0]}"
    assert first in text
    path.write_text(text.replace(first, "0.5"))
    with pytest.raises(InputError, match="not orthonormal"):
        load_result(path)


@pytest.mark.parametrize("key", ["xyz", "wxyz"])
def test_a_pose_changed_in_one_of_its_forms_is_refused(result: CalibrationResult, tmp_path: Path, key: str) -> None:
    path = save_result(result, tmp_path)
    document = yaml.safe_load(path.read_text(encoding="utf-8"))
    document["X_BC"][key][0] += 2e-5
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    with pytest.raises(InputError, match=rf"X_BC.matrix and X_BC.{key} differ: change both"):
        load_result(path)


def test_a_missing_result_says_what_to_give(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="folder written by 'weldcal calibrate'"):
        load_result(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("used: true", "used: maybe", r"poses\[0\]\.used must be true or false, not 'maybe'"),
        ("residual_mm: 0.1", "residual_mm: [0.1]", r"poses\[0\]\.residual_mm must be a number"),
        (
            "residual_mm: 0.1",
            "residuum_mm: 0.1",
            r"poses\[0\]\.residuum_mm is not a known key: did you mean residual_mm",
        ),
        ("held_out_mm: {", "held_out_mm: {worst: big, ", r"held_out_mm\.worst must be a finite number, not 'big'"),
        ("seed: 7", "seed: -1", "seed must be a finite number, 0 or more, not '-1'"),
        ("seed: 7", "seed: 1.5", "seed must be a whole number"),
        ("rotation_deg: [0.0, 0.1, 0.2]", "rotation_deg: [0.0, 0.1]", r"icp\[0\]\.rotation_deg must be 3 numbers"),
        ("warnings: [one]", "warnings: one", "warnings must be a list, not 'one'"),
        ("sigma_position_mm: 0.0", "sigma_position_mm: .nan", "sigma_position_mm must be a finite number"),
        ("axis_turn_deg: null", "axis_turn_deg: [1.0]", "axis_turn_deg must be 2 finite numbers"),
        (
            "joint_covariance: null",
            "joint_covariance: {matrix: [[1]]}",
            r"joint_covariance\.matrix must be as large as X_BC",
        ),
        ("data_sha256: {", "data_sha256: {x: [1], ", r"data_sha256\.x must be a text"),
        ("schema: 1", "schema: 1\nschema: 1", "the key 'schema' twice"),
        ("robot: ur10e", "robot: [ur10e]", "robot must be a text"),
    ],
)
def test_a_value_changed_by_hand_is_named_with_file_and_key(
    result: CalibrationResult, tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    path = save_result(result, tmp_path)
    text = path.read_text()
    assert old in text, text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=sentence) as caught:
        load_result(path)
    assert "'calibration.yaml'" in str(caught.value)


def test_a_covariance_that_is_none_is_refused(result: CalibrationResult, tmp_path: Path) -> None:
    from dataclasses import replace

    save_result(replace(result, covariance=-np.eye(6)), tmp_path)
    with pytest.raises(InputError, match=r"covariance\.matrix is no covariance"):
        load_result(tmp_path)


def test_a_result_corrects_points_and_names_how(result: CalibrationResult, tmp_path: Path) -> None:
    points = np.array([[0.1, -0.2, 0.7], [np.nan, 0.0, 0.5]])
    assert np.array_equal(result.correct(points), points, equal_nan=True)
    assert correction_note(result, tmp_path) is None
    corrected = replace(result, scanner_correction={"scale": 1.002, "gradient_per_m": [0.01, -0.01]})
    assert corrected.correct(points)[0] == pytest.approx(points[0] * (1.002 + 0.01 * 0.1 + 0.01 * 0.2), abs=1e-12)
    grid, cloud = points.reshape(1, 2, 3), open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[:1]))
    assert np.array_equal(corrected.correct(grid)[0], corrected.correct(points), equal_nan=True)
    assert corrected.correct(cloud) == pytest.approx(corrected.correct(points)[:1])
    with pytest.raises(InputError, match=r"\(N, 3\) or \(H, W, 3\) in metres; these are \(5, 4\)"):
        corrected.correct(np.ones((5, 4)))
    file = save_result(corrected, tmp_path)
    note = correction_note(corrected, file) or ""
    assert f"'weldcal apply {file}' and the name of a scan" in note
    assert "multiply" not in note
    call = note.split("in Python ")[1].rstrip(".")
    assert eval(call, {"weldcal": weldcal, "points": points})[0] == pytest.approx(corrected.correct(points)[0])


@pytest.mark.parametrize("unit", [1.0, 1e3])
@pytest.mark.parametrize("form", [".ply", ".npy", ".csv", ".pcd"])
def test_apply_corrects_a_cloud_and_maps_it_into_the_base(
    result: CalibrationResult, tmp_path: Path, form: str, unit: float
) -> None:
    points = np.random.default_rng(4).uniform([-0.2, -0.2, 0.5], [0.2, 0.2, 0.9], (200, 3))
    file = save_result(replace(result, scanner_correction={"scale": 1.002, "gradient_per_m": [0.01, -0.01]}), tmp_path)
    np.save(tmp_path / "scan.npy", unit * np.vstack([points, np.full(3, np.nan)]))
    for base, matrix in ((False, np.eye(4)), (True, result.X_BC.GetAsMatrix4())):
        written = tmp_path / f"{base}{form}"
        call = ["apply", str(file), str(tmp_path / "scan.npy"), str(written), "--json"] + ["--base"] * base
        told = CliRunner().invoke(app, call)
        assert told.exit_code == 0, told.output
        assert json.loads(told.stdout)["unit"] == ("m" if unit == 1.0 else "mm")
        scale = 1.002 + 0.01 * points[:, :1] - 0.01 * points[:, 1:2]
        expected = (points * scale) @ matrix[:3, :3].T + matrix[:3, 3]
        found = read_cloud(written) / unit
        assert found[np.isfinite(found).all(axis=1)] == pytest.approx(expected, abs=1e-7)
    again = CliRunner().invoke(app, call)
    assert again.exit_code == 1
    assert "--overwrite" in again.output


def test_apply_corrects_a_scan_of_a_scanner_on_the_flange_and_refuses_the_base(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_text("schema: 1\nX_FC: {}\nscanner_correction: {scale: 1.01, gradient_per_m: [0.0, 0.0]}\n")
    np.save(tmp_path / "scan.npy", np.full((40, 3), 0.5) + 0.01 * np.arange(120).reshape(40, 3))
    call = ["apply", str(file), str(tmp_path / "scan.npy"), str(tmp_path / "to.npy")]
    assert CliRunner().invoke(app, call).exit_code == 0
    assert np.load(tmp_path / "to.npy") == pytest.approx(1.01 * np.load(tmp_path / "scan.npy"))
    refused = CliRunner().invoke(app, [*call, "--base", "--overwrite"])
    assert refused.exit_code == 1
    assert "scanner on the flange (X_FC)" in refused.output
