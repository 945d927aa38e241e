"""Sets the thread priorities on the cell's computer: the cell and the worker's loop."""

import contextlib
import os

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
