"""The study of calibrations in motion: its figures follow from the errors, and a short run keeps its targets."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.figures.motion.throughput import STUDY, cases
from weldcal.calibration.motion.estimate import MotionEstimate, estimate_in_motion
from weldcal.tools.farm.run import Farm


def test_a_short_run_keeps_the_targets(tmp_path: Path) -> None:
    STUDY.run(Farm(tmp_path, 0), cases(4, 12.0, 0))
    runs = json.loads((tmp_path / "summary.json").read_text())
    for line in csv.DictReader((tmp_path / "runs.csv").open()):
        assert (np.abs(json.loads(line["scaled"])) < 4.0).all()
        assert line["clock"] == "arrival" or abs(json.loads(line["errors"])[6]) < 5e-4
    for kind in (runs["arrival"], runs["device"]):
        assert kind["work_worst_mm"] < 0.10
        assert kind["turn_worst_deg"] < 0.02
        assert 0.3 < kind["nees"] < 2.5
    assert "offset_coverage" in (tmp_path / "table.md").read_text()


def test_a_wrong_offset_is_counted() -> None:
    def wrong(*args: Any, **options: Any) -> MotionEstimate:
        right = estimate_in_motion(*args, **options)
        assert right.clock.offset_s is not None
        return replace(right, clock=replace(right.clock, offset_s=right.clock.offset_s + 0.01))

    given = {name: case | {"estimate": wrong} for name, case in cases(2, 8.0, 0).items()}
    found = STUDY.here(given).figures["arrival"]
    assert found["offset_coverage"] == 0.0
    assert found["offset_rms_ms"] == pytest.approx(10.0, abs=4.0)
