"""`calibrate --refine local` and the verification of what it wrote, by their commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.calibration.eye_on_base.test_tcp import _pairs
from tests.calibration.refinement.test_local_field import _scans
from weldcal.calibration.data.results import load_result, save_result
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.commands.calibrate import calibrate_dataset
from weldcal.tools.commands.verify import verify_dataset


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
    done = CliRunner().invoke(app, ["verify", str(results[1]), str(new), "--out", str(tmp_path / "cli")])
    assert f"error, median    {local[0]:.3f} mm (bootstrap 95 %:" in done.output


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


def test_a_refinement_that_does_not_exist_is_named_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Choose one of local, joints, links"):
        calibrate_dataset(tmp_path / "absent", tmp_path / "out", refine="magic")
