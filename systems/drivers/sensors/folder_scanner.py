"""Scanner whose clouds another program writes into a folder: `!FolderScanner`."""

import dataclasses as dc
import json
import math
import time
from contextlib import suppress
from pathlib import Path

from weldcal.calibration.data.clouds import NO_NOTES, CloudError, read_cloud
from weldcal.models.errors import InputError
from weldcal.models.files import read_text
from weldcal.systems.drivers.sensors.acquisition import Delivery, DeviceLost, Garbage
from weldcal.systems.drivers.sensors.new_files import NewFiles
from weldcal.systems.drivers.sensors.triggers import Trigger, trigger_of
from weldcal.systems.drivers.sensors.wired_scanner import Cloud, WiredScanner, add_scanner, checked_cloud
from weldcal.systems.drivers.station_build import StationBuild

POLL_S = 0.01
PATIENCE_S = 2.0  # for which a settled file that cannot be read may still become complete
BEFORE_S = 0.005  # a stamp may be this much before its trigger: the resolution of file times
SIDECAR = ".json"


@dc.dataclass
class FolderScanner(WiredScanner):
    """`!FolderScanner`: the folder, and how the program that writes into it is told to scan.

    Files are ply, pcd, npz, npy or xyz as `calibrate` reads them. Beside NAME.ply a file NAME.json, written before it, may hold
    `capture_time` (Unix time, s) and `request` (the number of the trigger that it answers).
    """

    folder: str = ""
    trigger: str = ""  # tcp://HOST:PORT or file:PATH: the line `scan N`; empty: a person or the program scans by itself
    settle_s: float = 0.1  # a file is complete when it has not changed for so long
    remove_read: bool = False  # delete files that were read


class FolderSource:
    """The folder as a source of clouds: the first complete file after a request answers it."""

    def __init__(self, config: FolderScanner) -> None:
        if not config.folder:
            raise InputError("Write the folder of the scans in the scenario: scanner: !FolderScanner {folder: scans}.")
        if not 0.0 <= config.settle_s <= 60.0:
            raise InputError(f"scanner.settle_s must be from 0 to 60, and it is {config.settle_s:g}.")
        self._config = config
        self.folder = Path(config.folder)
        self.name = f"The scanner that writes into '{config.folder}'"
        self._metres, self._far_m = config.metres, config.scanner().far_m
        self._files = NewFiles(self.folder, NO_NOTES, config.settle_s)
        self._trigger: Trigger = trigger_of(config.trigger)
        self._doubtful: dict[Path, float] = {}
        self._request = 0
        self._asked_at = 0.0  # Unix time, s
        self._waiting: list[Path] = []
        self._lost = 0

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
        if self._config.trigger:
            self._start()  # what came before the trigger does not answer it
        self._waiting.clear()
        self._request, self._asked_at = request, time.time()
        self._trigger.send(request)

    def next(self, timeout_s: float) -> Delivery[Cloud] | None:
        """See Source."""
        until = time.monotonic() + timeout_s
        while True:
            self._trigger.look()
            try:
                self._waiting += self._files.complete()
            except OSError as error:
                raise DeviceLost(f"the folder '{self.folder}' cannot be read: {error.strerror}") from error
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

    def _start(self) -> None:
        try:
            self._files.start()
        except OSError as error:
            raise DeviceLost(f"the folder '{self.folder}' cannot be read: {error.strerror}") from error

    def _read(self, path: Path) -> Delivery[Cloud] | None:
        """The cloud of a settled file; None where it may still be incomplete. Raises Garbage where it cannot be used."""
        try:
            points = read_cloud(path)
        except CloudError as error:
            since = self._doubtful.setdefault(path, time.monotonic())
            if time.monotonic() - since < PATIENCE_S:
                self._files.again(path)
                return None
            del self._doubtful[path]
            raise Garbage(error.reason) from error
        self._doubtful.pop(path, None)
        captured, request, where = self._sidecar(path)
        if request not in (None, self._request):
            raise Garbage(f"{path.name} answers the trigger {request}, and the newest is {self._request}")
        if captured is not None and self._request and captured < self._asked_at - BEFORE_S:
            raise Garbage(f"{path.name} was captured before it was asked for")
        cloud = checked_cloud(points, self._metres, self._far_m)
        arrived = time.monotonic()
        if self._config.remove_read:
            with suppress(OSError):
                path.unlink()
                path.with_suffix(SIDECAR).unlink(missing_ok=True)
        return Delivery(
            cloud, arrived, unix_time=captured, request=self._request, note=f"{path.name}, time from {where}"
        )

    def _sidecar(self, path: Path) -> tuple[float | None, int | None, str]:
        """Capture time (Unix, s), request's number, and where the time is from."""
        beside = path.with_suffix(SIDECAR)
        if not beside.is_file():
            return None, None, "its arrival"
        try:
            said = json.loads(read_text(beside))
            captured, request = said.get("capture_time"), said.get("request")
            captured = None if captured is None else float(captured)
            request = None if request is None else int(request)
            if captured is not None and not math.isfinite(captured):
                raise ValueError(captured)
        except (InputError, ValueError, TypeError, AttributeError, OverflowError) as error:
            raise Garbage(f"{beside.name} is not a JSON object with capture_time and request") from error
        return captured, request, "its arrival" if captured is None else beside.name


def ApplyDriverConfig(config: FolderScanner, build: StationBuild) -> None:
    """Watch the folder from now on and add the scanner's ports."""
    add_scanner(config, FolderSource(config), build)
