"""A folder into which another program writes, as a source of frames.

The first complete file after a request answers it.
"""

import json
import math
import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from weldcal.models.errors import InputError
from weldcal.models.files import read_text
from weldcal.systems.drivers.config import check_range
from weldcal.systems.drivers.sensors.acquisition import Delivery, DeviceFault, DeviceLost, Garbage, Source
from weldcal.systems.drivers.sensors.stamps import UnixClock, unix_now

CONNECT_S = 2.0  # a choice: a host of the local network answers within ms, or after one lost packet in 1 s
LONGEST_LINE = 4096


# s without a word until the other side is asked, s between such questions, and how many without an answer are the end
KEEP_ALIVE = {"TCP_KEEPIDLE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}


class Trigger:
    """Trigger another program. This one does nothing: that program or an operator scans once the arm is at rest."""

    def open(self) -> None:
        """Connect. Raises DeviceLost."""

    def send(self, request: int) -> None:
        """Ask for scan number `request`. Raises DeviceLost."""

    def look(self) -> None:
        """Read the other program's answer. Raises DeviceLost where it is gone, DeviceFault where it refuses."""

    def close(self) -> None:
        """Disconnect; a second call has no effect."""


class FileTrigger(Trigger):
    """Replaces a file as a whole: its content is the line `scan N`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def open(self) -> None:
        """See Trigger."""
        if not self._path.parent.is_dir():
            raise DeviceLost(f"there is no folder '{self._path.parent}' for the trigger file")

    def send(self, request: int) -> None:
        """See Trigger."""
        unfinished = self._path.with_name(f".{self._path.name}.tmp")
        try:
            unfinished.write_text(f"scan {request}\n", encoding="ascii")
            os.replace(unfinished, self._path)
        except OSError as error:
            raise DeviceLost(f"the trigger file '{self._path}' cannot be written: {error.strerror}") from error


class TcpTrigger(Trigger):
    """Sends the line `scan N` over a TCP connection that stays open.

    The other program may answer `ok N` or `error TEXT`.
    """

    def __init__(self, host: str, port: int) -> None:
        self._at = (host, port)
        self._socket: socket.socket | None = None
        self._unread = b""

    def open(self) -> None:
        """See Trigger."""
        try:
            self._socket = socket.create_connection(self._at, CONNECT_S)
        except OSError as error:
            raise DeviceLost(
                f"its trigger at {self._at[0]}:{self._at[1]} does not answer ({error.strerror or error}): "
                "start the program that scans"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # nothing is sent between scans, so that a pulled cable would show at the next one only
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in KEEP_ALIVE.items():
            if hasattr(socket, option):
                self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        self._unread = b""

    def send(self, request: int) -> None:
        """See Trigger."""
        if self._socket is None:
            raise DeviceLost("its trigger is not connected")
        self._socket.settimeout(CONNECT_S)
        try:
            self._socket.sendall(f"scan {request}\n".encode("ascii"))
        except OSError as error:
            raise DeviceLost(f"its trigger at {self._at[0]}:{self._at[1]} is gone") from error

    def look(self) -> None:
        """See Trigger."""
        if self._socket is None:
            return
        self._socket.settimeout(0.0)
        try:
            found = self._socket.recv(LONGEST_LINE)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            raise DeviceLost(f"its trigger at {self._at[0]}:{self._at[1]} is gone") from error
        if not found:
            raise DeviceLost(f"its trigger at {self._at[0]}:{self._at[1]} has ended the connection")
        *lines, self._unread = (self._unread + found).split(b"\n")
        self._unread = self._unread[-LONGEST_LINE:]
        for line in lines:
            said = line.decode("utf-8", "replace").strip()
            if said.startswith("error"):
                raise DeviceFault(f"the program that scans says: {said.removeprefix('error').strip()[:200]}")

    def close(self) -> None:
        """See Trigger."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def trigger_of(text: str) -> Trigger:
    """Return the trigger of a scenario's word: empty, `file:PATH`, or `tcp://HOST:PORT`.

    Raises:
        InputError: it is none of these.
    """
    if not text:
        return Trigger()
    if text.startswith("file:") and len(text) > 5:
        return FileTrigger(Path(text[5:]))
    host, _, port = text.removeprefix("tcp://").rpartition(":")
    if text.startswith("tcp://") and host and port.isdigit() and 0 < int(port) < 65536:
        return TcpTrigger(host, int(port))
    raise InputError(
        f"scanner.trigger must be empty, file:PATH or tcp://HOST:PORT, not '{text[:100]}': give the port at which the"
        " program that scans listens, such as tcp://127.0.0.1:5020."
    )


Signature = tuple[int, int, int]  # inode, size, time of the last change (ns)
SET_S = 0.5  # by which the computer's clock is set and not only disciplined
UNFINISHED = (".tmp", ".part", ".partial", ".crdownload")


class NewFiles:
    """Files of some suffixes that appear in a folder, or change, after `start`.

    A file is complete when its size and time of change have been the same for `settle_s`. One that was renamed into the
    folder and last changed before that is complete at once, unless the computer's clock was set since `start`. Names
    that begin with a dot or end as unfinished downloads do are never looked at. The folder is polled: network folders
    do not report changes.
    """

    def __init__(
        self, folder: Path, suffixes: tuple[str, ...], settle_s: float, unix: Callable[[], float] = unix_now
    ) -> None:
        self._folder, self._suffixes, self._settle_s, self._unix = folder, suffixes, settle_s, unix
        self._offset = unix() - time.monotonic()
        self._known: dict[str, Signature] = {}
        self._growing: dict[str, tuple[Signature, float]] = {}  # and since when it has that signature, s

    def start(self) -> None:
        """Take what is there now as old. Raises OSError where the folder cannot be read."""
        self._known = self._listed()
        self._growing = {}
        self._offset = self._unix() - time.monotonic()

    def complete(self) -> list[Path]:
        """New complete files, oldest change first, each of them once.

        Raises OSError where the folder cannot be read.
        """
        now, unix = time.monotonic(), self._unix()
        clock_was_set = abs(unix - now - self._offset) > SET_S
        listed = self._listed()
        self._known = {name: s for name, s in self._known.items() if name in listed}
        self._growing = {name: g for name, g in self._growing.items() if name in listed}
        ready: list[tuple[int, str]] = []
        for name, signature in listed.items():
            if signature == self._known.get(name) or signature[1] == 0:
                continue
            if self._growing.get(name, (None, now))[0] != signature:
                self._growing[name] = (signature, now)
            unchanged_s = now - self._growing[name][1]
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


Datum = TypeVar("Datum")
POLL_S = 0.01  # a choice: adds 5 ms on average to a scan's wait; half of it doubles the listings of a folder
LISTING_SHARE = 0.1  # of the time that a folder of many files may be listed
LONGEST_POLL_S = 0.1  # a choice: a folder whose listing takes 10 ms or more is listed 10 times a second
PATIENCE_S = 2.0  # for which a settled file that cannot be read may still become complete
BEFORE_S = 0.005  # a stamp may be this much before its trigger: the resolution of file times
SIDECAR = ".json"


class FolderSource(Source[Datum]):
    """What `read` makes of the files of some suffixes.

    It raises InputError for one that may not be complete, Garbage for a bad one.
    """

    def __init__(
        self,
        name: str,
        folder: str,
        trigger: str,
        suffixes: tuple[str, ...],
        read: Callable[[Path], Datum],
        settle_s: float,
        remove_read: bool,
    ) -> None:
        device = name.split()[-1]
        if not folder:
            kind = f"Folder{device.capitalize()}"
            raise InputError(f"Write the folder of its files in the scenario: {device}: !{kind} {{folder: scans}}.")
        check_range(f"{device}.settle_s", settle_s, 0.0, 60.0)
        self.folder, self.name = Path(folder), f"{name} that writes into '{folder}'"
        self._read_file, self._remove_read, self._triggered = read, remove_read, bool(trigger)
        self._files = NewFiles(self.folder, suffixes, settle_s)
        self._trigger: Trigger = trigger_of(trigger)
        self._doubtful: dict[Path, float] = {}
        self._request = 0
        self._asked_at = 0.0  # s, monotonic
        self._unix = UnixClock()
        self._waiting: list[Path] = []
        self._list_at = 0.0  # s, monotonic

    def open(self) -> None:
        """See Source."""
        if not self.folder.is_dir():
            raise DeviceLost(f"there is no folder '{self.folder}': make it, and let the scanner's program write there")
        self._trigger.open()
        self._waiting.clear()
        self._doubtful.clear()
        self._start()

    def ask(self, request: int) -> None:
        """See Source."""
        if self._triggered:
            self._start()  # what came before the trigger does not answer it
        self._waiting.clear()
        self._request, self._asked_at = request, time.monotonic()
        self._trigger.send(request)

    def next(self, timeout_s: float) -> Delivery[Datum] | None:
        """See Source."""
        until = time.monotonic() + timeout_s
        while True:
            self._trigger.look()
            if time.monotonic() >= self._list_at:
                self._list()
            while self._waiting:
                path = self._waiting.pop(0)
                if (found := self._read(path)) is not None:
                    return found
            if (left := until - time.monotonic()) <= 0.0:
                return None
            time.sleep(min(POLL_S, left))

    def close(self) -> None:
        """See Source."""
        self._trigger.close()

    def _list(self) -> None:
        begun = time.monotonic()
        try:
            self._waiting += self._files.complete()
        except OSError as error:
            raise DeviceLost(f"the folder '{self.folder}' cannot be read: {error.strerror}") from error
        ended = time.monotonic()
        self._list_at = ended + min(max(POLL_S, (ended - begun) / LISTING_SHARE), LONGEST_POLL_S)

    def _start(self) -> None:
        self._list_at = 0.0
        try:
            self._files.start()
        except OSError as error:
            raise DeviceLost(f"the folder '{self.folder}' cannot be read: {error.strerror}") from error

    def _read(self, path: Path) -> Delivery[Datum] | None:
        """Return the datum of a settled file; None where it may still be incomplete.

        Raises Garbage where it cannot be used.
        """
        try:
            datum = self._read_file(path)
        except InputError as error:
            since = self._doubtful.setdefault(path, time.monotonic())
            if time.monotonic() - since < PATIENCE_S:
                self._files.again(path)
                return None
            del self._doubtful[path]
            raise Garbage(str(error)) from error
        self._doubtful.pop(path, None)
        captured, request, device, where = self._sidecar(path)
        if request not in (None, self._request):
            raise Garbage(f"{path.name} answers the trigger {request}, and the newest is {self._request}")
        arrived = time.monotonic()
        earliest = self._asked_at - BEFORE_S if self._request else float("-inf")
        if captured is not None and self._unix.to_monotonic(captured, arrived) < earliest:
            raise Garbage(f"{path.name} was captured before it was asked for")
        if self._remove_read:
            with suppress(OSError):
                path.unlink()
                path.with_suffix(SIDECAR).unlink(missing_ok=True)
        return Delivery(
            datum=datum,
            arrived=arrived,
            device_time=device,
            unix_time=captured,
            request=self._request,
            note=f"{path.name}, time from {where}",
        )

    def _sidecar(self, path: Path) -> tuple[float | None, int | None, float | None, str]:
        """Capture time (Unix, s), request's number, time of the scanner's own clock (s), and where the time is from."""
        beside = path.with_suffix(SIDECAR)
        if not beside.is_file():
            return None, None, None, "its arrival"
        try:
            said = json.loads(read_text(beside))
            captured, device = (
                None if said.get(key) is None else float(said[key]) for key in ("capture_time", "device_time")
            )
            request = None if said.get("request") is None else int(said["request"])
            if not all(math.isfinite(time) for time in (captured, device) if time is not None):
                raise ValueError(said)
        except (InputError, ValueError, TypeError, AttributeError, OverflowError) as error:
            raise Garbage(f"{beside.name} is not a JSON object with capture_time, device_time and request") from error
        return captured, request, device, "its arrival" if captured is None and device is None else beside.name
