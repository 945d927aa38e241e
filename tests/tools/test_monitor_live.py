"""`weldcal monitor` live: the scanner's stand is knocked in the simulated world, found in the cell, shown, and reported
at the end."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from weldcal.calibration.data.results import CalibrationResult, load_result, save_result
from weldcal.systems.scenario.loading import SCENARIO_FOLDER, load_scenario
from weldcal.systems.station import make_station
from weldcal.tools.cli.app import app

SEED, KNOCK_S, KNOCK_MM = 3, 4.5, [0.9, 0.0, -1.2]
SMALL = f"""  preset: motioncam_3d_stream_half
  width: 480
  height: 360
  exposure_samples: 1
  knock_s: {KNOCK_S}
  knock_mm: {KNOCK_MM}
"""


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The result folder of a live watch with a true calibration and its JSON object."""
    folder = tmp_path_factory.mktemp("live")
    scenario = folder / "knocked.yaml"
    text = (SCENARIO_FOLDER / "motion.yaml").read_text()
    scenario.write_text(re.sub(r"  preset: .*\n", SMALL, text))
    station = make_station(load_scenario(str(scenario)), SEED)
    X_BC = station.truth.X_BC
    station.close()
    assert X_BC is not None
    save_result(
        CalibrationResult(
            X_BC=X_BC, covariance=np.diag([1e-9] * 6), held_out_mm={}, tilt_deg={}, poses=(), robot="ur10e"
        ),
        folder / "calibration",
    )
    words = (
        f"monitor {scenario} --calibration {folder}/calibration --frames 100 --seed {SEED} --recalibrate --out"
        f" {folder}/out --json"
    )
    found = CliRunner().invoke(app, words.split())
    assert found.exit_code == 1, found.output  # the verdict is "do not use"
    return folder, json.loads(found.stdout.strip().splitlines()[-1])


def test_the_knock_is_found_live_and_reported_as_of_a_recording(watched: tuple[Path, dict[str, Any]]) -> None:
    _, said = watched
    assert list(said)[-4:] == ["rms_mm", "frames", "dropped", "drift"]
    assert (said["state"], said["verdict"]) == ("done", "the scanner has moved")
    (drift,) = said["drift"]
    assert abs(drift["time_s"] - KNOCK_S) < 0.2
    assert drift["found_s"] - KNOCK_S < 2.0
    assert drift["translation_B_mm"] == pytest.approx(KNOCK_MM, abs=0.3)
    live = said["live"]
    (event,) = live["drift"]
    assert event["translation_B_mm"] == pytest.approx(KNOCK_MM, abs=0.3)
    assert event["found_s"] - KNOCK_S < 2.0
    assert "calibrate again" in live["summary"]
    assert live["frames"] > 95


def test_the_pose_after_the_knock_is_written(watched: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = watched
    before, after = load_result(folder / "calibration"), load_result(folder / "out" / "recalibrated")
    p = np.array([0.65, 0.0, 0.30])
    seen = before.X_BC.inverse() @ p
    assert 1e3 * (after.X_BC @ seen - p) == pytest.approx(KNOCK_MM, abs=0.2)


def test_the_watch_is_shown_in_the_recording(watched: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = watched
    page = (folder / "out" / "recording.html").read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert "The scanner has moved" in (folder / "out" / "report.html").read_text(encoding="utf-8")


def test_a_scanner_that_does_not_stream_is_refused(watched: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    words = f"monitor eye_on_base --calibration {watched[0]}/calibration --out {tmp_path}/o"
    found = CliRunner().invoke(app, words.split())
    assert found.exit_code == 1
    assert "does not stream" in found.stderr
    assert not (tmp_path / "o").exists()
