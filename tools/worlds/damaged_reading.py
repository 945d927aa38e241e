"""Reads damaged files in a child process, which is started anew after it hung, died or took too much memory.

As a program of its own this module is the child: it reads "reader seed case" lines and answers each with a line of
JSON.
"""

import json
import os
import resource
import selectors
import shutil
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

from weldcal.tools.worlds.damaged_files import CRASH, HANG, MEMORY, READERS, Reader, ReaderVerdict, judge

WATCHDOG_S = 10.0
WORKER = ("-m", "weldcal.tools.worlds.damaged_reading")
_START_S = 120.0  # to import everything, on a slow computer
FREE = 1024**3  # bytes above those of the idle process that any file may take
TIMES = 10  # and as many times the size of the file


class Child:
    """A worker process, started anew after it hung, died or took too much memory."""

    def __init__(self, place: Path) -> None:
        self._place = place
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def ask(self, reader: Reader, seed: int, case: int) -> tuple[ReaderVerdict, float]:
        """The verdict of a case, and how many seconds it took with making its files."""
        limit = WATCHDOG_S if self._process is not None else WATCHDOG_S + _START_S
        process = self._process or self._start()
        assert process.stdin is not None
        try:
            process.stdin.write(f"{reader.name} {seed} {case}\n")
            process.stdin.flush()
        except BrokenPipeError:
            self._end()
            return ReaderVerdict(CRASH, "the worker ended before the case"), 0.0
        answer = self._line(process, limit)
        if answer is None:
            hung = process.poll() is None
            self._end()
            if hung:
                return ReaderVerdict(HANG, f"no answer within {WATCHDOG_S:g} s"), WATCHDOG_S
            return ReaderVerdict(CRASH, f"exit {process.returncode}"), 0.0
        said: dict[str, Any] = json.loads(answer)
        if said["said"] == MEMORY:  # the next case begins with little
            self._end()
        return ReaderVerdict(said["said"], said["detail"]), said["seconds"]

    def _start(self) -> subprocess.Popen[str]:
        shutil.rmtree(self._place, ignore_errors=True)
        self._place.mkdir()
        command = [sys.executable, "-P", *WORKER, str(self._place)]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
        )
        return self._process

    def _line(self, process: subprocess.Popen[str], limit: float) -> str | None:
        """The next line of the worker; None where none comes in time, or the worker ends."""
        assert process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            if not selector.select(limit):
                return None
        line = process.stdout.readline()
        if not line:
            process.wait()
        return line or None

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


def main() -> None:
    """Work in the folder that is the first argument until the input ends."""
    folder = Path(sys.argv[1])
    os.chdir(folder)
    warnings.simplefilter("ignore")
    readers = {reader.name: reader for reader in READERS}
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print must not come between the answers
    idle = _peak()
    for line in sys.stdin:
        name, seed, case = line.split()
        place = folder / "case"
        begin = time.monotonic()
        verdict = judge(readers[name], int(seed), int(case), place)
        seconds = time.monotonic() - begin
        size = sum(p.stat().st_size for p in place.rglob("*") if p.is_file() and not p.is_symlink())
        if too_much(_peak() - idle, size):
            verdict = ReaderVerdict(MEMORY, f"{(_peak() - idle) / 2**20:.0f} MiB for {size} bytes; {verdict.said}")
        answers.write(json.dumps({"said": verdict.said, "detail": verdict.detail, "seconds": seconds}) + "\n")
        answers.flush()


def too_much(taken: int, size: int) -> bool:
    """Whether a case took more bytes than files of so many bytes may."""
    return taken > FREE + TIMES * size


def _peak() -> int:
    """The largest resident size so far, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    main()
