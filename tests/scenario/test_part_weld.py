"""A part from a STEP file is welded in the whole cell, with the keys and the accuracy of the package's own plates."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform
from typer.testing import CliRunner

from tests.worlds.parts.cells import PartTrial, write_cell
from tests.worlds.parts.step_parts import PARTS, MadePart, assembly, box
from weldcal.models.mesh import extrude, merge
from weldcal.models.workpieces.part import Part
from weldcal.systems import station
from weldcal.tools.cli.app import app


def test_two_fillets_are_welded_one_after_the_other_from_a_step_file(tmp_path: Path) -> None:
    """Both sides of a T, the ends cut off; between them the arm goes home and the part is looked at again."""
    trial = PartTrial(located_by="drawing", translation_mm=1.0, rotation_deg=0.3, bow_mm=0.3)
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
    for key in ("torch_max_mm", "torch_first_max_mm", "torch_last_max_mm"):
        assert max(seam[key] for seam in found["seams"]) == found[key]
    assert 35.0 < found["welded_mm"] < 48.0


def test_two_plates_without_a_gap_are_welded_and_the_tip_stays_off(tmp_path: Path) -> None:
    """The arm is exact, the part lies elsewhere than the guess says; nothing is felt, and the report says so."""
    plates = assembly(
        box((0, 0, -8), (220, 60, 8)), box((0, -90, -8), (220, 90, 8)), box((20, -80, 0), (30, 30, 20))
    )  # the block tells the ends apart
    line = np.array([[0.0, 0.0, 0.0], [220.0, 0.0, 0.0]])
    part = MadePart(name="plates", shape=plates, joint="butt", line_mm=line, length_mm=220.0, opening_deg=180.0)
    cell = write_cell(part, tmp_path, PartTrial(bow_mm=0.0, arm_mm=0.0))
    text = cell.read_text().replace("plates.csv}", "plates.csv, start_mm: 80, end_mm: 100}")
    text = text.replace("welding: {", "job: {X_BC_sigma_mm: 0.05}\nwelding: {speed_mm_s: 20.0, ")
    cell.write_text(text)
    out = tmp_path / "run"
    result = CliRunner().invoke(
        app, ["weld", "--scenario", str(cell), "--json", "--no-browser", "--seed", "0", "--out", str(out)]
    )
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout.splitlines()[-1])
    assert found["felt"] == [False]
    assert "followed from the scan and the drawing; not felt" in found["plan_words"]
    assert found["torch_lateral_max_mm"] < 4.0 * found["plan_sigma_mm"] < 1.0
    assert 36.0 < found["welded_mm"] < 41.0
    assert "not felt" in (out / "report.html").read_text()
    assert json.loads((out / "weld.json").read_text())["settings"]["felt"] == [False]
    with (out / "weld.csv").open() as table:
        bent = [float(row["deflection_z_m"]) for row in csv.DictReader(table) if row["deflection_z_m"]]
    assert np.abs(bent).max() < 3e-4  # of the tag's picture, not of a touch


def test_a_nut_beside_the_seam_is_passed_by_lifting_the_tip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A web on a plate with a nut that the drawing does not have: refused, and with pass_obstacles welded before and
    after it."""
    nut = extrude(0.006 * np.column_stack([f(np.arange(6) * np.pi / 3.0) for f in (np.cos, np.sin)]), 0.0, 0.006)
    nut = nut.transformed(RigidTransform([-0.02, -0.0075, 0.0]))

    def as_made(part: Part, *rest: object) -> Part:
        return replace(part, shape=replace(part.shape, mesh=merge(part.mesh, nut)))

    monkeypatch.setattr(station, "made", as_made)
    cell = write_cell(
        PARTS["straight_web"](), tmp_path, PartTrial(translation_mm=1.0, rotation_deg=0.3, bow_mm=0.0, arm_mm=0.0)
    )
    text = cell.read_text().replace("welding: {", "welding: {speed_mm_s: 16.0, ")

    def run(name: str) -> Any:
        result = CliRunner().invoke(
            app,
            ["weld", "--scenario", str(cell), "--json", "--no-browser", "--seed", "0", "--out", str(tmp_path / name)],
        )
        return json.loads(result.stdout.splitlines()[-1])

    cell.write_text(text)
    refused = run("refused")
    assert refused["state"] == "held"
    assert "something that is not in the drawing" in str(refused["reason"])
    cell.write_text(text.replace("welding: {", "welding: {pass_obstacles: true, "))
    found = run("passed")
    assert found["state"] == "done", found
    ((begin, end),) = found["left_out_mm"]
    # the nut is 74 to 86 mm along the seam; the tip is 60 mm ahead of the torch
    assert 5.0 < begin < 80.0 - 60.0
    assert 86.0 < end - 2.0 * 16.0 < 95.0  # two seconds until the torch is on the seam
    assert float(found["welded_mm"]) == pytest.approx(200.0 - (end - begin), abs=2.0)
    assert found["torch_lateral_max_mm"] < 0.1
    assert found["torch_max_mm"] < 0.6
    assert f"{begin:.0f} to {end:.0f} mm: something is in the way" in (tmp_path / "passed" / "report.html").read_text()
