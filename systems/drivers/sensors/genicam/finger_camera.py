"""Finger camera with GenICam: `!GenicamFingerCamera`, an industrial camera that runs freely."""

import dataclasses as dc

from weldcal.systems.drivers.sensors.acquisition import Source
from weldcal.systems.drivers.sensors.genicam.device import (
    Component,
    GenicamDevice,
    GenicamKeys,
    GenicamSource,
    get_profile,
    picture_of,
)
from weldcal.systems.drivers.sensors.own_process import SourceProcess
from weldcal.systems.drivers.sensors.preflight import Sensed, look_at_camera
from weldcal.systems.drivers.sensors.wired_camera import (
    Picture,
    WiredFingerCamera,
    acquire_pictures,
    add_camera,
    checked_picture,
)
from weldcal.systems.drivers.station_build import StationBuild


@dc.dataclass(kw_only=True)
class GenicamFingerCamera(GenicamKeys, WiredFingerCamera):
    """`!GenicamFingerCamera`: the maker's GenTL producer, device and features; `exposure_ms` sets ExposureTime."""

    def source(self) -> Source[Picture]:
        """Return the device in a process of its own. Raises InputError for keys that cannot be used."""
        GenicamPictures(self)  # the keys are checked here, not in the process
        return SourceProcess(self.title("finger camera"), GenicamPictures, self)


class GenicamPictures(GenicamSource[Picture]):
    """The device, running freely, as a source of grey pictures."""

    def __init__(self, config: GenicamFingerCamera) -> None:
        profile = get_profile(config.profile)
        own = dict(config.settings)
        if config.exposure_ms is not None:
            own["ExposureTime"] = f"{1e3 * config.exposure_ms:.6g}"  # microseconds in the naming convention
        if config.gain is not None:
            own["Gain"] = f"{config.gain:.6g}"
        features = profile.features(streams=True, own=own)
        super().__init__(
            GenicamDevice(config.producer, config.device, features, profile.alive), config.title("finger camera")
        )
        self._config = config

    def datum(self, components: tuple[Component, ...]) -> Picture:
        """See GenicamSource."""
        return checked_picture(picture_of(components), self._config.width, self._config.height)


def preflight(config: GenicamFingerCamera) -> Sensed:
    """Take the pictures of a second. Raises InputError for keys that cannot be used."""
    return look_at_camera(acquire_pictures(config, config.source()), config.rate_hz)


def ApplyDriverConfig(config: GenicamFingerCamera, build: StationBuild) -> None:
    """Open the camera and add the finger camera's ports."""
    add_camera(config, config.source(), build)
