"""`weldcal plan-poses`: the poses are the arm's own, differ in orientation, and come as a dataset's table."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from tests.worlds.other_arms import pose_by_table, urdf_by_table
from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.commands.plan import plan_refining_poses


def test_the_table_holds_poses_and_the_joint_angles_that_lead_there(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["plan-poses", "--scans", "12", "--out", str(tmp_path / "plan"), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["scans"] == 12
    assert found["chosen_from"] >= 24
    # errors of an arm are refused below 20 degrees
    assert found["turn_deg"] > 40.0
    rows = list(csv.DictReader((tmp_path / "plan" / "poses.csv").open()))
    assert len({r["id"] for r in rows}) == 12
    arm = load_arm("ur10e")
    for row in rows:
        reached = forward_kinematics(arm, [float(row[f"q{i + 1}"]) for i in range(6)])
        R = RotationMatrix(Rotation.from_quat([float(row[k]) for k in ("qx", "qy", "qz", "qw")]).as_matrix())
        off = reached.inverse() @ RigidTransform(R, [float(row[k]) for k in "xyz"])
        assert np.linalg.norm(off.translation()) < 1e-5
        assert np.linalg.norm(rotation_vector(off.rotation())) < 1e-5
    script = (tmp_path / "plan" / "poses.script").read_text()
    assert script.count("movej([") == 12


def test_an_arm_by_its_urdf_is_planned_for(tmp_path: Path) -> None:
    (tmp_path / "mine.urdf").write_text(urdf_by_table("xarm6"))
    out = tmp_path / "plan"
    asked = ["--scans", "12", "--robot", str(tmp_path / "mine.urdf"), "--out", str(out), "--json"]
    done = CliRunner().invoke(app, ["plan-poses", *asked])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["scans"] == 12
    assert found["turn_deg"] > 40.0
    assert "mine.urdf has no shapes" in found["bodies"]
    rows = list(csv.DictReader((out / "poses.csv").open()))
    for row in rows:
        q = np.array([float(row[f"q{i + 1}"]) for i in range(6)])
        assert np.abs(q).max() <= 3.1
        X = pose_by_table("xarm6", q)
        assert np.abs(X[:3, 3] - [float(row[k]) for k in "xyz"]).max() < 1e-5
        R = Rotation.from_quat([float(row[k]) for k in ("qx", "qy", "qz", "qw")])
        assert (R.inv() * Rotation.from_matrix(X[:3, :3])).magnitude() < 1e-5
        assert X[2, 3] > 0.0  # above the table
    assert not (out / "poses.script").exists()  # URScript is for another controller


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("none.urdf", "There is no file 'none.urdf'"),
        ("aubo", "Only [0-9]+ of|No pose"),
        ("kuka", "'kuka' is not known"),
    ],
)
def test_an_arm_that_cannot_be_planned_for_is_named(tmp_path: Path, name: str, said: str) -> None:
    low = tmp_path / "low.yaml"
    low.write_text("extends: calibrate_only\ncalibration: {mounting_guess: {xyz_m: [3.0, 0.0, 0.9]}}\n")
    with pytest.raises((InputError, UnreachableScanner), match=said):
        plan_refining_poses(str(low), tmp_path / "out", scans=12, robot=name)


def test_what_cannot_be_planned_is_named_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="choose one of joints, links"):
        plan_refining_poses("calibrate_only", tmp_path, kind="wrists")
    with pytest.raises(InputError, match="need 12 scans"):
        plan_refining_poses("calibrate_only", tmp_path, scans=5)
