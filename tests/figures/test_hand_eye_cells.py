"""The benchmark of hand-eye cells counts in how many of them OpenCV is ahead."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.figures.__main__ import app
from tests.figures.hand_eye import cells as cells_study


def test_the_command_tells_how_often_opencv_is_ahead(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cells_study, "KINDS", ("robot",))
    call = ["benchmark", "hand-eye-cells", "--runs", "1", "--json", "--out", str(tmp_path)]
    found = CliRunner().invoke(app, call)
    assert found.exit_code == 0, found.output
    cells = json.loads(found.output.splitlines()[-1])["cells"]
    assert cells["all, weldcal"] == cells["robot, weldcal"]
    assert set(cells["all, weldcal"]) == {"opencv_ahead_percent", "p95_deg", "p95_mm"}
