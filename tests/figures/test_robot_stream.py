"""The 125 Hz stream through the Diagram: what is measured fits together, and no late command goes unnamed."""

from __future__ import annotations

import json
from array import array
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.figures.robot.stream import MISSED_S, RATE_HZ, STEP_S, StreamReport, run_robot_benchmark
from tests.worlds.robot.timing import Tap
from weldcal.tools.emulators.ur.process import LOCKSTEP_S

SECONDS = 6.0


@pytest.fixture(scope="module")
def streamed(tmp_path_factory: pytest.TempPathFactory) -> tuple[StreamReport, Path]:
    """One stream and its folder."""
    folder = tmp_path_factory.mktemp("stream")
    return run_robot_benchmark(folder, minutes=SECONDS / 60.0, lockstep=LOCKSTEP_S), folder


def test_the_stream_goes_through_without_a_fault(streamed: tuple[StreamReport, Path]) -> None:
    report, _ = streamed
    assert report.fault == ""
    assert report.seconds == pytest.approx(SECONDS)
    summary = report.summary()
    assert summary["state"] == "done"
    assert summary["stops"] == []
    assert report.tap.starts == [0], "one link from beginning to end"


def test_the_diagram_never_hurries(streamed: tuple[StreamReport, Path]) -> None:
    report, _ = streamed
    times = np.array(report.tap.command_times)
    assert times.size == pytest.approx(SECONDS * RATE_HZ, abs=2 + 2 * len(report.stops))
    # the wall clock is kept to, but for the 20 ms that may be made up for
    assert times[-1] - times[0] > (times.size - 1) / RATE_HZ - 0.03


def test_every_command_that_comes_late_is_named_with_its_time(streamed: tuple[StreamReport, Path]) -> None:
    report, folder = streamed
    late = report.tap.periods > 1.0 / RATE_HZ + MISSED_S
    summary = report.summary()
    assert summary["missed_deadlines"] == len(report.missed) == np.count_nonzero(late)
    assert len((folder / "missed.csv").read_text().splitlines()) == 1 + len(report.missed)
    assert all(0.0 < missed.at_s < SECONDS * 3 and missed.late_s > MISSED_S for missed in report.missed)


def test_a_pause_of_the_stream_is_seen_as_a_missed_deadline(streamed: tuple[StreamReport, Path]) -> None:
    report, _ = streamed
    times = report.tap.command_times
    kept = list(times)
    try:
        before = len(report.missed)
        for k in range(600, len(times)):
            times[k] += 1.0
        assert len(report.missed) >= max(before, 1)
        assert max(missed.late_s for missed in report.missed) == pytest.approx(1.0, abs=0.2)
        assert any(missed.at_s == pytest.approx(times[600] - times[0]) for missed in report.missed)
    finally:
        for k, value in enumerate(kept):
            times[k] = value


def test_what_was_measured_fits_together(streamed: tuple[StreamReport, Path]) -> None:
    report, folder = streamed
    summary = json.loads((folder / "robot.json").read_text())
    for key in ("command_period_ms", "echo_ms", "command_to_motion_ms", "state_age_ms"):
        found = summary[key]
        assert found["p50"] <= found["p90"] <= found["p99"] <= found["max"], key
    assert min(report.tap.motions) > 0.0
    assert min(report.tap.echoes) > 0.0
    # a step that a busy computer delays may still be on its way when the next one is sent
    assert 1 <= summary["velocity_steps"] <= SECONDS / STEP_S
    assert summary["worker_worst_period_ms"] >= 4.0


def test_a_new_link_that_has_heard_nothing_yet_gives_no_echo() -> None:
    def link(*heard: int) -> SimpleNamespace:
        states = iter([SimpleNamespace(echo=float(k), echo_latency=1e-3 * k, age_s=0.0) for k in heard])
        return SimpleNamespace(state=lambda: next(states))

    tap = Tap(link=link(0, 1, 1, 2), command_times=array("d", [0.0]))  # type: ignore[arg-type]
    for _ in range(4):
        tap.state()
    tap.restart(link(0, 3))  # type: ignore[arg-type]
    for _ in range(2):
        tap.state()
    assert list(tap.echoes) == [1e-3, 2e-3, 3e-3]
