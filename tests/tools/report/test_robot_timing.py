"""A run with a robot shows how late its velocities were; one without a robot shows nothing of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from weldcal.systems.pacing import HostTiming
from weldcal.systems.runner import Run
from weldcal.systems.wall_clock import LIMITS_MS, WallClock
from weldcal.tools.report.run import robot_timing


def run_with(clock: WallClock | None) -> Run[Any]:
    return cast("Run[Any]", SimpleNamespace(clock=clock, host=HostTiming(250, 0.4, 6.2)))


def test_without_a_robot_or_without_a_motion_there_is_nothing_to_show() -> None:
    assert robot_timing(run_with(None)) == {}
    assert robot_timing(run_with(WallClock(1.0))) == {}


def test_the_sentence_states_what_was_counted() -> None:
    clock = WallClock(1.0)
    for late_ms in [0.1] * 997 + [3.9, 4.1, 20.0]:
        clock.lateness.add(late_ms)
    clock.slowest_rate, clock.slowed_s = 0.6, 1.25
    found = cast("dict[str, Any]", robot_timing(run_with(clock))["robot_timing"])
    assert found["sentence"] == (
        "99.80 % of 1000 velocities left less than 4 ms late while the arm moved; the latest 20.0 ms. "
        "The path was slowed to 60 % at the slowest, and took 1.25 s longer. "
        "This computer before the first motion: 0.4 % of wake-ups 4 ms late, the latest 6.2 ms."
    )
    assert found["behind"] is None
    assert found["picture"].startswith(b"<?xml")
    assert len(clock.lateness.counts) == len(LIMITS_MS) + 1
