"""A part from a STEP file is welded in the whole cell, with the keys and the accuracy of the package's own plates."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from weldcal.tools.cli.app import app
from weldcal.tools.studies.part_welds.step_parts import PARTS
from weldcal.tools.studies.part_welds.study import Trial, write_cell


def test_a_fillet_is_welded_from_its_step_file(tmp_path: Path) -> None:
    trial = Trial(located_by="drawing", translation_mm=1.0, rotation_deg=0.3, bow_mm=0.3, seam_mm=30.0)
    cell = write_cell(PARTS["straight_web"](), tmp_path, trial)
    out = tmp_path / "run"
    result = CliRunner().invoke(
        app, ["weld", "--scenario", str(cell), "--json", "--no-browser", "--seed", "0", "--out", str(out)]
    )
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout.splitlines()[-1])
    assert found["state"] == "done"
    assert found["plan_mean_mm"] > 0.15  # the drawing's pose is wrong: without touch the torch would be as far off
    assert found["torch_mean_mm"] < 0.10
    assert found["torch_max_mm"] < 0.40
    assert 28.0 < found["welded_mm"] < 40.0
