"""A person holds a weld in its middle: still in 0.1 s, finished over the join, and replayed from its recording bit for bit."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.held_weld import HELD_AT_M, HeldWeld, held_weld, short_weld
from weldcal.systems.runner import Run
from weldcal.tools.commands.record import RunRecorder
from weldcal.tools.commands.replay import replay
from weldcal.tools.outcomes.options import RunOptions
from weldcal.welding.servo.interruption import OVERLAP_M


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> tuple[HeldWeld, Path]:
    """The weld and its recording."""
    folder = tmp_path_factory.mktemp("held")
    scenario = short_weld()
    recorder = RunRecorder(scenario, RunOptions("straight_groove", folder), "simulated")
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
    assert OVERLAP_M - 1e-3 < found.welded_twice_m < OVERLAP_M + 1e-3
    assert HELD_AT_M > OVERLAP_M


def test_a_hold_is_an_input_of_the_run(held: tuple[HeldWeld, Path]) -> None:
    again = replay(held[1])
    assert again.first is None, again.summary()
    assert again.phase == "done"
