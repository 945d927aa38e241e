"""Paces the Diagram by the wall clock: waits while it is ahead; reports lateness and does not catch up."""

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
    """Advances the Diagram's time at `pace` seconds per second of the wall clock.

    A robot executes commands when they arrive, so a Diagram that caught up after a delay would send outdated commands. A
    delay of more than LATE_S therefore moves the anchor, and the Diagram continues from there at its pace. Lateness is in
    seconds of the Diagram's time: `late_s` is the maximum while the arm was commanded to move, `thinking_s` the maximum while
    it was at rest, where computing time is not limited. `reanchored` counts the anchor's moves during motion, and `lost_s` is
    their sum.
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
        """Wait until the wall clock reaches this time of the Diagram. `moving`: the arm is commanded to move."""
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
        """A warning where the run did not keep up with its robot; None where it did."""
        if not self.reanchored:
            return None
        times = "once" if self.reanchored == 1 else f"{self.reanchored} times"
        return (
            f"The computer fell behind the robot {times} while the arm moved, by {1e3 * self.lost_s:.0f} ms in all. During that time the arm "
            "followed its last command, and the times of the run are too short by the same amount. Close other programs."
        )


@contextmanager
def no_long_garbage_collections() -> Iterator[None]:
    """Exclude all present objects from garbage collection for the duration of the block.

    A full collection visits every object of every imported library and stops the Diagram for 0.1 s and more. Frozen objects
    are not visited. Objects that the run creates are collected as usual, so memory does not grow.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def draw_in_this_thread() -> None:
    """Make the renderer draw in the calling thread, because the renderer's own threads do not have its priority.

    Must be called before the first picture of this process. Each picture takes a third longer on an idle computer, and the
    same time on a busy one.
    """
    os.environ.setdefault("LP_NUM_THREADS", "0")  # read by Mesa's llvmpipe; ignored by graphics cards


@contextmanager
def real_time_priority() -> Iterator[None]:
    """Give this thread real-time priority for the duration of the block, where the system allows it (rtprio, or root).

    The priority is below that of the link's worker and the emulated controller, so that neither waits for the cell. The
    rendering threads get the same priority. Threads and processes started in the block have ordinary priority.
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
            with suppress(ProcessLookupError):  # a rendering thread may have ended
                os.sched_setscheduler(thread, policy, parameter)
