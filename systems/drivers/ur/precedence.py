"""Who runs before whom on the cell's computer: the cell, the worker's loop, and the threads that ur_rtde polls the robot with."""

import contextlib
import os
import threading

CELL_PRIORITY = 1
LOOP_PRIORITY = 2  # of SCHED_RR; an emulated controller, which stands for another computer, has 3


def take_priority() -> None:
    """Run this thread, and those that it starts from now on, before everything that is not real time, where the system lets
    us; else as politely placed as it allows.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(LOOP_PRIORITY))
    except OSError:
        with contextlib.suppress(OSError):
            os.nice(-10)


def poll_beside_the_cell() -> None:
    """Give all other threads of this process the cell's own priority, where the system lets us.

    Each connection of ur_rtde has a thread that looks for data, sleeps for 0.1 ms and looks again. With the loop's priority
    they would take the processor from the cell thousands of times a second, and two cores could not keep up with half of real time.
    With the cell's they run on another core, or after it; ordinary threads might not run at all while it computes. On one core
    they would wait until it is done, and stay as they are.
    """
    if len(os.sched_getaffinity(0)) < 2:
        return
    for thread in map(int, os.listdir("/proc/self/task")):
        if thread != threading.get_native_id() and os.sched_getscheduler(thread) == os.SCHED_RR:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(CELL_PRIORITY))
