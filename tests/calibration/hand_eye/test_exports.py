"""What hand-eye writes is read back as the same pose by those it is written for."""

from __future__ import annotations

import json
import re
import shlex
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.yaml import yaml_dump, yaml_load_file
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import LoadModelDirectivesFromString, Parser, ProcessModelDirectives
from pydrake.multibody.plant import MultibodyPlant
from scipy.spatial.transform import Rotation

from tests.calibration.hand_eye.poses import co_manipulation, eye_in_hand
from weldcal.calibration.hand_eye.pairs.files import read_pairs
from weldcal.calibration.recorded_hand_eye import HandEyeOptions
from weldcal.tools.commands.hand_eye import run_hand_eye
from weldcal.tools.report.hand_eye import HandEyeReport

LAST_DIGIT = 2e-9  # of the nine decimals written, rad and m


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[HandEyeReport, Path]:
    folder = tmp_path_factory.mktemp("hand_eye")
    F, G, _, _ = eye_in_hand(10, np.random.default_rng(3), np.radians(0.05), 2e-4)
    np.savez(folder / "a.npz", A=F, B=G, mode="eye_in_hand")
    return run_hand_eye(folder / "a.npz", folder / "out", HandEyeOptions()), folder / "out"


def same(found: RigidTransform, X: RigidTransform) -> None:
    np.testing.assert_allclose(found.GetAsMatrix4(), X.GetAsMatrix4(), atol=LAST_DIGIT)


def test_yaml_and_json_hold_the_whole_pose(written: tuple[HandEyeReport, Path]) -> None:
    report, folder = written
    saved = json.loads((folder / "hand_eye.json").read_text())
    assert (folder / "hand_eye.yaml").read_text() == yaml_dump(saved)
    for whole in (saved, yaml_load_file(str(folder / "hand_eye.yaml"))):
        for symbol, X in (("X_FC", report.result.X), ("X_BM", report.result.Y)):
            p = whole["poses"][symbol]
            np.testing.assert_allclose(np.array(p["matrix"]), X.GetAsMatrix4(), atol=1e-12)
            turned = Rotation.from_quat(p["wxyz"], scalar_first=True).as_matrix()
            same(RigidTransform(RotationMatrix.ProjectToRotationMatrix(turned), p["xyz"]), X)


def test_urdf_says_the_same_pose(written: tuple[HandEyeReport, Path]) -> None:
    report, folder = written
    root = ET.parse(folder / "X_FC.urdf.xacro").getroot()
    assert root.tag == "robot"
    joint = root.find("joint")
    assert joint is not None
    assert [joint.find(k).get("link") for k in ("parent", "child")] == ["tool0", "camera_optical_frame"]  # type: ignore[union-attr]
    origin = joint.find("origin")
    assert origin is not None
    xyz, rpy = ([float(v) for v in str(origin.get(k)).split()] for k in ("xyz", "rpy"))
    same(RigidTransform(RollPitchYaw(*rpy), xyz), report.result.X)


def test_the_terminal_says_the_same_pose_once(written: tuple[HandEyeReport, Path]) -> None:
    report, folder = written
    rows = report.first.rows()
    printed = "\n".join((report.text(), *rows.values()))
    for symbol in ("X_FC", "X_BM"):
        assert printed.count((folder / f"{symbol}.ur_pose.script").read_text().strip()) == 1
    assert [text for text in rows.values() if len(text) > 12 and printed.count(text) > 1] == []


def test_ros_2_says_the_same_pose(written: tuple[HandEyeReport, Path]) -> None:
    report, folder = written
    words = shlex.split((folder / "X_FC.static_transform.sh").read_text())
    said = dict(zip(words[4::2], words[5::2], strict=True))
    assert (said["--frame-id"], said["--child-frame-id"]) == ("tool0", "camera_optical_frame")
    turned = Rotation.from_quat([float(said[f"--q{k}"]) for k in "xyzw"]).as_matrix()
    p = [float(said[f"--{k}"]) for k in "xyz"]
    same(RigidTransform(RotationMatrix.ProjectToRotationMatrix(turned), p), report.result.X)


def test_a_ur_pose_says_the_same_pose(written: tuple[HandEyeReport, Path]) -> None:
    report, folder = written
    text = re.fullmatch(r"p\[(.*)\]\n", (folder / "X_FC.ur_pose.script").read_text())
    assert text is not None
    v = [float(c) for c in text.group(1).split(",")]
    turned = RotationMatrix.ProjectToRotationMatrix(Rotation.from_rotvec(v[3:]).as_matrix())
    same(RigidTransform(turned, v[:3]), report.result.X)


def test_drake_reads_its_own_directive(written: tuple[HandEyeReport, Path]) -> None:
    report, folder = written
    text = (folder / "X_BM.drake.yaml").read_text().replace("base_frame: base", "base_frame: world")
    plant = MultibodyPlant(0.0)
    ProcessModelDirectives(LoadModelDirectivesFromString(text), Parser(plant))
    plant.Finalize()
    X = plant.GetFrameByName("target").CalcPoseInWorld(plant.CreateDefaultContext())
    np.testing.assert_allclose(X.GetAsMatrix4(), report.result.Y.GetAsMatrix4(), atol=LAST_DIGIT)


def test_moveit_s_unnamed_pairs_and_json_with_two_robots_and_joints_are_read(tmp_path: Path) -> None:
    A, B, C, *_ = co_manipulation(4, np.random.default_rng(4))
    pairs = [[a.tolist(), b.tolist()] for a, b in zip(A, B, strict=True)]
    (tmp_path / "pose_samples.json").write_text(json.dumps(pairs))
    read = read_pairs(tmp_path / "pose_samples.json", mounting="eye_on_base")
    np.testing.assert_allclose(read.robot, A, atol=1e-12)
    np.testing.assert_allclose(read.camera, B, atol=1e-12)
    both = {"A": A.tolist(), "B": B.tolist(), "C": C.tolist(), "q": np.arange(24.0).reshape(4, 6).tolist()}
    (tmp_path / "two.json").write_text(json.dumps(both))
    two = read_pairs(tmp_path / "two.json")
    assert two.mode == "co_manipulation"
    assert two.robot2 is not None
    assert two.q is not None
    np.testing.assert_allclose(two.robot2, C, atol=1e-12)
    assert two.q.shape == (4, 6)
