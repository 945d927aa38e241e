"""A bent torch is measured by scans and touches that know nothing of the fit; its regions are neither wide nor narrow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.calibration.tool import torches
from tests.calibration.tool.torches import Judged, Truth, Wrong, cell, judge, measured, random_tool, touch, unit
from weldcal.calibration.errors import ToolNotFound
from weldcal.calibration.tool.comparison import EXCEEDED, HOLDS, judge_tool, measured_file
from weldcal.calibration.tool.measure import ToolMeasurement, measure_tool
from weldcal.calibration.tool.wire import WireTouch, find_wire
from weldcal.models.tools.loading import WELDING, load_tool
from weldcal.tools.cli.result_folder import MEASURED_TOOL
from weldcal.tools.commands.cell.tool import MeasureReport
from weldcal.tools.commands.doctor import examine
from weldcal.tools.report.render import write_json

TOOLS = 6
UP = np.array([0.0, 0.0, 1.0])


@cache
def several() -> Sequence[Judged]:
    return [measured(300 + k, random_tool(300 + k)) for k in range(TOOLS)]


@cache
def found(bend_mm: float, longer_mm: float = 0.0) -> ToolMeasurement:
    c = cell(41, Wrong(bend=1e-3 * bend_mm, tilt=1e-3 * bend_mm / 0.15, longer=1e-3 * longer_mm))
    return measure_tool(load_tool(WELDING), c.scans, c.covariance, c.touches)


def test_bent_torches_are_found_within_the_limits() -> None:
    assert max(r.axis_deg for r in several()) < 0.2
    assert max(r.wire_mm for r in several()) < 0.15
    assert all(r.noticed and r.nozzle_noticed for r in several())
    assert max(abs(r.stick_out_mm) for r in several()) < 0.5


def test_the_axis_region_is_neither_wide_nor_narrow() -> None:
    """Twelve squares: a covariance four times too wide or too narrow would leave this interval."""
    assert 0.75 < np.mean([r.axis_chi2 for r in several()]) < 5.0


def test_an_untouched_wire_keeps_its_place_or_its_stick_out() -> None:
    """The tool file has the torch 1.5 mm too long; then the mouth is where it should be."""
    c, right = cell(43, Wrong()), load_tool(WELDING)
    for tool in (right, replace(right, p_FW=right.p_FW + 1.5e-3 * UP)):
        got = measure_tool(tool, c.scans, c.covariance)
        assert abs((got.p_FW - c.truth.p_FW) @ c.truth.axis) < 0.4e-3
        assert ("from the measured mouth" in got.notes[-1]) == (tool is not right)


def truth(rng: np.random.Generator) -> Truth:
    axis = UP + 0.03 * np.append(rng.normal(size=2), 0.0)
    return Truth(torches.NOMINAL + 0.003 * unit(rng), axis / np.linalg.norm(axis), torches.BALL, 0.012)


def touched(seed: int, points: int, plates: int) -> tuple[list[WireTouch], Truth]:
    rng = np.random.default_rng(seed)
    t = truth(rng)
    touches = [touch(f"t{k}", "point", t, rng, k, points) for k in range(points)]
    return touches + [touch(f"u{k}", "plate", t, rng, k, plates) for k in range(plates)], t


@pytest.mark.parametrize(("points", "plates", "median_mm"), [(12, 0, 0.06), (0, 24, 0.25), (6, 12, 0.09)])
def test_the_wire_is_found_by_points_and_plates(points: int, plates: int, median_mm: float) -> None:
    squares, errors = [], []
    for seed in range(40):
        touches, t = touched(seed, points, plates)
        wire = find_wire(touches, torches.NOMINAL, t.axis, torches.WIRE_M)
        off = wire.p_FW - t.p_FW
        squares.append(float(off @ np.linalg.solve(wire.covariance, off)))
        errors.append(1e3 * float(np.linalg.norm(off)))
    assert np.median(errors) < median_mm
    assert 1.6 < np.mean(squares) < 4.6  # 3 is right; four times is far outside


def test_the_region_is_wider_across_a_long_tool_than_along_it() -> None:
    """The flange's turns move the wire's end across its lever only; without their rows the ratio is 1.5."""
    squares = []
    for seed in range(300):
        rng = np.random.default_rng([seed, 5])
        t = Truth(np.array([0.0, 0.0, 0.6]), UP, torches.BALL, 0.012)
        wire = find_wire([touch(f"t{k}", "point", t, rng, k, 12) for k in range(12)], t.p_FW, UP, torches.WIRE_M)
        squares.append((wire.p_FW - t.p_FW) ** 2 / np.diag(wire.covariance))
    x, y, z = np.mean(squares, axis=0)
    assert 0.8 < 0.5 * (x + y) / z < 1.38


def test_a_touch_that_slipped_is_left_out() -> None:
    touches, t = touched(3, 12, 0)
    touches[5] = replace(touches[5], X_BF=touches[5].X_BF @ RigidTransform([0.0, 0.002, 0.0]))
    wire = find_wire(touches, torches.NOMINAL, t.axis, torches.WIRE_M)
    assert wire.left_out == ("t5",)
    assert np.linalg.norm(wire.p_FW - t.p_FW) < 1.5e-4


def test_touches_in_one_orientation_determine_nothing() -> None:
    touches, t = touched(4, 12, 0)
    alike = [replace(x, X_BF=RigidTransform(touches[0].X_BF.rotation(), x.X_BF.translation())) for x in touches]
    with pytest.raises(ToolNotFound, match="turn the tool more"):
        find_wire(alike, torches.NOMINAL, t.axis, torches.WIRE_M)


def test_a_straight_torch_holds_the_tolerance() -> None:
    verdict = judge_tool(found(0.0), 5e-4)
    assert (verdict.tolerance, verdict.cause) == (HOLDS, "")


def test_a_bent_torch_is_named_and_its_tolerance_is_gone() -> None:
    verdict = judge_tool(found(2.0), 5e-4)
    assert verdict.tolerance == EXCEEDED
    assert verdict.cause.startswith("The torch is bent")


@pytest.mark.parametrize(("bend_mm", "named"), [(0.0, []), (2.0, ["torch bent or moved"])])
def test_the_doctor_knows_a_bent_torch(bend_mm: float, named: list[str], tmp_path: Path) -> None:
    report = MeasureReport(found(bend_mm), judge_tool(found(bend_mm), 5e-4), 0.5, tmp_path)
    write_json(tmp_path / MEASURED_TOOL, report.summary())
    assert [cause.name for cause in examine(tmp_path).causes] == named


def test_a_longer_wire_is_no_bent_torch() -> None:
    measurement = found(0.0, longer_mm=1.5)
    verdict = judge_tool(measurement, 5e-4)
    assert verdict.cause.startswith("Only the stick-out differs, by +1.")
    assert measurement.stick_out_m == pytest.approx(0.0135, abs=5e-4)


def test_the_new_file_moves_the_bodies_of_the_torch_alone() -> None:
    measurement = found(2.0)
    old, new = load_tool(WELDING), measured_file(measurement)
    at = {s["name"]: np.array(s["xyz_mm"]) for s in new["shapes"]}
    wire = next(s for s in old.tool.drawn() if s.name == "torch_wire")
    moved = at["torch_wire"] - 1e3 * np.array(wire.place.xyz_m)
    shift = 1e3 * (measurement.p_FW - old.p_FW)
    assert np.linalg.norm(moved - shift) < 0.2  # its middle is 6 mm from the wire point: 13 mrad
    assert at["camera"].tolist() == [0.0, 0.0, 38.0]


def test_judging_needs_the_truth() -> None:
    """The judge of the trials sees a wrong wire point."""
    c = cell(41, Wrong())
    off = replace(c.truth, p_FW=c.truth.p_FW + 3e-4)
    assert not judge(found(0.0), off).wire_inside
