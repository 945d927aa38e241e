"""A computer that cannot keep a robot's rate is told so before the arm moves."""

from __future__ import annotations

import pytest

from weldcal.systems.pacing import MEASURED_S, TICK_S, HostTiming, HostTooLate, measure_host, require_timely_host


class Host:
    """A computer whose every `each`-th wake-up comes `late_s` late, until `until_s`."""

    def __init__(self, each: int, late_s: float, until_s: float = 1e9) -> None:
        self.now, self.naps, self.each, self.late_s, self.until_s = 0.0, 0, each, late_s, until_s

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.naps += 1
        late = self.naps % self.each == 0 and self.now < self.until_s
        self.now += seconds + (self.late_s if late else 0.0)

    def timing(self) -> HostTiming:
        return measure_host(self.clock, self.sleep)


WAKE_UPS = round(MEASURED_S / TICK_S)


@pytest.mark.parametrize(
    ("each", "late_s", "ok"),
    [
        (10_000, 0.0, True),
        (20, 0.006, True),
        (5, 0.006, False),
        (5, 0.003, True),
        (100, 0.09, True),
        (100, 0.12, False),
    ],
)
def test_few_late_wake_ups_slow_the_path_and_many_or_long_ones_are_refused(each: int, late_s: float, ok: bool) -> None:
    timing = Host(each, late_s).timing()
    assert timing.wake_ups == WAKE_UPS
    assert timing.ok == ok
    if ok:
        require_timely_host(timing)
        return
    with pytest.raises(HostTooLate, match=r"^This computer cannot keep the robot's rate: .* ms\. Close other programs"):
        require_timely_host(timing)


def test_the_figures_are_those_of_the_wake_ups() -> None:
    timing = Host(10, 0.005).timing()
    assert timing.late_percent == pytest.approx(10.0)
    assert timing.worst_ms == pytest.approx(5.0)


def test_a_single_pause_is_measured_again() -> None:
    host = Host(50, 0.3, until_s=0.4)
    assert host.timing().ok
    assert host.naps == 2 * WAKE_UPS
