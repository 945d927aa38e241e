"""The weld job with a scanner that streams: its stand is knocked in the simulated world; before the weld that holds, in
it warns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydrake.systems.framework import Context

from tests.systems.cells import EXACT_PLATE
from tests.worlds.scaled_arms import perfect
from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.drivers.simulated.streaming_scanner import StreamingScanner
from weldcal.systems.jobs.job import Phases
from weldcal.systems.runner import run_cell
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.weld import measure
from weldcal.tools.report.demo import DemoResult, demo_report
from weldcal.tools.report.run import RunOptions

KNOCK_MM = [0.0, 1.2, 0.9]
POSE = "X_BC: {xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}"


def knocked(knock_s: float, speed_factor: float, fps: float) -> DemoResult:
    """A weld with a stated pose whose scanner is knocked; the run ends with the job, or as by Ctrl-C when the move is
    measured."""
    scanner = (
        "scanner: !StreamingScanner {width: 400, height: 300, exposure_samples: 1, mounting_translation_mm: 0.0,"
        f" mounting_rotation_deg: 0.0, fps: {fps}, knock_s: {knock_s}, knock_mm: {KNOCK_MM}}}"
    )
    job = f"job: {{calibrate: false, {POSE}, speed_factor: {speed_factor}}}"
    changes = (job, scanner, EXACT_PLATE, "welding: {seam_length_mm: 60.0}")
    cell = build_cell(perfect(load_scenario("straight_groove", "\n".join(changes))), 0)
    stage = cell.job.stage

    def stop_when_measured(root: Context, phases: Phases) -> tuple[str, float]:
        if cell.job.drift(root).events and not cell.job.command(root).finished:
            raise KeyboardInterrupt
        found: tuple[str, float] = stage(root, phases)
        return found

    cell.job.stage = stop_when_measured
    return measure(run_cell(cell), RunOptions(scenario="straight_groove", out=Path("unused")))


def test_a_scanner_knocked_before_the_weld_holds_the_job() -> None:
    result = knocked(5.5, 0.4, 20.0)
    said: dict[str, Any] = result.summary()
    assert said["state"] == "held"
    assert "The scanner's pose has changed" in str(said["reason"])
    assert [name for name, _, _ in result.run.phases][-2:] == ["approach_above", "held"]
    assert 5.5 < result.run.seconds < 7.0
    assert "The scanner&#39;s pose has changed" in demo_report(result, {}, recording=False)


def test_a_scanner_knocked_in_the_weld_is_a_warning_and_the_weld_goes_on() -> None:
    result = knocked(8.5, 1.0, 6.0)
    said: dict[str, Any] = result.summary()
    assert result.run.command.phase == "weld"
    assert not result.run.command.held
    assert "Ctrl-C" in str(said["reason"])  # by this test alone
    (drift,) = said["drift"]
    assert drift["translation_B_mm"] == pytest.approx(KNOCK_MM, abs=0.35)
    assert 8.5 <= drift["found_s"] < 10.5
    first, second = said["warnings"]
    assert "how far is being measured" in first
    assert "calibrate again" in second
    assert first.split(";")[0].replace("'", "&#39;") in demo_report(result, {}, recording=False)


def test_a_weld_scenario_may_have_a_scanner_that_streams_and_other_jobs_may_not() -> None:
    weld, mounting = load_scenario("straight_groove"), load_scenario("eye_on_base")
    for scenario in (weld, mounting):
        scenario.scanner = StreamingScanner()
    check_scenario(weld)
    with pytest.raises(InputError, match="or to the weld job"):
        check_scenario(mounting)
