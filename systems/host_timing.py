"""Measures whether this computer can keep a robot's rate: how late a thread wakes up that asks for a wake-up every
tick."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from weldcal.models.errors import WeldcalError
from weldcal.systems.pacing import real_time_priority

TICK_S = 0.002
MEASURED_S = 0.5
LATE_MS = 4.0
# A computer that is busy beside has some late wake-ups, for which the path is slowed. With one in ten the arm would
# hardly move, and the guard on the controller stops an arm that gets no number for 150 ms.
MOST_LATE_PERCENT = 10.0
LONGEST_MS = 100.0
TRIES = 3  # a single long pause, as of a disk, says nothing about the run


class HostTooLate(WeldcalError):
    """This computer cannot keep the robot's rate."""


@dataclass(frozen=True)
class HostTiming:
    """Wake-ups that were asked for every TICK_S: how many, the share that came LATE_MS late or later, and the
    latest."""

    wake_ups: int
    late_percent: float
    worst_ms: float

    @property
    def ok(self) -> bool:
        """Whether a robot can be driven from here."""
        return self.late_percent <= MOST_LATE_PERCENT and self.worst_ms <= LONGEST_MS

    @property
    def words(self) -> str:
        """What was found."""
        return f"{self.late_percent:.1f} % of wake-ups {LATE_MS:.0f} ms late, the latest {self.worst_ms:.1f} ms"

    @property
    def advice(self) -> str:
        """What to change, as one sentence."""
        return (
            "Close other programs on this computer, and let it use real-time priority (ulimit -r, or cap_sys_nice), "
            "or take one with more cores."
        )

    def summary(self) -> dict[str, float]:
        """The JSON object."""
        return {"wake_ups": self.wake_ups, "late_percent": self.late_percent, "worst_ms": self.worst_ms}


def measure_host(
    clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
) -> HostTiming:
    """The timing of this thread with the priority of a run; the best of TRIES, of which most computers need one."""
    with real_time_priority():
        best = _measured(clock, sleep)
        for _ in range(TRIES - 1):
            if best.ok:
                break
            best = min(best, _measured(clock, sleep), key=lambda found: (found.late_percent, found.worst_ms))
    return best


def require_timely_host(timing: HostTiming) -> None:
    """Refuse a computer that cannot keep the robot's rate.

    Raises:
        HostTooLate: with what was found and what to change.
    """
    if not timing.ok:
        raise HostTooLate(f"This computer cannot keep the robot's rate: {timing.words}. {timing.advice}")


def _measured(clock: Callable[[], float], sleep: Callable[[float], None]) -> HostTiming:
    n, late, worst = round(MEASURED_S / TICK_S), 0, 0.0
    for _ in range(n):
        due = clock() + TICK_S
        sleep(TICK_S)
        late_ms = 1e3 * (clock() - due)
        late += late_ms >= LATE_MS
        worst = max(worst, late_ms)
    return HostTiming(n, 100.0 * late / n, worst)
