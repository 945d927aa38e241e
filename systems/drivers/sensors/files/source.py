"""A folder into which another program writes, as a source of frames: the first complete file after a request answers it."""

import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from weldcal.models.errors import InputError
from weldcal.models.files import read_text
from weldcal.systems.drivers.sensors.acquisition import Delivery, DeviceLost, Garbage, Source
from weldcal.systems.drivers.sensors.files.new import NewFiles
from weldcal.systems.drivers.sensors.files.triggers import Trigger, trigger_of
from weldcal.systems.drivers.sensors.stamps import UnixClock

Datum = TypeVar("Datum")
POLL_S = 0.01
LISTING_SHARE = 0.1  # of the time that a folder of many files may be listed
LONGEST_POLL_S = 0.1
PATIENCE_S = 2.0  # for which a settled file that cannot be read may still become complete
BEFORE_S = 0.005  # a stamp may be this much before its trigger: the resolution of file times
SIDECAR = ".json"


class FolderSource(Source[Datum]):
    """What `read` makes of the files of some suffixes; it raises InputError for one that may not be complete, Garbage for a bad one."""

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
        if not 0.0 <= settle_s <= 60.0:
            raise InputError(f"{device}.settle_s must be from 0 to 60, and it is {settle_s:g}.")
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
        """The datum of a settled file; None where it may still be incomplete. Raises Garbage where it cannot be used."""
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
        """Capture time (Unix, s), request's number, the time of the scanner's own clock (s), and where the time is from."""
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
