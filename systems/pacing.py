"""Give the control loop the processor: priorities, no long garbage collections, and a measurement of its wake-ups."""

import contextlib
import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from weldcal.models.errors import WeldcalError

CELL_PRIORITY = 1
LOOP_PRIORITY = 2  # of SCHED_RR; an emulated controller, which takes the place of another computer, has 3
SWITCH_S = 0.0002  # the interpreter's own is 5 ms
_CELL = (os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(CELL_PRIORITY))
TICK_S = 0.002  # one frame of an e-Series controller, 500 Hz
MEASURED_S = 0.5  # a choice: 250 wake-ups, of which MOST_LATE_PERCENT are 25; half of it lets one burst decide
LATE_MS = 4.0  # as wall_clock.ON_TIME_MS: a later velocity is replaced by the next one
# A computer that is busy beside has some late wake-ups, for which the path is slowed. With one in ten the arm would
# hardly move, and the guard on the controller stops an arm that gets no number for 150 ms.
MOST_LATE_PERCENT = 10.0
LONGEST_MS = 100.0  # two thirds of the 150 ms after which the guard stops the arm
TRIES = 3  # a single long pause, as of a disk, says nothing about the run


def take_priority() -> None:
    """Give this thread, and those that it starts later, real-time priority.

    Where the system refuses it, the highest ordinary priority that it allows.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(LOOP_PRIORITY))
    except OSError:
        with contextlib.suppress(OSError):
            os.nice(-10)


@contextmanager
def no_long_garbage_collections() -> Iterator[None]:
    """Exclude all present objects from garbage collection for the duration of the block.

    A full collection visits every object of every imported library and stops the Diagram for 0.1 s and more. Frozen
    objects are not visited. Objects that the run creates are collected as usual, so memory does not grow.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def draw_in_this_thread() -> None:
    """Make the renderer draw in the calling thread, because the renderer's own threads do not have its priority.

    Must be called before the first picture of this process. Each picture takes a third longer on an idle computer, and
    the same time on a busy one.
    """
    os.environ.setdefault("LP_NUM_THREADS", "0")  # read by Mesa's llvmpipe; ignored by graphics cards


@contextmanager
def real_time_priority() -> Iterator[Callable[[bool], None]]:
    """Give this thread real-time priority for the duration of the block, where the system allows it (rtprio, or root).

    The priority is below that of the link's worker and the emulated controller, so that neither waits for the cell. No
    other thread has it: fits and plans would keep the processor from the robot's peer. Threads and processes started in
    the block have ordinary priority. What the block is given takes the priority back (False) and gives it again (True),
    in this thread.
    """
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    before, ordinary = (policy, parameter), (os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    has = refused = False

    def give(on: bool) -> None:
        nonlocal has
        if on == has or refused:
            return
        os.sched_setscheduler(0, *(_CELL if on else ordinary))
        has = on

    try:
        give(True)
    except OSError:
        refused = True
    try:
        yield give
    finally:
        if not refused:
            give(False)
            # without privilege the flag for children stays, which have ordinary priority in any case
            with suppress(PermissionError):
                os.sched_setscheduler(0, *before)


@contextmanager
def short_turns() -> Iterator[None]:
    """Let other threads hold the interpreter's lock for at most SWITCH_S while the control loop wants it."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


class HostTooLate(WeldcalError):
    """This computer cannot keep the robot's rate."""


@dataclass(frozen=True)
class HostTiming:
    """Wake-ups that were asked for every TICK_S.

    How many, the share that came LATE_MS late or later, and the latest.
    """

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
        """Return the JSON object."""
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
