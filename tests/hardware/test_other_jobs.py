"""Another job on an emulated controller: mounting finds what it finds in simulation, over the same link (the profiler:
test_wired_profiler)."""

from __future__ import annotations

from pathlib import Path

from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.mounting_live import run_mounting_live
from weldcal.tools.report.run import RunOptions

ROBOT = "emulated"
PACE = 1.0
FEW_LOOKS = """
mounting: {travel_deg: 40.0}
scanner: !RenderedScanner {width: 560, height: 420, exposure_s: 0.02}
calibration: {minimum_scans: 4, maximum_scans: 4, verification_scans: 1}
"""


def options(name: str, folder: Path) -> RunOptions:
    return RunOptions(scenario=name, out=folder / "out", seed=1, robot=ROBOT, pace=PACE, recording=False)


def test_a_scanner_on_the_flange_calibrates_itself_on_the_controllers_arm(tmp_path: Path) -> None:
    report = run_mounting_live(
        load_scenario("eye_in_hand", FEW_LOOKS), options("eye_in_hand", tmp_path), lambda *_: None
    )
    summary = report.summary()
    assert summary["state"] == "done", summary.get("reason")
    assert summary["robot"] == "an emulated controller"
    (error,) = report.truth_errors().values()
    assert error.nees < error.bound  # 99.7 % of its own covariance
    assert (
        summary["work_error_mm"] < 0.3
    )  # of a scanned point: X itself is open along the view where the scanner's scale is
    assert (report.folder / "report.html").is_file()
