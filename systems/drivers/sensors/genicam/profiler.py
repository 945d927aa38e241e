"""Laser profiler with GenICam, such as a SICK Ranger3: `!GenicamProfiler`."""

import dataclasses as dc
import math

from weldcal.systems.drivers.sensors.acquisition import Source
from weldcal.systems.drivers.sensors.genicam.device import (
    UNIT_SCALING,
    Component,
    GenicamDevice,
    GenicamKeys,
    GenicamSource,
    get_profile,
    profile_of,
)
from weldcal.systems.drivers.sensors.own_process import SourceProcess
from weldcal.systems.drivers.sensors.preflight import Sensed, look_at_scanner
from weldcal.systems.drivers.sensors.wired_profiler import (
    Profile,
    WiredProfiler,
    acquire_profiles,
    add_profiler,
    checked_profile,
)
from weldcal.systems.drivers.station_build import StationBuild

_METRES = {"m": 1.0, "mm": 1e-3}


@dc.dataclass(kw_only=True)
class GenicamProfiler(GenicamKeys, WiredProfiler):
    """`!GenicamProfiler`: the maker's GenTL producer, the device, and its features.

    The last line of a frame is the profile. A range picture (Coord3D_C16) is scaled by the device's
    Scan3dCoordinateScale and Scan3dCoordinateOffset of its coordinates A and C.
    """

    profile: str = "ranger3"
    unit: str = "device"

    def source(self) -> Source[Profile]:
        """Return the device in a process of its own. Raises InputError for keys that cannot be used."""
        GenicamProfiles(self)  # the keys are checked here, not in the process
        return SourceProcess(self.title("profiler"), GenicamProfiles, self)


class GenicamProfiles(GenicamSource[Profile]):
    """The device as a source of profiles."""

    def __init__(self, config: GenicamProfiler) -> None:
        profile = get_profile(config.profile)
        features = profile.features(streams=False, own=config.settings)
        device = GenicamDevice(config.producer, config.device, features, profile.alive)
        super().__init__(device, config.title("profiler"), profile.trigger)
        self._config = config
        self._unit = profile.unit if config.unit == "device" else config.unit
        self._metres, self._scaling = 1e-3, UNIT_SCALING

    def open(self) -> None:
        """See Source."""
        super().open()
        self._metres = _METRES.get(self._unit, self.device.metres or 1e-3)
        self._scaling = (self._read_scaling("CoordinateA"), self._read_scaling("CoordinateC"))

    def datum(self, components: tuple[Component, ...]) -> Profile:
        """See GenicamSource."""
        return checked_profile(profile_of(components, self._scaling), self._metres, self._config)

    def _read_scaling(self, axis: str) -> tuple[float, float]:
        """Scale and offset of a coordinate; 1 and 0 where the device has none."""
        if self.device.read("Scan3dCoordinateSelector") is not None:
            self.device.nodes.get_node("Scan3dCoordinateSelector").from_string(axis)
        found = [self.device.read(f"Scan3dCoordinate{name}") for name in ("Scale", "Offset")]
        scale, offset = (math.nan if value is None else float(value) for value in found)
        return (1.0 if math.isnan(scale) else scale, 0.0 if math.isnan(offset) else offset)


def preflight(config: GenicamProfiler) -> Sensed:
    """Take one profile. Raises InputError for keys that cannot be used."""
    return look_at_scanner(acquire_profiles(config, config.source()), streams=False, what="profile")


def ApplyDriverConfig(config: GenicamProfiler, build: StationBuild) -> None:
    """Open the device and add the profiler's ports."""
    add_profiler(config, config.source(), build)
