"""Gives the control loop the processor: real-time priority for its thread, no long garbage collections, short waits."""

import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from weldcal.systems.drivers.ur.precedence import CELL_PRIORITY

SWITCH_S = 0.0002  # the interpreter's own is 5 ms
_CELL = (os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(CELL_PRIORITY))


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
    """Let other threads of the interpreter hold its lock for at most SWITCH_S at a time while the control loop wants
    it."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
