"""The world's end of a triggered scanner's pipe: tells how the world stands when a scan is asked for, and lets no scan
come late."""

import contextlib
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

POSE, DONE = "pose", "done"  # what the scanner says: it exposes now; its file lies in the folder
SCAN_S = 0.5  # of the world, from the exposure to the file, at most
FRAME_WAITS_S = (
    0.05  # of the host in each frame: the world goes on slowly, and a cell that follows it sees no broken link
)
LIMIT_S = 20.0  # of the host for one scan; a scanner that has stopped is not waited for any longer


class Scans:
    """Answers the scanner, and slows the world down while a scan takes longer than SCAN_S of its time on this computer.

    Args:
        pipe: to the scanner's process.
        standing: what the scanner is told: (Unix time s, plant positions).
    """

    def __init__(self, pipe: Connection, standing: Callable[[], object]) -> None:
        self._pipe, self._standing = pipe, standing
        self._begun_s: float | None = None  # the world's time of the newest exposure, while its file is not there
        self._waited_s = 0.0

    def answer(self, time_s: float) -> None:
        """Take what the scanner has said by this time of the world (s). Never waits."""
        with contextlib.suppress(OSError, EOFError):
            while self._pipe.poll(0.0):
                if self._pipe.recv() == POSE:
                    self._pipe.send(self._standing())
                    self._begun_s, self._waited_s = time_s, 0.0
                else:
                    self._begun_s = None

    def step(self, time_s: float) -> None:
        """Answer in a frame of the world at this time (s), and wait where a scan is late."""
        self.answer(time_s)
        if self._begun_s is None or time_s - self._begun_s < SCAN_S or self._waited_s > LIMIT_S:
            return
        begun = time.monotonic()
        with contextlib.suppress(OSError, EOFError):
            self._pipe.poll(FRAME_WAITS_S)
        self._waited_s += time.monotonic() - begun
        self.answer(time_s)
