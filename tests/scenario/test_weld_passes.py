"""A seam of one cell is welded in two stitched passes over a tack, the second one backwards, and the result says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from weldcal.models.errors import InputError
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.run import RunOptions

# The arm and the part have the errors of the shipped scenario; of the scanner's, what a calibration leaves.
CELL = """
scanner: !RenderedScanner
  preset: phoxi_m
  width: 824
  height: 616
  mounting_translation_mm: 0.0
  mounting_rotation_deg: 0.0
  scale_error: 0.0
  gradient_error_per_m: [0.0, 0.0]
  warp_mm: 0.1
job: {{calibrate: false, X_BC: {{xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}}}
welding: {{speed_mm_s: 12.0, seam_length_mm: 110.0, {more}}}
"""
ORDER = (
    "stitch: {on_mm: 30.0, off_mm: 10.0}, tacks: [{from_mm: 76, to_mm: 84, height_mm: 6.5}],"
    " passes: [{lateral_mm: 1.5, vertical_mm: 4.0, reverse: true}]"
)


def test_a_root_and_a_cap_over_a_tack(tmp_path: Path) -> None:
    scenario = load_scenario("straight_groove", CELL.format(more=ORDER))
    options = RunOptions(scenario="a test's own", out=tmp_path / "run", recording=False)
    result = run_scenario(scenario, options)
    found: Any = result.summary()
    assert found["state"] == "done", found.get("reason")
    root, cap = found["passes"]
    assert (root["seam"], root["pass"], cap["seam"], cap["pass"]) == (1, 1, 1, 2)
    assert (cap["lateral_mm"], cap["vertical_mm"], cap["reverse"]) == (1.5, 4.0, True)
    for one in (root, cap):
        assert one["torch_max_mm"] < 0.3
    # places are counted from the seam's start, and the cap is welded from its end
    of_root, of_cap = found["arc_mm"]
    assert np.array(of_root) == pytest.approx(np.array([[0.0, 30.0], [40.0, 70.0], [80.0, 110.0]]), abs=1.0)
    assert np.array(of_cap) == pytest.approx(np.array([[110.0, 80.0], [70.0, 40.0], [30.0, 0.0]]), abs=1.0)
    assert [piece["ended"] for piece in found["pieces"]] == ["done"] * 6
    assert found["welded_mm"] == pytest.approx(180.0, abs=4.5)
    assert result.record is not None
    assert [(seam.seam, seam.weld_pass) for seam in result.record.seams] == [(1, 1), (1, 2)]
    ((tack,), none) = (seam.tacks for seam in result.record.seams)
    assert (tack["from_mm"], tack["to_mm"], none) == (76.0, 84.0, ())
    assert tack["path_mm"].most < 0.3
    # the tip is a chord of 59 mm ahead: it is lifted while the torch welds the first piece
    assert tack["travel_angle_deg"].most - tack["travel_angle_deg"].least > 1.0, "the lifted tip pitches the torch"
    pages = [(tmp_path / "run" / name).read_text() for name in ("record.html", "report.html")]
    assert all("tack at 76 to 84 mm: travel angle" in page for page in pages)
    assert all(f"Paths over seam {name}</h2>" in pages[1] for name in ("1", "1, pass 2"))


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("passes: [{vertical_mm: 30.0}]", "25 mm from the root at most"),
        ("passes: [{vertical_mm: 3.0}], pass_obstacles: true", "welding.passes goes without"),
        ("tacks: [{from_mm: 50, to_mm: 40}]", r"tacks\[0\].to_mm is 40, and from_mm 50"),
        ("tacks: [{from_mm: 50, to_mm: 60, seam: 2}]", "has seams 1 to 1"),
        ("stitch: {on_mm: 1.0, off_mm: 30.0}", "raise on_mm and off_mm"),
    ],
)
def test_an_order_that_cannot_be_welded_is_refused(more: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_scenario("straight_groove", CELL.format(more=more))
