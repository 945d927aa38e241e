"""`weldcal calibrate` refuses a recording in which the scanner moved, names the place and calibrates either part."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform
from typer.testing import CliRunner

from tests.calibration.eye_on_base.test_change_point import moved
from tests.calibration.eye_on_base.test_joint_fit import RIGHT, X_BC, _cell
from weldcal.calibration.flange.observation import Observation
from weldcal.tools.cli.app import app

HEADER = "id,base_x,base_y,base_z,base_qw,base_qx,base_qy,base_qz,camera_x,camera_y,camera_z"


def write_pairs(folder: Path, observations: list[Observation]) -> Path:
    """A dataset folder of pairs, in metres."""
    folder.mkdir()
    rows = [HEADER]
    for o in observations:
        q = o.X_BR.rotation().ToQuaternion().wxyz()
        rows.append(",".join([o.id, *(f"{v:.9f}" for v in (*o.p_BR, *q, *o.p_CR))]))
    (folder / "pairs.csv").write_text("\n".join(rows) + "\n")
    (folder / "dataset.yaml").write_text(
        "schema: 1\nrobot: ur10e\nflange: iso9409-1-50-4-m6\nscanner: any\nconfiguration: eye_on_base\nunits: {clouds:"
        " m, poses: m}\n"
    )
    return folder


def test_the_change_is_named_and_both_parts_can_be_calibrated(tmp_path: Path) -> None:
    observations, _ = _cell(RIGHT, n=20, seed=6)
    folder, out = write_pairs(tmp_path / "knocked", moved(observations, 11, 2e-3)), tmp_path / "out"
    refused = CliRunner().invoke(app, ["calibrate", str(folder), "--out", str(out), "--json"])
    assert refused.exit_code == 1
    answer = json.loads(refused.stdout.splitlines()[-1])
    assert "moved between 'p10' and 'p11'" in answer["reason"]
    assert "--poses :p10 (11 scans) or --poses p11: (9 scans)" in answer["reason"]
    assert answer["change_point"]["shift_mm"] == pytest.approx(2.0, abs=0.3)
    assert [part["n"] for part in answer["change_point"]["parts"]] == [11, 9]
    assert [path.name for path in out.iterdir()] == ["observations.csv"], "a wrong calibration is not exported"
    for option, part in zip((":p10", "p11:"), answer["change_point"]["parts"], strict=True):
        words = ["calibrate", str(folder), "--out", str(out), "--overwrite", "--poses", option, "--json"]
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, done.output
        X = np.array(json.loads(done.stdout.splitlines()[-1])["X_BC"])
        assert pytest.approx(np.array(part["X_BC"]), abs=1e-4) == X
    before = RigidTransform(np.array(answer["change_point"]["parts"][0]["X_BC"]))
    assert np.linalg.norm(before.translation() - X_BC.translation()) < 1e-3


@pytest.mark.parametrize(
    ("option", "sentence"),
    [("p03", "no range"), ("p03:p99", "no usable pose 'p99'"), ("p09:p03", "write --poses p03:p09")],
)
def test_a_range_that_is_none_is_refused(tmp_path: Path, option: str, sentence: str) -> None:
    observations, _ = _cell(RIGHT, n=12)
    folder = write_pairs(tmp_path / "still", observations)
    refused = CliRunner().invoke(app, ["calibrate", str(folder), "--out", str(tmp_path / "out"), "--poses", option])
    assert refused.exit_code == 1
    assert sentence in refused.output
