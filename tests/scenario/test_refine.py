"""`calibrate --refine local` and the verification of what it wrote, by their commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform
from typer.testing import CliRunner

from tests.calibration.eye_on_base.test_tcp import _pairs
from tests.calibration.refinement.test_local_field import _scans
from tests.worlds.wrong_models import station
from weldcal.calibration.data.results import load_result, save_result
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.recorded_flange import FlangeOptions
from weldcal.calibration.refinement.kinematics_choice import kinematics_text
from weldcal.calibration.refinement.kinematics_fit import KinematicsFit, arm_errors
from weldcal.models.arms.chain import load_chain
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.recorded import calibrate_dataset
from weldcal.tools.verified import verify_dataset


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The plain and the refined calibration of the same 24 pairs."""
    top = tmp_path_factory.mktemp("refine")
    data = _pairs(top / "scans", _scans(24, 0))
    plain, local = top / "plain", top / "local"
    calibrate_dataset(data, plain)
    done = CliRunner().invoke(app, ["calibrate", str(data), "--refine", "local", "--out", str(local), "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)["refinement"]
    assert said["accepted"], said["sentence"]
    return plain, local


def _error(result: Path, data: Path, out: Path) -> tuple[float, float]:
    """Median error and limit, mm."""
    report = verify_dataset(result, data, out)
    assert report.verdict.limit_mm is not None
    return report.position_error_mm["median"], report.verdict.limit_mm


def test_verify_uses_the_field_near_the_poses(results: tuple[Path, Path], tmp_path: Path) -> None:
    new = _pairs(tmp_path / "new", _scans(20, 1))
    plain, local = (_error(r, new, tmp_path / r.name) for r in results)
    assert local[0] < 0.75 * plain[0]
    assert local[0] < local[1]
    done = CliRunner().invoke(app, ["verify", str(results[1]), str(new), "--out", str(tmp_path / "cli"), "-v"])
    assert f"error, median {local[0]:.3f} mm (bootstrap 95 %:" in " ".join(done.output.split())


def test_at_another_orientation_verify_gives_the_plain_error_and_a_larger_limit(
    results: tuple[Path, Path], tmp_path: Path
) -> None:
    near, turned = _pairs(tmp_path / "near", _scans(1, 2)), _pairs(tmp_path / "turned", _scans(1, 2, turn_deg=50.0))
    plain, local = (_error(r, turned, tmp_path / r.name) for r in results)
    assert local[0] == pytest.approx(plain[0], rel=1e-3)
    # the reported 95 % of the held-out errors is a floor of either limit
    without_floor = replace(load_result(results[1]), held_out_mm={})
    (tmp_path / "bare").mkdir()
    save_result(without_floor, tmp_path / "bare")
    limits = [_error(tmp_path / "bare", data, tmp_path / f"v{data.name}")[1] for data in (near, turned)]
    assert limits[1] > 1.5 * limits[0]


def _with_angles(folder: Path, scans: list[Observation], q: Array) -> Path:
    """A dataset of pairs with the joint angles."""
    table = _pairs(folder, scans) / "pairs.csv"
    head, *rows = table.read_text().splitlines()
    head += "".join(f",q{i + 1}" for i in range(6))
    rows = [",".join([row, *(repr(float(v)) for v in angles)]) for row, angles in zip(rows, q, strict=True)]
    table.write_text("\n".join([head, *rows]) + "\n")
    return folder


def test_refined_joints_come_as_a_kinematics_file_that_verify_uses(tmp_path: Path) -> None:
    world = station(10, links=False)
    data = _with_angles(tmp_path / "scans", world.observations, world.q)
    new = _with_angles(tmp_path / "new", world.new, world.new_q)
    found = calibrate_dataset(data, tmp_path / "joints", FlangeOptions(refine="joints"))
    assert found.refinement is not None
    assert found.refinement["accepted"], found.refinement["sentence"]
    assert "another robot" not in found.refinement["sentence"]
    assert [e["name"].split()[1] for e in found.refinement["errors"]] == ["offset"] * 4
    calibrate_dataset(data, tmp_path / "plain", FlangeOptions(correct_scanner=False))
    refined, plain = (_error(tmp_path / name, new, tmp_path / f"v_{name}") for name in ("joints", "plain"))
    assert refined[0] < 0.5 * plain[0]
    assert refined[0] < refined[1] < 0.5 * plain[1]
    # the table of the new scans without joint angles: the stated poses, and a sentence
    bare = _pairs(tmp_path / "bare", world.new)
    assert any("no joint angles" in w for w in verify_dataset(tmp_path / "joints", bare, tmp_path / "v_bare").warnings)
    # the corrected arm takes errors no more: its kinematics are the file's
    with pytest.raises(InputError, match=r"--kinematics"):
        calibrate_dataset(data, tmp_path / "again", FlangeOptions(refine="joints", kinematics=_turned(tmp_path)))


def _turned(folder: Path) -> Path:
    """The kinematics of an arm whose elbow stands two millimetres elsewhere."""
    nothing = arm_errors(load_chain("ur10e"), "links")
    u = np.zeros(len(nothing.which))
    u[nothing.names.index("elbow_joint shift x")] = 2e-3 / 1.2e-4
    fit = KinematicsFit(
        X_BC=RigidTransform(),
        correction=ScannerCorrection(),
        u=u,
        covariance=np.eye(1),
        sigma_position_m=1.0,
        sigma_normal_rad=1.0,
        redundancy=1.0,
        errors=nothing,
    )
    (folder / "other.yaml").write_text(kinematics_text(fit, "another arm"))
    return folder / "other.yaml"


def test_joint_angles_are_asked_for_and_a_dataset_without_them_is_named(tmp_path: Path) -> None:
    data = _pairs(tmp_path / "scans", station(7, links=False).observations)
    with pytest.raises(DatasetError, match="add the columns q1 to q6"):
        calibrate_dataset(data, tmp_path / "out", FlangeOptions(refine="joints"))
    with pytest.raises(InputError, match="use --refine local"):
        calibrate_dataset(data, tmp_path / "out", FlangeOptions(refine="joints", robot="aubo_i5"))


def test_a_refinement_that_does_not_exist_is_named_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Choose one of local, joints, links"):
        calibrate_dataset(tmp_path / "absent", tmp_path / "out", FlangeOptions(refine="magic"))
