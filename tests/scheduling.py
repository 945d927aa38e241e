"""How the tests are dealt to the processes of pytest-xdist: file by file, and what sleeps most of its time one by
one."""

from __future__ import annotations

import os
import zlib

import pytest
from xdist.scheduler.loadfile import LoadFileScheduling

# They stream in time with a clock, and a Diagram that does takes a core: two at once would only slow each other down.
STREAMING = (
    *("test_same_job.py", "test_other_jobs.py", "test_fault_matrix.py", "test_station_backends.py"),
    *("test_process_output.py", "test_robot_stream.py", "test_emulator_lockstep.py", "test_hold_and_go_on.py"),
    *("test_wired_cell.py", "test_wired_profiler.py", "test_independent_controller.py"),
)
# They wait for a browser, a page or a folder and need next to no processor: beside a stream they leave the cores to
# what computes.
WAITING = ("test_dashboard.py", "test_panels.py", "test_folder_scanner.py", "test_tablet_page.py")
SLEEPING = STREAMING + WAITING
# They look at the finished demo. A core that is left with them at the end keeps the other waiting.
DEMO = ("tests/scenario/test_readme.py", "tests/scenario/test_cell.py")
# It takes a minute: at the end a core would wait for it.
LONG = "test_wired_motion.py"
# Folders whose files take a second or less come last, so that the processes end together.
SHORT = ("models", "contract")
MOST_PROCESSES = 4


def processes() -> int:
    """One for each core, and one for the tests that sleep most of their time."""
    return min(len(os.sched_getaffinity(0)), MOST_PROCESSES) + 1


def order(item: pytest.Item) -> tuple[object, ...]:
    """What sleeps first, for it takes its time whatever the others do; then what takes longest; short files last.

    The rest is shuffled, each time alike: the files of a folder often wait for the same kind of thing, and two cores
    would wait at once.
    """
    name, room = item.path.name, item.nodeid.split("/")[1]
    shuffled = zlib.crc32(item.nodeid.partition("::")[0].encode())
    streams = SLEEPING.index(name) if name in SLEEPING else len(SLEEPING)
    late = SHORT[::-1].index(room) + 1 if room in SHORT else 0
    return streams, not item.nodeid.startswith(DEMO), name != LONG, room != "scenario", late, shuffled


class Scheduling(LoadFileScheduling):  # type: ignore[misc]  # xdist has no types
    """File by file, but all that sleep are one file, and all that look at the finished demo."""

    def _split_scope(self, nodeid: str) -> str:
        path = nodeid.split("::", 1)[0]
        if path in DEMO:
            return "demo"
        return "sleeping" if path.rsplit("/", 1)[-1] in SLEEPING else path
