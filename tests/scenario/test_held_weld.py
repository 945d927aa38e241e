"""An operator holds a weld in its middle: still in 0.1 s, finished over the join, and replayed from its recording bit for
bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.held_weld import HeldWeld, held_weld, short_weld
from weldcal.systems.runner import Run
from weldcal.tools.commands.replay import replay_recording
from weldcal.tools.commands.run import RunRecorder
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.weld import weld_outcome


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> tuple[HeldWeld, Path]:
    """The weld and its recording."""
    folder = tmp_path_factory.mktemp("held")
    scenario = short_weld()
    recorder = RunRecorder(scenario, RunOptions(scenario="straight_groove", out=folder), "simulated")
    found = held_weld(scenario, recorder.open_sink)
    run: Run = found.run  # type: ignore[type-arg]
    recorder.close(run)
    return found, recorder.path


def test_a_held_weld_is_finished_over_the_join(held: tuple[HeldWeld, Path]) -> None:
    found, _ = held
    assert found.run.reason is None
    assert found.run.held_by_person == 1
    assert found.still_ms < 100.0
    assert found.mean_m <= 0.15e-3
    assert found.largest_m <= 0.3e-3
    assert found.left_out_m < 0.3e-3
    assert 4e-3 < found.welded_twice_m < 6e-3


def test_the_page_shows_how_far_the_seam_is_beside_the_plan(held: tuple[HeldWeld, Path]) -> None:
    found, _ = held
    outcome = weld_outcome(found.run.cell, found.run.root)
    assert outcome is not None
    assert outcome.planned is not None
    log, plan = outcome.log, outcome.planned
    torch = (
        log.p_BRobot + log.R_BT @ found.run.cell.job.servo_config.p_TW
    )  # where the arm puts it: it keeps to the felt seam
    rows = [row for row in found.live.weld if row.torch_on and np.isfinite(row.offset)]
    assert len(rows) > 8
    for row in rows:
        p_BW = torch[int(np.argmin(np.abs(log.time - row.time)))]
        beside = plan.frame(plan.nearest(p_BW, row.s_torch))
        assert row.offset == pytest.approx(float((p_BW - beside.position) @ beside.normal), abs=0.05e-3)
    assert max(abs(row.offset) for row in rows) > 0.05e-3, "there is something to show"


def test_a_hold_is_an_input_of_the_run(held: tuple[HeldWeld, Path]) -> None:
    again = replay_recording(held[1])
    assert again.first is None, again.summary()
    assert again.phase == "done"
