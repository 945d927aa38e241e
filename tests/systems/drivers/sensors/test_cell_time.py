"""Devices are judged by the host's clock, and by that of a robot that the cell follows."""

from __future__ import annotations

import sys
import threading
import time

import pytest

from weldcal.systems.drivers.sensors.stamps import FollowedTime, HostTime


def test_the_hosts_time_is_its_monotonic_clock() -> None:
    clock = HostTime()
    assert clock.now() == pytest.approx(time.monotonic(), abs=0.5)
    assert clock.at(12.5) == 12.5


def test_several_threads_may_ask_one_clock() -> None:
    """The acquisition's thread and the Diagram's do; the world stands still half of the time, which drops notes."""
    began = time.monotonic()
    clock = FollowedTime(lambda: round(20.0 * (time.monotonic() - began)) / 20.0)
    until, faults = time.monotonic() + 2.0, list[Exception]()

    def hammer() -> None:
        try:
            while time.monotonic() < until:
                found = clock.at(time.monotonic() - 1e-4)
                assert 0.0 <= found <= 2.1
        except Exception as fault:
            faults.append(fault)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=hammer) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(before)
    assert faults == []


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
