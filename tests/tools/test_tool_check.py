"""`weldcal tool check`: what it understood of a tool, its drawing, and one sentence for a tool that cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
from typer.testing import CliRunner

from tests.calibration.tool.torches import Wrong, cell, written
from weldcal.models.tools.loading import WELDING, load_tool
from weldcal.tools.cli.app import app


def test_a_tool_is_told_and_drawn(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(WELDING.read_text().replace("-60.0, 0.0, 171.5", "-70.0, 10.0, 171.5"))
    found = CliRunner().invoke(app, ["tool", "check", str(file), "--out", str(tmp_path / "out"), "--json"])
    assert found.exit_code == 0, found.output
    told = json.loads(found.stdout.strip().splitlines()[-1])
    assert told["state"] == "done"
    assert told["torch"]["xyz_mm"] == [-70.0, 10.0, 171.5]
    assert round(told["torch"]["behind_tip_mm"], 3) == 70.711
    assert told["feature"] == "tool_ring"
    assert round(told["tag"]["side_px"], 1) == 112.5  # 450 px * 10 mm / 40 mm
    picture = cv2.imread(str(tmp_path / "out/tool.png"))
    assert picture is not None
    assert picture.std() > 20.0
    page = (tmp_path / "out/tool.html").read_text()
    assert "70.7 mm behind the tip" in page
    assert "data:image/png" in page
    shown = CliRunner().invoke(app, ["tool", "check", str(file), "--out", str(tmp_path / "out"), "--overwrite"])
    assert "wire point at (-70, 10, 171.5) mm, 70.7 mm behind the tip" in " ".join(shown.output.split())


def test_a_tool_that_cannot_be_is_one_sentence_and_no_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(WELDING.read_text().replace("radius_mm: 2.5", "radius: 2.5"))
    found = CliRunner().invoke(app, ["tool", "check", str(file), "--out", str(tmp_path / "out")])
    assert found.exit_code == 1
    assert "'mine.yaml': tip.radius is not a known key: did you mean radius_mm?" in found.output
    assert not (tmp_path / "out").exists()


def test_a_bent_torch_is_said_and_its_file_written(tmp_path: Path) -> None:
    written(cell(11, Wrong(bend=2e-3, tilt=0.013), scans=8, touches=8), tmp_path)
    given = ["--calibration", str(tmp_path / "result"), "--touches", str(tmp_path / "touches.csv")]
    words = ["tool", "check", str(WELDING), "--measure", str(tmp_path / "scans"), *given, "--json"]
    found = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert found.exit_code == 1, found.output
    told = json.loads(found.stdout.strip().splitlines()[-1])
    assert told["tolerance"] == "does not hold"
    assert told["cause"].startswith("The torch is bent: its axis is turned by 0.7")
    assert abs(told["moved"]["wire"]["by_mm"] - 2.0) < 0.15
    assert told["moved"]["wire"]["moved"]
    assert not told["moved"]["tip"]["moved"]
    measured = load_tool(tmp_path / "out/tool.yaml")
    assert abs(1e3 * measured.p_FW - told["torch"]["xyz_mm"]).max() < 1e-3
    assert "The torch is bent" in (tmp_path / "out/report.html").read_text()


def test_what_measuring_needs_is_said_before_any_work(tmp_path: Path) -> None:
    scans = ["tool", "check", str(WELDING), "--measure", str(tmp_path)]
    found = CliRunner().invoke(app, [*scans, "--out", str(tmp_path / "out")])
    assert found.exit_code == 1
    assert "--measure needs --calibration RESULT" in found.output
    assert not (tmp_path / "out").exists()
