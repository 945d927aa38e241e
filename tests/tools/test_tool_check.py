"""`weldcal tool check`: what it understood of a tool, its drawing, and one sentence for a tool that cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
from typer.testing import CliRunner

from weldcal.models.tools.loading import WELDING
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
