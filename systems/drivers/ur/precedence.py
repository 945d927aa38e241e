"""Sets the thread priorities on the cell's computer: the cell, the worker's loop, and ur_rtde's polling threads."""

import contextlib
import os
import threading

CELL_PRIORITY = 1
LOOP_PRIORITY = 2  # of SCHED_RR; an emulated controller, which takes the place of another computer, has 3


def take_priority() -> None:
    """Give this thread, and those that it starts later, real-time priority; where the system refuses it, the highest
    ordinary priority that it allows.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(LOOP_PRIORITY))
    except OSError:
        with contextlib.suppress(OSError):
            os.nice(-10)


def poll_beside_the_cell() -> None:
    """Give all other threads of this process the cell's priority, where the system allows it.

    Each connection of ur_rtde has a thread that polls for data and sleeps for 0.1 ms. With the loop's priority these threads
    would preempt the cell thousands of times a second, and two cores could not keep up with half of real time. With the
    cell's priority they run on another core or after the cell; with ordinary priority they might not run while it computes.
    On one core they would wait for the cell, so their priority is not changed.
    """
    if len(os.sched_getaffinity(0)) < 2:
        return
    for thread in map(int, os.listdir("/proc/self/task")):
        with contextlib.suppress(OSError):  # a thread may end meanwhile
            if thread != threading.get_native_id() and os.sched_getscheduler(thread) == os.SCHED_RR:
                os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(CELL_PRIORITY))
