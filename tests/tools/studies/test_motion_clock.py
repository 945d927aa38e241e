"""The study of calibrations in motion: its figures follow from the errors, and a short run keeps its targets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from weldcal.calibration.motion.estimate import MotionEstimate, estimate_in_motion
from weldcal.tools.studies.motion.clock import exact_errors, run_clock_study
from weldcal.tools.worlds.moves import cube_moves, observed_frames


def test_a_short_run_keeps_the_targets(tmp_path: Path) -> None:
    found = run_clock_study(4, tmp_path, duration_s=12.0)
    for kind in found.values():
        assert (np.abs(kind.scaled) < 4.0).all()
        assert kind.work_mm.max() < 0.10
        assert kind.turn_deg.max() < 0.02
        assert 0.3 < kind.nees.mean() < 2.5
    assert np.abs(found["device"].errors[:, 6]).max() < 5e-4
    assert "offset_coverage" in (tmp_path / "motion_clock.md").read_text()


def test_a_wrong_offset_is_counted() -> None:
    def wrong(*args: Any, **options: Any) -> MotionEstimate:
        right = estimate_in_motion(*args, **options)
        assert right.clock.offset_s is not None
        return replace(right, clock=replace(right.clock, offset_s=right.clock.offset_s + 0.01))

    found = run_clock_study(2, duration_s=8.0, estimate=wrong)["arrival"]
    assert found.coverage == 0.0
    assert found.summary()["offset_rms_ms"] == pytest.approx(10.0, abs=4.0)


def test_an_exact_fit_errs_as_it_says() -> None:
    found = []
    for k in range(40):
        rng = np.random.default_rng([1, k])
        moves, X_BC = cube_moves(rng, linear=k % 2 == 1)
        frames, capture = observed_frames(moves, X_BC, 8.0, rng, device=True, exposure_s=0.0)
        found.append(exact_errors(frames, capture, moves, X_BC))
        if k == 0:  # and one that is told wrong times does not
            assert np.abs(exact_errors(frames, capture + 0.01, moves, X_BC)).max() > 20.0
    low, high = (chi2.ppf(q, 40) / 40 for q in (1e-4, 1.0 - 1e-4))
    nees = (np.array(found) ** 2).mean(axis=0)
    assert (nees > low).all()
    assert (nees < high).all()
