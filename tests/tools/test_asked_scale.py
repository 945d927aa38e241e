"""What calibrate names and cannot confirm, doctor names too; a flange that is missing is said before any cloud."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.documents.scans import write_scans
from weldcal.calibration.doctor.case import read_case
from weldcal.calibration.recorded_flange import FlangeOptions
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.commands.doctor import diagnose_dataset
from weldcal.tools.recorded import calibrate_dataset


def test_doctor_names_the_scale_that_calibrate_names(tmp_path: Path) -> None:
    data = write_scans(tmp_path / "scans", 7, 3, scale=0.998, holes=False)
    for name, folder in (("wrong", data), ("right", write_scans(tmp_path / "right_scans", 7, 3, holes=False))):
        report = calibrate_dataset(folder, tmp_path / name)
        asked = [text for text in report.result.warnings if "motion asks for a scale of" in text]
        done = CliRunner().invoke(app, ["doctor", str(tmp_path / name), "--json"])
        causes = json.loads(done.stdout.splitlines()[-1])["causes"]
        assert len(asked) == (name == "wrong")
        assert [cause["evidence"] for cause in causes if cause["name"] == "scanner scale error"] == asked
    assert "+0.2" in read_case(tmp_path / "wrong" / "observations.csv").asked
    said = CliRunner().invoke(app, ["doctor", str(tmp_path / "wrong")]).stdout
    assert "no cause found" not in said
    assert "show the flange's holes" in " ".join(said.split())


@pytest.mark.parametrize("plain", [True, False])
def test_a_missing_flange_is_said_before_any_cloud(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plain: bool
) -> None:
    data = write_scans(tmp_path / "scans", 4, 0)
    header = (data / "dataset.yaml").read_text()
    if plain:
        (data / "dataset.yaml").write_text(header.replace("flange: iso9409-1-50-4-m6", "flange: ''"))
    else:
        (data / "dataset.yaml").unlink()
    read: list[str] = []

    def digest(path: Path) -> str:
        read.append(path.name)
        return ""

    monkeypatch.setattr("weldcal.calibration.data.dataset.digest", digest)
    wanted = r"did you mean that of the ur10e\? Add --flange iso9409-1-50-4-m6, or write 'flange: iso9409-1-50-4-m6'"
    with pytest.raises(InputError, match=wanted):
        calibrate_dataset(data, tmp_path / "out", FlangeOptions(robot=None if plain else "ur10e"))
    with pytest.raises(InputError, match="No flange is named"):
        diagnose_dataset(data, None, 0)
    with pytest.raises(InputError, match="Flange '50-7-M6' is not known"):
        calibrate_dataset(data, tmp_path / "out", FlangeOptions(flange="50-7-M6"))
    assert read == []
