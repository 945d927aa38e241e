"""Laser profiler whose profiles another program writes into a folder: `!FolderProfiler`."""

import dataclasses as dc
from pathlib import Path

import numpy as np

from weldcal.calibration.data.checks import read_rows
from weldcal.models.array_files import read_npy
from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.folder_source import FolderSource
from weldcal.systems.drivers.sensors.preflight import Sensed, look_at_scanner
from weldcal.systems.drivers.sensors.wired_profiler import (
    Profile,
    WiredProfiler,
    acquire_profiles,
    add_profiler,
    checked_profile,
)
from weldcal.systems.drivers.station_build import StationBuild

SUFFIXES = (".csv", ".npy")


@dc.dataclass(kw_only=True)
class FolderProfiler(WiredProfiler):
    """`!FolderProfiler`: the folder, and how the program that writes into it is triggered; see `!FolderScanner`.

    A file holds one profile: csv with the columns x and z, an empty cell where nothing was measured, or npy (n, 2).
    """

    folder: str = ""
    trigger: str = ""
    settle_s: float = 0.1
    remove_read: bool = False

    def source(self) -> FolderSource[Profile]:
        """Return the folder as a source of profiles. Raises InputError for keys that cannot be used."""

        def read(path: Path) -> Profile:
            return checked_profile(read_profile(path), {"m": 1.0, "mm": 1e-3}[self.unit], self)

        if self.unit not in ("m", "mm"):
            raise InputError(f"profiler.unit must be m or mm, not '{self.unit}'.")
        return FolderSource(
            name="The profiler",
            folder=self.folder,
            trigger=self.trigger,
            suffixes=SUFFIXES,
            read=read,
            settle_s=self.settle_s,
            remove_read=self.remove_read,
        )


def read_profile(path: Path) -> Profile:
    """Points (n, 2) [x, z] of a profile's file, in its unit, NaN where nothing was measured. Raises InputError."""
    if path.suffix.lower() == ".npy":
        return np.asarray(read_npy(path), dtype=np.float64)
    header, rows = read_rows(path)
    if not {"x", "z"} <= set(header):
        raise InputError(f"'{path.name}' has no columns x and z.")
    try:
        points = [[float(row[name] or "nan") for name in "xz"] for row in rows]
    except ValueError as error:
        raise InputError(f"'{path.name}' holds words where numbers are needed.") from error
    return np.array(points, dtype=np.float64).reshape(-1, 2)


def preflight(config: FolderProfiler) -> Sensed:
    """Take one profile. Raises InputError for keys that cannot be used."""
    return look_at_scanner(acquire_profiles(config, config.source()), streams=False, what="profile")


def ApplyDriverConfig(config: FolderProfiler, build: StationBuild) -> None:
    """Watch the folder from now on and add the profiler's ports."""
    add_profiler(config, config.source(), build)
