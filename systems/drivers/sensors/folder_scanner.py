"""Scanner whose clouds another program writes into a folder: `!FolderScanner`."""

import dataclasses as dc
from pathlib import Path

from weldcal.calibration.data.clouds import NO_NOTES, read_cloud
from weldcal.systems.drivers.sensors.folder_source import FolderSource
from weldcal.systems.drivers.sensors.preflight import Sensed, look_at_scanner
from weldcal.systems.drivers.sensors.wired_scanner import Cloud, WiredScanner, acquire, add_scanner, checked_cloud
from weldcal.systems.drivers.station_build import StationBuild


@dc.dataclass(kw_only=True)
class FolderScanner(WiredScanner):
    """`!FolderScanner`: the folder, and how the program that writes into it is triggered.

    Files are ply, pcd, npz, npy, xyz, pts or asc as `calibrate` reads them. Beside NAME.ply a file NAME.json, written
    before it, may hold `capture_time` (Unix time, s), `request` (the number of the trigger that it answers) and
    `device_time` (s of the scanner's own clock, by which a motion job orders its frames; write `capture_time` too, by
    which a late frame is known).
    """

    folder: str = ""
    # tcp://HOST:PORT or file:PATH: the line `scan N`; empty: an operator or the program scans by itself
    trigger: str = ""
    settle_s: float = 0.1  # a file is complete when it has not changed for so long
    remove_read: bool = False  # delete files that were read

    def source(self) -> FolderSource[Cloud]:
        """Return the folder as a source of clouds. Raises InputError for keys that cannot be used."""
        metres, far_m = self.metres, self.scanner().far_m

        def read(path: Path) -> Cloud:
            return checked_cloud(read_cloud(path), metres, far_m)

        return FolderSource(
            name="The scanner",
            folder=self.folder,
            trigger=self.trigger,
            suffixes=NO_NOTES,
            read=read,
            settle_s=self.settle_s,
            remove_read=self.remove_read,
        )


def preflight(config: FolderScanner) -> Sensed:
    """Take one scan. Raises InputError for keys that cannot be used."""
    return look_at_scanner(acquire(config, config.source()), streams=config.streams)


def ApplyDriverConfig(config: FolderScanner, build: StationBuild) -> None:
    """Watch the folder from now on and add the scanner's ports."""
    add_scanner(config, config.source(), build)
