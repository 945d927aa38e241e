"""`weldcal doctor` on results, datasets and refused calibrations: the cause that was put in is named, and real data
have none."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.places import SHARED_DATA, needs
from tests.worlds.doctor import COLUMNS, HEADER, write_cell
from weldcal.calibration.data.dataset import load_dataset
from weldcal.tools.cli.app import app
from weldcal.tools.commands.doctor import weld_causes

AUBO = SHARED_DATA / "flange" / "aubo_i5_phoxi_s"


def causes(path: Path) -> list[dict[str, str]]:
    found = CliRunner().invoke(app, ["doctor", str(path), "--json"])
    assert found.exit_code == 0, found.output
    return list(json.loads(found.stdout.splitlines()[-1])["causes"])


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    write_cell(tmp_path / "cell", "none", 1, np.random.default_rng(8))
    return tmp_path / "cell" / "2026-01"


def test_a_good_result_has_no_cause(pairs: Path, tmp_path: Path) -> None:
    out = tmp_path / "result"
    assert CliRunner().invoke(app, ["calibrate", str(pairs), "--out", str(out), "--json"]).exit_code == 0
    assert causes(out) == []
    assert causes(out / "calibration.yaml") == []
    assert causes(pairs) == []


def test_a_calibration_that_is_refused_leaves_what_the_doctor_needs(pairs: Path, tmp_path: Path) -> None:
    # the scanner moves by 6 mm after half of the scans
    lines = (pairs / "pairs.csv").read_text().splitlines()
    k = COLUMNS.index("camera_x")
    for row in range(len(lines) // 2, len(lines)):
        cells = lines[row].split(",")
        cells[k] = repr(float(cells[k]) + 0.006)
        lines[row] = ",".join(cells)
    (pairs / "pairs.csv").write_text("\n".join(lines) + "\n")
    out = tmp_path / "result"
    assert CliRunner().invoke(app, ["calibrate", str(pairs), "--out", str(out), "--json"]).exit_code == 1
    assert [path.name for path in out.iterdir()] == ["observations.csv"]
    first = causes(out)[0]
    assert first["name"] == "scanner moved"
    assert "--poses" in first["next"]


def test_a_place_without_anything_to_examine_is_refused(tmp_path: Path) -> None:
    for path, said in ((tmp_path / "none", "There is no"), (tmp_path, "dataset")):
        found = CliRunner().invoke(app, ["doctor", str(path)])
        assert found.exit_code == 1
        assert said in found.output


def test_units_that_cannot_be_are_a_cause_and_no_error(pairs: Path) -> None:
    (pairs / "dataset.yaml").write_text(HEADER.replace("poses: m}", "poses: mm}"))
    assert causes(pairs)[0]["name"] == "unit mix"


def test_a_held_weld_names_the_hidden_tag_or_its_own_reason() -> None:
    hidden = weld_causes(
        None, "Tag hidden: the finger camera has not seen it for 0.20 s; clean the tag and its window."
    )
    assert [cause.name for cause in hidden] == ["hidden tag"]
    assert [cause.name for cause in weld_causes(None, "The seam ended.")] == ["the run was held"]
    assert weld_causes(None, "") == ()


@needs(AUBO)
def test_real_scans_have_no_cause_and_those_of_another_flange_do(tmp_path: Path) -> None:
    few = tmp_path / "few"
    few.mkdir()
    ids = list(load_dataset(AUBO).clouds)[:9]
    rows = (AUBO / "poses.csv").read_text().splitlines()
    (few / "poses.csv").write_text("\n".join([rows[0], *(r for r in rows[1:] if r.split(",")[0] in ids)]) + "\n")
    (few / "dataset.yaml").write_text((AUBO / "dataset.yaml").read_text())
    (few / "clouds").mkdir()
    for path in (AUBO / "clouds").iterdir():
        if path.stem in ids:
            shutil.copy(path, few / "clouds")
    assert causes(few) == []
    header = (few / "dataset.yaml").read_text()
    assert "50-4-m6" in header
    (few / "dataset.yaml").write_text(header.replace("50-4-m6", "80-6-m8"))
    assert causes(few)[0]["name"] == "wrong flange size"
