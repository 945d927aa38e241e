"""The Diagram keeps to the wall clock, waits where it is ahead, and after a delay goes on at its pace instead of hurrying."""

from __future__ import annotations

import gc

import pytest

from weldcal.systems.pacing import LATE_S, WallClock, no_long_garbage_collections


class FakeTime:
    """A wall clock that only sleeping and working moves on."""

    def __init__(self) -> None:
        self.now, self.slept = 100.0, 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        self.slept += seconds


def clock_at(pace: float) -> tuple[FakeTime, WallClock]:
    wall = FakeTime()
    clock = WallClock(pace, wall, wall.sleep)
    clock.wait_for(0.0, moving=False)
    return wall, clock


@pytest.mark.parametrize("pace", [0.25, 1.0])
def test_a_diagram_that_is_ahead_waits_so_that_its_time_passes_at_the_pace(pace: float) -> None:
    wall, clock = clock_at(pace)
    for k in range(1, 501):
        wall.now += 1e-4  # work
        clock.wait_for(0.002 * k, moving=True)
    assert wall.now - 100.0 == pytest.approx(1.0 / pace)
    assert (clock.late_s, clock.reanchored) == (0.0, 0)
    assert clock.sentence() is None


def test_a_small_delay_is_made_up_for_and_reported() -> None:
    wall, clock = clock_at(0.5)
    wall.now += 2.0 * (0.1 + 0.8 * LATE_S)
    clock.wait_for(0.1, moving=True)
    assert clock.late_s == pytest.approx(0.8 * LATE_S)
    assert clock.reanchored == 0
    clock.wait_for(0.2, moving=True)
    assert wall.now - 100.0 == pytest.approx(0.4)


def test_a_long_delay_is_never_made_up_for() -> None:
    wall, clock = clock_at(0.5)
    wall.now += 2.0 * (0.1 + 0.3)
    clock.wait_for(0.1, moving=True)
    assert clock.late_s == pytest.approx(0.3)
    assert clock.reanchored == 1
    assert "once while the arm moved, by 300 ms in all" in (clock.sentence() or "")
    before = wall.now
    clock.wait_for(0.2, moving=True)
    assert wall.now - before == pytest.approx(0.2)


def test_thinking_while_the_arm_stands_still_is_no_lateness() -> None:
    wall, clock = clock_at(1.0)
    wall.now += 2.0
    clock.wait_for(0.1, moving=False)
    assert (clock.late_s, clock.reanchored) == (0.0, 0)
    assert clock.thinking_s == pytest.approx(1.9)
    before = wall.now
    clock.wait_for(0.2, moving=True)
    assert wall.now - before == pytest.approx(0.1)


def test_garbage_of_the_run_is_still_collected_and_the_rest_is_left_alone() -> None:
    class Knot:
        alive = 0

        def __init__(self) -> None:
            self.me = self
            Knot.alive += 1

        def __del__(self) -> None:
            Knot.alive -= 1

    gc.unfreeze()  # what the test run froze
    with no_long_garbage_collections():
        assert gc.isenabled()
        assert gc.get_freeze_count() > 10_000, "what the libraries made is out of sight"
        for _ in range(10):
            Knot()
        assert gc.collect() >= 10
        assert Knot.alive == 0
    assert gc.get_freeze_count() == 0


def test_an_error_inside_leaves_the_collector_as_it_was() -> None:
    with pytest.raises(ValueError, match="broken"), no_long_garbage_collections():
        raise ValueError("broken")
    assert gc.get_freeze_count() == 0
