"""The paper's experiments in motion, in their short form; and the replay that measures throughput."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from weldcal.tools.studies.motion.report import motion_report
from weldcal.tools.studies.motion.reproduce import run_motion_study
from weldcal.tools.studies.motion.results import MotionStudy, MotionStudyOptions
from weldcal.tools.studies.motion.throughput import run_throughput


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> MotionStudy:
    options = MotionStudyOptions(tmp_path_factory.mktemp("motion"), seed=1, quick=True, frames=30)
    return run_motion_study(options, lambda *_: None)


def test_synchronised_frames_agree_and_frames_at_their_arrival_do_not(study: MotionStudy) -> None:
    static, raw, joint = study.rows
    assert static.rms_mm < 0.1
    assert raw.rms_mm > 5.0  # the paper: about 10 mm
    assert joint.rms_mm < 0.2
    assert study.tracking_rms_mm < 0.05 * study.tracking_before_mm
    assert abs(study.offset_error_ms) < 2.0
    at_cube, _, turn = study.X_errors["motion, synchronised"]
    assert at_cube < 0.2
    assert turn < 0.1
    before, after = study.compensation["SVD, poses at arrival"]
    assert after > 0.3 * before  # one matrix does not repair a delay
    before, after = study.compensation["SVD, poses at the capture"]
    assert after < 0.3 * before
    assert study.quality["static"].plane_mm < study.quality["in motion"].plane_mm
    assert study.quality["static"].points > study.quality["in motion"].points
    folder = study.options.folder
    page = (folder / "report.html").read_text()
    assert page.count("<svg") + page.count("image/svg+xml") >= 4
    table = json.loads((folder / "table.json").read_text())
    assert set(table["table_1"]) == {row.name for row in study.rows}
    assert (folder / "truth.json").is_file()


def test_a_quick_run_shows_no_tick_over_a_missed_row(study: MotionStudy) -> None:
    good = dict.fromkeys(study.X_errors, (0.01, 0.01, 0.001))
    met = replace(study, X_errors=good, tracking_rms_mm=0.05, offset_error_ms=0.1, arrival_offset_error_ms=0.1)
    for one, words in ((met, "Tracking in motion"), (replace(met, offset_error_ms=9.0), "1 of 7 targets is missed")):
        assert one.met
        page = motion_report(one)
        assert words in page
        assert "A quick run decides nothing." in page
        assert ('class="verdict good"' in page) == (one is met)


def test_replayed_frames_are_estimated_or_counted_as_dropped(tmp_path: Path) -> None:
    found = run_throughput(tmp_path, 2.0, 0, lambda *_: None, rendered=8)
    assert found.estimated > 0
    assert found.refused < found.estimated
    assert found.estimated + found.dropped <= found.offered + 2
    assert len(found.wait_ms) == found.estimated
    assert np.min(found.wait_ms) > 0.0
    assert json.loads((tmp_path / "benchmark.json").read_text())["pixels"] == 816 * 612
