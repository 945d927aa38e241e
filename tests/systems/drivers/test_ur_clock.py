"""Robot time on the host's clock: late packages do not move it, drift is found, a slow pace is no drift."""

from __future__ import annotations

import numpy as np
import pytest

from weldcal.systems.drivers.ur.robot import ClockMap

OFFSET = 1234.5
QUICKEST = 3e-4  # of the way of a package


def fed(seconds: float, *, drift: float = 0.0, jitter_s: float = 0.0, pace: float = 1.0, seed: int = 0) -> ClockMap:
    """A map that has seen packages at 250 Hz, none quicker than QUICKEST, most later."""
    rng = np.random.default_rng(seed)
    clock = ClockMap(pace)
    for k in range(int(250 * seconds)):
        robot = 100.0 + 0.004 * k
        late = QUICKEST + (rng.exponential(jitter_s) if jitter_s else 0.0)
        clock.update(robot, OFFSET + robot / pace * (1.0 + drift) + late)
    return clock


def error_s(clock: ClockMap, seconds: float, *, drift: float = 0.0, pace: float = 1.0) -> float:
    """Of the map at the newest sample, against the quickest package."""
    robot = 100.0 + seconds
    return clock.to_host(robot) - (OFFSET + robot / pace * (1.0 + drift) + QUICKEST)


def test_two_equal_clocks_differ_by_the_quickest_way() -> None:
    assert error_s(fed(2.0), 2.0) == pytest.approx(0.0, abs=1e-9)


def test_packages_that_come_late_do_not_move_the_map() -> None:
    # the least of 125 exponential delays of mean 1 ms is 8 us on average: e^-10 beyond 80 us
    assert abs(error_s(fed(20.0, jitter_s=1e-3), 20.0)) < 80e-6


def test_one_package_that_is_very_late_changes_nothing() -> None:
    clock = fed(5.0)
    before = clock.to_host(105.0)
    clock.update(105.0, OFFSET + 105.0 + 2.0)
    assert clock.to_host(105.0) == pytest.approx(before, abs=1e-9)


@pytest.mark.parametrize("drift", [80e-6, -80e-6])
def test_drift_between_two_quartzes_is_found(drift: float) -> None:
    clock = fed(30.0, drift=drift)
    assert clock.drift == pytest.approx(drift, abs=1e-7)
    # without the fit, 80 ppm make 2.4 ms in 30 s
    assert abs(error_s(clock, 30.0, drift=drift)) < 20e-6


def test_drift_is_found_among_late_packages() -> None:
    clock = fed(30.0, drift=80e-6, jitter_s=5e-4)
    assert clock.drift == pytest.approx(80e-6, abs=5e-6)
    assert clock.residual_s < 50e-6


def test_a_slow_controller_is_no_drift() -> None:
    clock = fed(20.0, pace=0.4)
    assert clock.drift == pytest.approx(0.0, abs=1e-9)
    assert error_s(clock, 20.0, pace=0.4) == pytest.approx(0.0, abs=1e-9)


def test_the_map_answers_from_the_first_package_on() -> None:
    clock = ClockMap()
    clock.update(100.0, 107.0)
    assert clock.to_host(100.5) == 107.5


def test_more_drift_than_any_quartz_has_is_not_believed() -> None:
    assert abs(fed(30.0, drift=0.01).drift) <= 5e-4


def test_a_controller_that_stood_still_is_on_the_map_again_within_a_second() -> None:
    # every sample thought 80 ms old is a pose of another place than the picture shows: 0.8 mm at 10 mm/s
    clock, lost = fed(20.0), 0.080
    for k in range(250):
        robot = 120.0 + 0.004 * k
        clock.update(robot, OFFSET + lost + robot + QUICKEST)
    assert clock.to_host(121.0) == pytest.approx(OFFSET + lost + 121.0 + QUICKEST, abs=1e-9)
    assert clock.drift == 0.0


def test_a_controller_that_falls_behind_its_own_pace_is_followed() -> None:
    """An emulated one on a busy computer: its clock loses a fiftieth, or half a second at once."""
    # The earliest package of the newest whole bin is at most a second old: a fiftieth of that, where the line was 1.2 s
    # off.
    assert abs(error_s(fed(60.0, drift=0.02), 60.0, drift=0.02)) < 0.025
    clock = fed(60.0)
    for k in range(int(250 * 4.0)):
        robot = 160.0 + 0.004 * k
        clock.update(robot, OFFSET + robot + 0.5 + QUICKEST)
    assert abs(clock.to_host(164.0) - (OFFSET + 164.0 + 0.5 + QUICKEST)) < 1e-3
