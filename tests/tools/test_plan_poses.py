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


def test_what_cannot_be_planned_is_named_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="choose one of joints, links"):
        plan_refining_poses("calibrate_only", tmp_path, kind="wrists")
    with pytest.raises(InputError, match="need 12 scans"):
        plan_refining_poses("calibrate_only", tmp_path, scans=5)
