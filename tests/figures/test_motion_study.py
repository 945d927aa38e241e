"""The paper's experiments in motion, in their short form; and the replay that measures throughput."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.figures.harness import Measured
from tests.figures.motion.reproduce import STUDY, compute
from tests.figures.motion.throughput import run_throughput


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    folder = tmp_path_factory.mktemp("motion")
    return STUDY.measured(compute(folder, 1, True, 30, lambda *_: None), folder)


def test_synchronised_frames_agree_and_frames_at_their_arrival_do_not(study: Measured) -> None:
    found = study.figures
    static, raw, joint = found["table_1"].values()
    assert static["rms_mm"] < 0.1
    assert raw["rms_mm"] > 5.0  # the paper: about 10 mm
    assert joint["rms_mm"] < 0.2
    assert found["tracking_rms_mm"]["after"] < 0.05 * found["tracking_rms_mm"]["before"]
    assert abs(found["clock_offset_error_ms"]) < 2.0
    error = found["X_BC_error"]["motion, synchronised"]
    assert error["at_the_cube_mm"] < 0.2
    assert error["deg"] < 0.1
    gain = found["compensation_rms_mm"]["SVD, poses at arrival"]
    assert gain["after"] > 0.3 * gain["before"]  # one matrix does not repair a delay
    gain = found["compensation_rms_mm"]["SVD, poses at the capture"]
    assert gain["after"] < 0.3 * gain["before"]
    assert found["quality"]["static"]["plane_mm"] < found["quality"]["in motion"]["plane_mm"]
    assert found["quality"]["static"]["points"] > found["quality"]["in motion"]["points"]
    folder = study.folder
    assert folder is not None
    assert sum("<svg" in path.read_text() for path in (folder / "figures").iterdir()) >= 4
    table = json.loads((folder / "summary.json").read_text())
    assert set(table["table_1"]) == set(found["table_1"])
    assert (folder / "truth.json").is_file()


def test_a_quick_run_shows_no_tick_over_a_missed_row(study: Measured) -> None:
    def again(offset_error_ms: float) -> tuple[Measured, list[str]]:
        x = {
            key: {"at_the_cube_mm": 0.01, "at_the_camera_mm": 0.01, "deg": 0.001} for key in study.figures["X_BC_error"]
        }
        good: dict[str, Any] = {"X_BC_error": x, "tracking_rms_mm": {"after": 0.05}, "arrival_offset_error_ms": 0.1}
        found = STUDY.measured({"figures": {**study.figures, **good, "clock_offset_error_ms": offset_error_ms}})
        return found, [row[-1] for row in found.target_rows]

    for one, verdicts, missed in ((*again(0.1), 0), (*again(9.0), 1)):
        assert one.met
        assert one.figures["met"]
        assert (verdicts.count("MISSED"), len(verdicts)) == (missed, 7)
        assert "A quick run decides nothing." in one.markdown()


def test_replayed_frames_are_estimated_or_counted_as_dropped(tmp_path: Path) -> None:
    found = run_throughput(tmp_path, 2.0, 0, lambda *_: None, rendered=8)
    assert found.estimated > 0
    assert found.refused < found.estimated
    assert found.estimated + found.dropped <= found.offered + 2
    assert len(found.wait_ms) == found.estimated
    assert np.min(found.wait_ms) > 0.0
    assert json.loads((tmp_path / "benchmark.json").read_text())["pixels"] == 816 * 612
