"""Finds files that another program has finished writing into a folder: complete ones only, each once, the newest first."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from weldcal.systems.drivers.sensors.stamps import unix_now

Signature = tuple[int, int, int]  # inode, size, time of the last change (ns)
SET_S = 0.5  # by which the computer's clock is set and not only disciplined
UNFINISHED = (".tmp", ".part", ".partial", ".crdownload")


@dataclass
class _Growing:
    """A file that may still be written: its signature, and when (s, monotonic) it was first seen with it."""

    signature: Signature
    since: float


class NewFiles:
    """Files of some suffixes that appear in a folder, or change, after `start`.

    A file is complete when its size and time of change have been the same for `settle_s`; one that was renamed into the folder
    and last changed before that is complete at once, unless the computer's clock was set since `start`.
    Names that begin with a dot or end as unfinished downloads do are never
    looked at. The folder is polled: network folders do not report changes.
    """

    def __init__(
        self, folder: Path, suffixes: tuple[str, ...], settle_s: float, unix: Callable[[], float] = unix_now
    ) -> None:
        self._folder, self._suffixes, self._settle_s, self._unix = folder, suffixes, settle_s, unix
        self._offset = unix() - time.monotonic()
        self._known: dict[str, Signature] = {}
        self._growing: dict[str, _Growing] = {}

    def start(self) -> None:
        """Take what is there now as old. Raises OSError where the folder cannot be read."""
        self._known = self._listed()
        self._growing = {}
        self._offset = self._unix() - time.monotonic()

    def complete(self) -> list[Path]:
        """New complete files, oldest change first, each of them once. Raises OSError where the folder cannot be read."""
        now, unix = time.monotonic(), self._unix()
        clock_was_set = abs(unix - now - self._offset) > SET_S
        listed = self._listed()
        self._known = {name: s for name, s in self._known.items() if name in listed}
        self._growing = {name: g for name, g in self._growing.items() if name in listed}
        ready: list[tuple[int, str]] = []
        for name, signature in listed.items():
            if signature == self._known.get(name) or signature[1] == 0:
                continue
            growing = self._growing.get(name)
            if growing is None or growing.signature != signature:
                growing = self._growing[name] = _Growing(signature, now)
            unchanged_s = now - growing.since
            if not clock_was_set:
                unchanged_s = max(unchanged_s, unix - 1e-9 * signature[2])
            if unchanged_s >= self._settle_s:
                ready.append((signature[2], name))
                self._known[name] = signature
                del self._growing[name]
        return [self._folder / name for _, name in sorted(ready)]

    def again(self, path: Path) -> None:
        """Report a file once more after it has settled: it was not complete after all."""
        self._known.pop(path.name, None)

    def _listed(self) -> dict[str, Signature]:
        found = {}
        with os.scandir(self._folder) as entries:
            for entry in entries:
                name = entry.name.lower()
                if name.startswith(".") or name.endswith(UNFINISHED) or not name.endswith(self._suffixes):
                    continue
                try:
                    status = entry.stat()
                except OSError:  # it was renamed or removed in between
                    continue
                found[entry.name] = (status.st_ino, status.st_size, status.st_mtime_ns)
        return found
