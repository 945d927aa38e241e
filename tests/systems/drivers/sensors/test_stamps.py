"""Two clocks with an offset, a drift and a way that takes a skewed time: what the earliest arrivals give."""

from __future__ import annotations

import numpy as np
import pytest

from weldcal.systems.drivers.sensors.stamps import DeviceClock, DiagramTime, UnixClock


def stream(rate_hz: float, seconds: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Host times of captures, their device stamps, and their arrivals after 40 ms and a skewed tail."""
    rng = np.random.default_rng(seed)
    captured = 1000.0 + np.arange(0.0, seconds, 1.0 / rate_hz)
    stamps = 48211.7 + (captured - 1000.0) * (1.0 + 60e-6) + 2e-5 * rng.standard_normal(captured.size)
    arrived = captured + 0.040 + rng.gamma(1.0, 0.012, captured.size)
    return captured, stamps, arrived


@pytest.mark.parametrize("rate_hz", [10.0, 30.0, 125.0])
def test_capture_times_are_found_though_every_arrival_is_late(rate_hz: float) -> None:
    clock = DeviceClock(0.040, 0.5)
    captured, stamps, arrived = stream(rate_hz, 60.0)
    found = np.array([clock.stamp(s, a).captured for s, a in zip(stamps, arrived, strict=True)])
    settled = captured > captured[0] + 10.0
    assert np.abs(found - captured)[settled].max() < 0.002
    assert abs(clock.drift + 60e-6) < 4e-5
    # the arrivals alone are 12 ms late on the average, and up to 0.1 s
    assert np.mean(arrived - 0.040 - captured) > 0.010
    assert clock.error_s < 0.02
    assert clock.restarts == 0


def test_a_late_frame_is_measured_and_does_not_move_the_clock() -> None:
    clock = DeviceClock(0.040, 0.5)
    captured, stamps, arrived = stream(30.0, 5.0)
    for s, a in zip(stamps, arrived, strict=True):
        clock.stamp(s, a)
    late = clock.stamp(stamps[-1] + 0.033, captured[-1] + 0.033 + 2.040)
    assert late.late_s == pytest.approx(2.0, abs=0.01)
    assert late.captured == pytest.approx(captured[-1] + 0.033, abs=0.005)


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_a_clock_that_was_set_is_learned_anew(step_s: float) -> None:
    clock = DeviceClock(0.040, 0.5)
    captured, stamps, arrived = stream(30.0, 20.0)
    half = captured.size // 2
    found = []
    for k in range(captured.size):
        found.append(clock.stamp(stamps[k] + (step_s if k >= half else 0.0), arrived[k]).captured)
    assert clock.restarts == 1
    assert np.abs(np.array(found) - captured)[-30:].max() < 0.01


def test_the_diagrams_time_is_read_between_its_notes() -> None:
    times = DiagramTime()
    assert times.at(1.0) == -np.inf
    for host, diagram in ((10.0, 0.0), (10.1, 0.1), (10.5, 0.1), (10.6, 0.15)):
        times.add(host, diagram)
    assert times.at(9.9) == -np.inf
    assert times.at(10.05) == pytest.approx(0.05)
    assert times.at(10.3) == pytest.approx(0.1)  # it stood
    assert times.at(10.55) == pytest.approx(0.125)
    assert times.at(11.0) == pytest.approx(0.15)


@pytest.mark.parametrize("jump_s", [3600.0, -3600.0, 0.5, -0.5])
def test_a_clock_that_is_set_moves_no_capture_time(jump_s: float) -> None:
    """Frames on their way while the clock is set have stamps of the old one."""
    host, jumped = [100.0], [0.0]
    clock = UnixClock(lambda: 1.7e9 + host[0] + jumped[0], lambda: host[0])
    errors = []
    for k in range(300):
        captured = 100.0 + 0.033 * k
        stamp = 1.7e9 + captured + (jump_s if captured > 103.0 else 0.0)
        host[0] = captured + 0.06
        jumped[0] = jump_s if host[0] > 103.0 else 0.0
        errors.append(clock.to_monotonic(stamp, host[0]) - captured)
    assert np.abs(errors).max() < 1e-4


def test_a_process_that_waits_between_two_clocks_reads_them_again() -> None:
    waits = iter([0.3, 0.0, 0.0, 0.3, 0.0])
    host = [100.0]

    def unix() -> float:
        host[0] += next(waits, 0.0)
        return 1.7e9 + host[0]

    clock = UnixClock(unix, lambda: host[0])
    for _ in range(3):
        captured = host[0] - 0.05
        assert clock.to_monotonic(1.7e9 + captured, host[0]) == pytest.approx(captured, abs=1e-4)
