"""A part from a STEP file is welded in the whole cell, with the keys and the accuracy of the package's own plates."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from weldcal.tools.cli.app import app
from weldcal.tools.worlds.parts.cells import Trial, write_cell
from weldcal.tools.worlds.parts.step_parts import PARTS


def test_two_fillets_are_welded_one_after_the_other_from_a_step_file(tmp_path: Path) -> None:
    """Both sides of a T, the ends cut off; between them the arm goes home and the part is looked at again."""
    trial = Trial(located_by="drawing", translation_mm=1.0, rotation_deg=0.3, bow_mm=0.3)
    cell = write_cell(PARTS["straight_web"](), tmp_path, trial)
    (tmp_path / "far.csv").write_text("-100,5,0\n100,5,0\n")
    one = "{polyline: straight_web.csv"
    text = cell.read_text().replace(
        f"{one}}}", f"{one}, start_mm: 80, end_mm: 100}}, {{polyline: far.csv, start_mm: 90, end_mm: 90}}"
    )
    # three times as fast as usual, which is harder to hold and is over sooner
    cell.write_text(text.replace("welding: {", "welding: {speed_mm_s: 24.0, "))
    out = tmp_path / "run"
    result = CliRunner().invoke(
        app, ["weld", "--scenario", str(cell), "--json", "--no-browser", "--seed", "0", "--out", str(out)]
    )
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout.splitlines()[-1])
    assert found["state"] == "done"
    assert found["plan_mean_mm"] > 0.15  # the drawing's pose is wrong: without touch the torch would be as far off
    assert len(found["seams"]) == 2
    for seam in found["seams"]:
        assert seam["torch_mean_mm"] < 0.10
        assert seam["torch_max_mm"] < 0.40
    assert max(seam["torch_max_mm"] for seam in found["seams"]) == found["torch_max_mm"]
    assert 35.0 < found["welded_mm"] < 48.0
