"""The other jobs on an emulated controller: mounting and profiler find what they find in simulation, over the same link."""

from __future__ import annotations

from pathlib import Path

import pytest

from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.mounting_live import run_mounting_live
from weldcal.tools.commands.profiler.live import run_profiler_live
from weldcal.tools.outcomes.options import RunOptions

# An address of its own: this module waits for no other.
ROBOT = "emulated@127.0.0.43"
PACE = 0.7
FEW_LOOKS = """
mounting: {travel_deg: 40.0}
scanner: !RenderedScanner {width: 560, height: 420, exposure_s: 0.02}
calibration: {minimum_scans: 5, maximum_scans: 5, verification_scans: 1}
"""
FEW_TOUCHES = """
profiler_job:
  stages: [sphere]
  sphere: {scans: 7, held_out: 1, touches: 6, descent_mm_s: 10.0, gap_mm: 8.0}
"""


def options(name: str, folder: Path) -> RunOptions:
    return RunOptions(name, folder / "out", seed=1, robot=ROBOT, pace=PACE, recording=False)


def test_a_scanner_on_the_flange_calibrates_itself_on_the_controllers_arm(tmp_path: Path) -> None:
    report = run_mounting_live(
        load_scenario("eye_in_hand", FEW_LOOKS), options("eye_in_hand", tmp_path), lambda *_: None
    )
    summary = report.summary()
    assert summary["state"] == "done", summary.get("reason")
    assert summary["robot"] == "an emulated controller"
    (error,) = report.truth_errors().values()
    assert error.nees < error.bound  # 99.7 % of its own covariance
    assert error.mm < 0.3
    assert (report.folder / "report.html").is_file()


@pytest.mark.parametrize("name", ["profiler_sphere"])
def test_a_profiler_touches_its_sphere_with_the_controllers_arm(tmp_path: Path, name: str) -> None:
    live = run_profiler_live(load_scenario(name, FEW_TOUCHES), options(name, tmp_path), lambda *_: None)
    summary = live.summary()
    assert summary["state"] == "done", summary.get("reason")
    assert summary["robot"] == "an emulated controller"
    assert len(live.state.touches) == 6
    assert live.outcome.sphere is not None
    assert live.outcome.sphere.within_3_sigma
