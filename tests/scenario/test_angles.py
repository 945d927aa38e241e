"""A scenario orders the wire's angles: the true torch has them along the whole seam, and the record says so."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.weld import true_seam

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
welding: {{speed_mm_s: 16.0, seam_length_mm: 60.0, {more}}}
"""


def test_the_wire_has_its_ordered_angles_along_the_whole_seam(tmp_path: Path) -> None:
    """Push, with less wire out of the nozzle, and a lean that changes sides on the way."""
    angles = "{work_angle_deg: [-4, 4], travel_angle_deg: 4, stick_out_mm: 8}"
    scenario = load_scenario("straight_groove", CELL.format(more=f"angles: {angles}"))
    result = run_scenario(scenario, RunOptions(scenario="a test's own", out=tmp_path / "run", recording=False))
    assert result.summary()["state"] == "done", result.summary().get("reason")
    weld, truth = result.weld, true_seam(result.run.cell.station.truth)
    assert weld is not None
    assert weld.error is not None
    assert truth is not None
    assert weld.error.distance_m.max() < 0.3e-3, "of the wire's end at 8 mm from the nozzle"
    on = weld.log.torch_on
    s = np.asarray(truth.project(weld.log.p_BTorch[on]))
    towards = -weld.log.R_BT[on][:, :, 2]  # the shipped wire is parallel to the finger
    t, n, up = truth.tangent(s), truth.normal(s), truth.up(s)
    travel = np.degrees(np.arcsin(np.sum(towards * t, axis=1)))
    work = np.degrees(np.arctan2(np.sum(towards * n, axis=1), -np.sum(towards * up, axis=1)))
    assert travel == pytest.approx(np.full(len(s), 4.0), abs=1.0)
    assert work == pytest.approx(np.interp(s, [s[0], s[-1]], [-4.0, 4.0]), abs=1.0)
    assert result.record is not None
    seam = result.record.seams[0]
    assert seam.angles["travel_angle_deg"].mean == pytest.approx(float(travel.mean()), abs=0.3)
    rows = {row[0]: row[3] for row in result.record.rows_of(seam)}
    assert (rows["work angle, deg"], rows["travel angle, deg"]) == ("-4 to 4", "4")
    result.record.write(tmp_path)
    document = json.loads((tmp_path / "record.json").read_text())
    assert document["angles"][0]["travel_angle_deg"] == 4
    assert document["seams"][0]["angles"]["work_angle_deg"]["most"] == pytest.approx(float(work.max()), abs=0.3)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("angles: {work_angle_deg: [1, 2, 3]}", "work_angle_deg must hold one number or two, not 3"),
        ("angles: {stick_out_mm: 1}", "angles.stick_out_mm must be from 3 to 40"),
        ("angles: {work_angle_deg: 2}, lean_deg: 4", "go with welding.lean_deg: 0"),
    ],
)
def test_an_order_that_says_nothing_is_refused(more: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_scenario("straight_groove", CELL.format(more=more))


def test_a_nozzle_in_the_joint_is_refused_before_anything_moves() -> None:
    with pytest.raises(InputError, match=r"the nozzle would touch the joint: order 7\.0 or more"):
        build_cell(load_scenario("straight_groove", CELL.format(more="angles: {stick_out_mm: 5}")))
