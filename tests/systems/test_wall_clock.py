"""The Diagram keeps to the wall clock, waits where it is ahead, slows the path where the computer is late, and counts
it."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from weldcal.systems.wall_clock import (
    FALL_PER_S,
    LATE_S,
    PICTURE_DUE_S,
    PICTURE_PATIENCE_S,
    PICTURE_STEP_S,
    RISE_PER_S,
    SLOWEST,
    Lateness,
    PictureWait,
    WallClock,
)
from weldcal.welding.servo.settings import FaultLimits


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
    wall.now += 2.0 * (0.1 + 0.05 * LATE_S)  # too little to slow the path
    clock.wait_for(0.1, moving=True)
    assert clock.late_s == pytest.approx(0.05 * LATE_S)
    assert (clock.reanchored, clock.rate) == (0, 1.0)
    clock.wait_for(0.2, moving=True)
    assert wall.now - 100.0 == pytest.approx(0.4)


TICK_S = 0.002
FALLING_TICKS = round(1.0 / FALL_PER_S / TICK_S)  # in which the rate can fall from one to any other


def on_a_computer_that_needs(work_s: float, ticks: int) -> tuple[FakeTime, WallClock, list[float]]:
    """A Diagram whose ticks of 2 ms each take `work_s` of computing; the rate at each."""
    wall, clock = clock_at(1.0)
    rates = []
    for k in range(1, ticks + 1):
        if k == FALLING_TICKS:
            clock.lateness = Lateness()
        wall.now += work_s
        clock.wait_for(TICK_S * k, moving=True)
        clock.velocity_leaves(clock.overdue_s(TICK_S * k), moving=True)
        rates.append(clock.rate)
    return wall, clock, rates


@pytest.mark.parametrize("share", [0.5, 0.7, 0.9])
def test_a_computer_that_is_too_slow_slows_the_path_to_what_it_can_do_and_is_soon_hardly_late(share: float) -> None:
    wall, clock, rates = on_a_computer_that_needs(TICK_S / share, 2000)
    assert rates[-1] == pytest.approx(share, abs=0.02)
    assert clock.lateness.worst_ms < 8.0
    assert clock.reanchored == 0
    # a Diagram at rate r takes 1/r as long, and none of that is lost: the path is the same
    assert clock.slowed_s == pytest.approx((wall.now - 100.0) - 2000 * TICK_S, abs=0.01)


def test_a_computer_that_keeps_up_is_never_slowed() -> None:
    _, clock, rates = on_a_computer_that_needs(0.9 * TICK_S, 500)
    assert set(rates) == {1.0}
    assert clock.lateness.counts == [500 - FALLING_TICKS + 1, *[0] * 8]
    assert clock.summary()["slowed_to_percent"] == 100.0


def test_the_rate_changes_no_faster_than_the_arm_may_be_accelerated_and_never_reaches_zero() -> None:
    _, _, rates = on_a_computer_that_needs(20.0 * TICK_S, 200)
    assert min(rates) >= SLOWEST
    steps = [b - a for a, b in zip([1.0, *rates], rates, strict=False)]
    assert min(steps) >= -FALL_PER_S * TICK_S / SLOWEST - 1e-12
    assert max(steps) <= RISE_PER_S * TICK_S / SLOWEST + 1e-12


def test_lateness_is_counted_in_bins_of_robot_time_while_the_arm_moves() -> None:
    wall, clock = clock_at(0.5)
    for late_ms in (0.1, 0.7, 3.0, 5.0, 300.0):
        wall.now += 2e-3 * late_ms  # at half the pace the robot's milliseconds are twice as long
        clock.velocity_leaves(clock.overdue_s(0.0), moving=True)
        clock.velocity_leaves(clock.overdue_s(0.0), moving=False)
        wall.now -= 2e-3 * late_ms
    assert clock.lateness.counts == [1, 1, 0, 1, 1, 0, 0, 0, 1]
    assert clock.lateness.on_time_percent == pytest.approx(60.0)
    assert clock.lateness.worst_ms == pytest.approx(300.0)


def test_a_held_path_slows_to_rest_and_goes_on_without_a_jerk_and_without_being_late() -> None:
    wall, clock = clock_at(1.0)
    clock.held = True
    k = 0
    while not clock.stands:
        k += 1
        wall.now += 1e-4
        clock.wait_for(TICK_S * k, moving=True)
    assert wall.now - 100.0 < 0.2
    wall.now += 30.0  # an operator looks at the arm
    clock.go_on()
    rates = [clock.rate]
    while clock.rate < 1.0:
        k += 1
        wall.now += 1e-4
        clock.wait_for(TICK_S * k, moving=True)
        rates.append(clock.rate)
    assert rates[0] <= 0.02
    assert max(b - a for a, b in pairwise(rates)) < 0.25
    assert (clock.reanchored, clock.late_s) == (0, 0.0)
    assert clock.slowest_rate > 0.0


@pytest.mark.parametrize(("waiting_s", "rate"), [(0.02, 1.0), (0.075, 0.5), (1.0, SLOWEST)])
def test_late_pictures_slow_the_path_before_the_servo_misses_them(waiting_s: float, rate: float) -> None:
    wall, clock = clock_at(1.0)
    clock.waiting_s = waiting_s
    for k in range(1, 201):
        wall.now += 1e-4
        clock.wait_for(TICK_S * k, moving=True)
    assert clock.rate == pytest.approx(rate, abs=0.01)


def test_without_a_velocity_nothing_was_late() -> None:
    assert Lateness().on_time_percent == 100.0
    assert math.isfinite(Lateness().worst_ms)


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


def test_a_late_picture_is_given_time_until_it_comes_and_a_camera_that_has_stopped_little() -> None:
    slept: list[float] = []
    pictures = PictureWait(slept.append)
    for age_s in (0.0, 0.05, PICTURE_DUE_S):
        pictures.wait(age_s)
    assert slept == [], "pictures in time cost nothing"
    for k in range(10):
        pictures.wait(PICTURE_DUE_S + 0.002 * (k + 1))
    pictures.wait(0.04)  # it has come
    assert slept == [PICTURE_STEP_S] * 10
    slept.clear()
    for k in range(1000):
        pictures.wait(PICTURE_DUE_S + 0.002 * (k + 1))
    assert sum(slept) == pytest.approx(PICTURE_PATIENCE_S)
    # the whole patience passes before the servo misses the picture
    assert PICTURE_DUE_S + 0.002 * len(slept) < 0.8 * FaultLimits().hidden_s


def test_a_time_before_the_diagram_stood_is_still_known_and_what_came_while_it_stood_belongs_to_where_it_stood() -> (
    None
):
    wall, clock = clock_at(0.5)
    for k in range(1, 51):
        clock.wait_for(0.002 * k, moving=True)  # 0.1 s in 0.2 s
    assert wall.now == pytest.approx(100.2)
    wall.now = 101.0  # at rest: a plan is made
    clock.wait_for(0.102, moving=False)
    for k in range(52, 102):
        clock.wait_for(0.002 * k, moving=True)
    assert wall.now == pytest.approx(101.2)
    expected = {100.0: 0.0, 100.1: 0.05, 100.2: 0.1, 100.6: 0.102, 101.0: 0.102, 101.1: 0.152, 101.2: 0.202}
    found = {t: clock.diagram_time(t, math.inf) for t in expected}
    assert found == pytest.approx(expected)
    lost = {t: clock.lost_by(t) for t in expected}
    assert lost == pytest.approx({t: t - 100.0 - s / 0.5 for t, s in expected.items()})


def test_the_time_lost_on_a_slow_computer_is_what_its_clock_and_the_diagram_differ_by_at_every_tick() -> None:
    wall, clock = clock_at(1.0)
    ticks = []
    for k in range(1, 2001):
        wall.now += 1.3 * TICK_S if 500 < k < 1500 else 0.1 * TICK_S
        clock.wait_for(TICK_S * k, moving=True)
        ticks.append((wall.now, TICK_S * k))
    assert clock.rate == 1.0
    assert clock.lost_by(wall.now) > 0.25
    for at, diagram in ticks:
        assert at - 100.0 - clock.lost_by(at) == pytest.approx(diagram, abs=0.006)  # as late as it was then
        assert clock.diagram_time(at, math.inf) == pytest.approx(at - 100.0 - clock.lost_by(at))


def test_a_hold_is_time_lost() -> None:
    wall, clock = clock_at(1.0)
    clock.wait_for(1.0, moving=True)
    clock.held = True
    wall.now += 30.0
    clock.go_on()
    clock.wait_for(2.0, moving=True)
    assert clock.lost_by(wall.now) == pytest.approx(30.0)
    assert clock.diagram_time(100.5, math.inf) == pytest.approx(0.5)
