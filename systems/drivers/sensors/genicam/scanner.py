"""3D scanner with GenICam: `!GenicamScanner`, by software trigger or running freely."""

import dataclasses as dc

from weldcal.systems.drivers.sensors.acquisition import Source
from weldcal.systems.drivers.sensors.genicam.device import (
    Component,
    GenicamDevice,
    GenicamKeys,
    GenicamSource,
    cloud_of,
    get_profile,
)
from weldcal.systems.drivers.sensors.own_process import SourceProcess
from weldcal.systems.drivers.sensors.preflight import Sensed, look_at_scanner
from weldcal.systems.drivers.sensors.wired_scanner import Cloud, WiredScanner, acquire, add_scanner, checked_cloud
from weldcal.systems.drivers.station_build import StationBuild

GENICAM_UNIT_M = 1e-3  # of a device that does not say its unit


@dc.dataclass(kw_only=True)
class GenicamScanner(GenicamKeys, WiredScanner):
    """`!GenicamScanner`: the maker's GenTL producer, the device, and its features.

    `unit: device` takes the unit of the profile, or of the device's Scan3dDistanceUnit.
    """

    unit: str = "device"

    @property
    def metres(self) -> float:
        """Metres of one unit of the points where it does not depend on the device."""
        if self.unit != "device":
            return super().metres
        unit = get_profile(self.profile).unit
        return {"m": 1.0, "mm": 1e-3}.get(unit, GENICAM_UNIT_M)

    def source(self) -> Source[Cloud]:
        """Return the device in a process of its own. Raises InputError for keys that cannot be used."""
        GenicamClouds(self)  # the keys are checked here, not in the process
        return SourceProcess(self.title("scanner"), GenicamClouds, self)


class GenicamClouds(GenicamSource[Cloud]):
    """The device as a source of clouds."""

    def __init__(self, config: GenicamScanner) -> None:
        profile = get_profile(config.profile)
        features = profile.features(streams=config.streams, own=config.settings)
        device = GenicamDevice(config.producer, config.device, features, profile.alive)
        super().__init__(device, config.title("scanner"), "" if config.streams else profile.trigger)
        self._asks_device = config.unit == "device" and profile.unit == "device"
        self._metres, self._far_m = config.metres, config.scanner().far_m

    def open(self) -> None:
        """See Source."""
        super().open()
        if self._asks_device and self.device.metres is not None:
            self._metres = self.device.metres

    def datum(self, components: tuple[Component, ...]) -> Cloud:
        """See GenicamSource."""
        return checked_cloud(cloud_of(components), self._metres, self._far_m)


def preflight(config: GenicamScanner) -> Sensed:
    """Take one scan. Raises InputError for keys that cannot be used."""
    return look_at_scanner(acquire(config, config.source()), streams=config.streams)


def ApplyDriverConfig(config: GenicamScanner, build: StationBuild) -> None:
    """Open the device and add the scanner's ports."""
    add_scanner(config, config.source(), build)
