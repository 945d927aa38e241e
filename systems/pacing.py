"""Keeping the Diagram to the wall clock: wait while it is ahead; where it is late, say so and never catch up in a rush."""

import gc
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from weldcal.systems.drivers.simulated.picture_worker import PICTURE_THREAD
from weldcal.systems.drivers.ur.precedence import CELL_PRIORITY

LATE_S = 0.020  # of the Diagram's time


class WallClock:
    """Lets the Diagram's time pass at `pace` seconds per second of the wall clock.

    A robot obeys what it is told when it is told it: a Diagram that hurried after a delay would send the past. So a delay of
    more than LATE_S moves the anchor, and the Diagram goes on from there at its pace. Lateness is in seconds of the Diagram's
    time: `late_s` is the worst while the arm was commanded to move, `thinking_s` the worst while it stood still, where a cell
    may compute as long as it likes; `reanchored` counts how often the anchor moved while the arm moved, `lost_s` is by how much in all.
    """

    def __init__(
        self, pace: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._pace, self._clock, self._sleep = pace, clock, sleep
        self._anchor: tuple[float, float] | None = None  # wall clock, Diagram
        self.late_s = 0.0
        self.thinking_s = 0.0
        self.reanchored = 0
        self.lost_s = 0.0

    def wait_for(self, diagram_time: float, moving: bool) -> None:
        """Return when the wall clock has come to this time of the Diagram. `moving`: the arm is commanded to move."""
        now = self._clock()
        if self._anchor is None:
            self._anchor = (now, diagram_time)
        due = self._anchor[0] + (diagram_time - self._anchor[1]) / self._pace
        if now < due:
            self._sleep(due - now)
            return
        late = (now - due) * self._pace
        if moving:
            self.late_s = max(self.late_s, late)
        else:
            self.thinking_s = max(self.thinking_s, late)
        if late > LATE_S:
            self._anchor = (now, diagram_time)
            self.reanchored += int(moving)
            self.lost_s += late if moving else 0.0

    def sentence(self) -> str | None:
        """What a person should know of a run that did not keep up with its robot; None where it did."""
        if not self.reanchored:
            return None
        times = "once" if self.reanchored == 1 else f"{self.reanchored} times"
        return (
            f"The computer fell behind the robot {times} while the arm moved, by {1e3 * self.lost_s:.0f} ms in all: meanwhile the arm "
            "went on as it was told last, and the times of the run are too short by that. Close other programs."
        )


@contextmanager
def no_long_garbage_collections() -> Iterator[None]:
    """Take everything that exists now out of the garbage collector's sight for the duration of the block.

    A full collection looks at every object of every imported library and stops the Diagram for a tenth of a second and more.
    Frozen, those are not looked at; what the run itself makes is collected as always, so that nothing piles up.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def draw_in_this_thread() -> None:
    """Have pictures drawn by the thread that asks for them: the renderer's own threads would not share its priority.

    Must be called before the first picture of this process. Each picture takes a third longer on an idle computer, and no
    longer than that on a busy one.
    """
    os.environ.setdefault("LP_NUM_THREADS", "0")  # of Mesa's llvmpipe; a graphics card does not read it


@contextmanager
def real_time_priority() -> Iterator[None]:
    """Run this thread before ordinary programs for the duration of the block, where the system lets it (rtprio, or root).

    Below the link's worker and the emulated controller, so that neither waits for the cell. The threads that draw what this one
    will wait for run beside it. Threads and processes that it starts meanwhile are ordinary ones.
    """
    drawing = [t.native_id for t in threading.enumerate() if t.name.startswith(PICTURE_THREAD) and t.native_id]
    before = {thread: (os.sched_getscheduler(thread), os.sched_getparam(thread)) for thread in (0, *drawing)}
    try:
        for thread in before:
            os.sched_setscheduler(thread, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(CELL_PRIORITY))
    except OSError:
        yield
        return
    try:
        yield
    finally:
        for thread, (policy, parameter) in before.items():
            with suppress(ProcessLookupError):  # a drawing thread may have ended
                os.sched_setscheduler(thread, policy, parameter)
