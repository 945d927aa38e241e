"""Devices are judged by the host's clock, and by that of a robot that the cell follows."""

from __future__ import annotations

import time

import pytest

from weldcal.systems.drivers.sensors.cell_time import FollowedTime, HostTime


def test_the_hosts_time_is_its_monotonic_clock() -> None:
    clock = HostTime()
    assert clock.now() == pytest.approx(time.monotonic(), abs=0.5)
    assert clock.at(12.5) == 12.5


def test_a_world_that_stands_still_makes_nothing_late() -> None:
    robot = [100.0]
    clock = FollowedTime(lambda: robot[0])
    clock.look()
    captured = time.monotonic()
    time.sleep(0.02)
    robot[0] = 100.25
    clock.look()
    for _ in range(3):  # the host goes on, the world does not
        time.sleep(0.01)
        clock.look()
    arrived = time.monotonic()
    assert clock.now() == 100.25
    assert clock.at(arrived) == 100.25
    assert 100.0 <= clock.at(captured) <= 100.25
    assert clock.at(arrived) - clock.at(captured) <= 0.25
    assert clock.at(captured - 1.0) == 100.0, "before the first look"
