"""Watches for pauses of the computer as a whole, seen by a process that has nothing to do with robot or cell."""

from __future__ import annotations

import subprocess
import sys
from types import TracebackType

PAUSE_S = 0.05  # the watcher sleeps 5 ms; ten times that without the processor is a pause
_WATCH = """
import time
last = time.monotonic()
while True:
    time.sleep(0.005)
    now = time.monotonic()
    if now - last > {pause}:
        print(last, now - last, flush=True)
    last = now
"""


class PauseWatch:
    """Collects `pauses`, (begin s on the monotonic clock, length s), until the block ends."""

    def __init__(self) -> None:
        self.pauses: list[tuple[float, float]] = []

    @property
    def pid(self) -> int:
        """The watching process."""
        return self._process.pid

    def __enter__(self) -> PauseWatch:
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _WATCH.format(pause=PAUSE_S)], stdout=subprocess.PIPE, text=True
        )
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._process.terminate()
        said, _ = self._process.communicate(timeout=10.0)
        for line in said.splitlines():
            begin, length = map(float, line.split())
            self.pauses.append((begin, length))

    @property
    def sentence(self) -> str:
        """What was seen, for a failing test."""
        if not self.pauses:
            return "the computer never paused"
        longest = max(length for _, length in self.pauses)
        return f"the computer paused {len(self.pauses)} times, for {longest:.2f} s at most: run the test on an idle one"
