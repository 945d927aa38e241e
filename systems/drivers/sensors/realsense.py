"""Intel RealSense depth camera: `!RealSense`."""

import dataclasses as dc
import importlib.util
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from weldcal.models.depth_noise import DepthNoise
from weldcal.models.errors import InputError
from weldcal.models.scanners import ScannerPreset
from weldcal.systems.drivers.sensors.acquisition import Delivery, DeviceLost, Garbage, Source
from weldcal.systems.drivers.sensors.own_process import SourceProcess
from weldcal.systems.drivers.sensors.preflight import Sensed, look_at_scanner
from weldcal.systems.drivers.sensors.wired_scanner import Cloud, WiredScanner, acquire, add_scanner, checked_cloud
from weldcal.systems.drivers.station_build import StationBuild

INSTALL = "pip install 'weldcal[realsense]'"
SILENT_S = 2.0  # an open camera streams: after so long without a frame it is gone
QUEUE = 4


def _stereo(name: str, fov_deg: float, near: float, far: float, optimum: float, sigma: float) -> ScannerPreset:
    """Return a stereo camera of 1280 x 720: view and range as in Intel's data sheet, typical noise."""
    f = 640.0 / np.tan(np.deg2rad(0.5 * fov_deg))
    noise = DepthNoise(sigma_m=sigma, reference_m=optimum, edge_step_m=0.01, flying=0.5, edge_dropout=0.2)
    return ScannerPreset(
        name=name,
        width=1280,
        height=720,
        fx=float(f),
        fy=float(f),
        cx=639.5,
        cy=359.5,
        near_m=near,
        far_m=far,
        optimum_m=optimum,
        noise=noise,
    )


PRESETS = {
    p.name: p
    for p in (
        _stereo("d405", 87.0, 0.07, 0.50, 0.25, 2.5e-4),
        _stereo("d415", 65.0, 0.45, 3.00, 0.60, 1.0e-3),
        _stereo("d435", 87.0, 0.30, 3.00, 0.60, 1.5e-3),
    )
}


@dc.dataclass(kw_only=True)
class RealSense(WiredScanner):
    """`!RealSense`: the camera by its serial number, its depth stream and its options.

    `preset` is d405, d415, d435 or a scanner known by name; intrinsics and depth scale are read from the device.
    """

    preset: str = "d405"
    serial: str = ""  # empty: the only one
    stream_width: int = 1280
    stream_height: int = 720
    fps: int = 15
    depth_unit_mm: float | None = None  # step of the depths; null: as the camera has it
    exposure_ms: float | None = None  # null: automatic
    options: dict[str, float] = dc.field(default_factory=dict)  # of the depth sensor, by librealsense's names

    def scanner(self) -> ScannerPreset:
        """Return the preset with the configured resolution."""
        found = PRESETS.get(self.preset)
        if found is None:
            return super().scanner()
        return found if self.width is None else found.resized(self.width, self.height)

    def source(self) -> Source[Cloud]:
        """Return the camera in a process of its own. Raises InputError where pyrealsense2 is not installed."""
        require_realsense()
        self.scanner()
        return SourceProcess(title(self), RealSenseClouds, self)


def title(config: RealSense) -> str:
    """Return the camera's name at the beginning of a sentence."""
    return f"The scanner RealSense {config.serial or config.preset}"


def require_realsense() -> None:
    """Raises InputError, with the line to type, where pyrealsense2 is not installed."""
    if importlib.util.find_spec("pyrealsense2") is None:
        raise InputError(f"A RealSense needs the package pyrealsense2, which is not installed: type {INSTALL}.")


def connected_devices() -> list[Any]:
    """Return the cameras at this computer."""
    import pyrealsense2 as rs

    return list(rs.context().query_devices())


class RealSenseClouds(Source[Cloud]):
    """The depth stream as a source of clouds; `devices` lists the cameras."""

    def __init__(self, config: RealSense, devices: Callable[[], Iterable[Any]] = connected_devices) -> None:
        require_realsense()
        import pyrealsense2 as rs

        self._rs, self._config, self._devices = rs, config, devices
        self.name, self._far_m = title(config), config.scanner().far_m
        self._device: Any = None
        self._sensor: Any = None
        self._queue: Any = None
        self._points = rs.pointcloud()
        self._heard = 0.0
        self._request, self._skip = 0, 0

    def open(self) -> None:
        """See Source."""
        self._device = self._found()
        self._sensor = self._device.first_depth_sensor()
        profile = self._stream(self._sensor)
        self._set_options(self._sensor)
        self._queue = self._rs.frame_queue(QUEUE)
        try:
            self._sensor.open(profile)
            self._sensor.start(self._queue)
        except RuntimeError as error:
            raise DeviceLost(f"it cannot be started, perhaps because another program uses it ({error})") from error
        self._heard = time.monotonic()

    def ask(self, request: int) -> None:
        """See Source."""
        while self._queue.poll_for_frame():  # frames of before the request
            pass
        self._request, self._skip = request, 0 if self._config.streams else 1  # one exposure may be under way

    def next(self, timeout_s: float) -> Delivery[Cloud] | None:
        """See Source."""
        there, frame = self._queue.try_wait_for_frame(max(1, int(1e3 * timeout_s)))
        arrived = time.monotonic()
        if not there:
            if arrived - self._heard > SILENT_S or not self._device.is_connected():
                raise DeviceLost("it sends nothing any more: look at its USB cable")
            return None
        self._heard = arrived
        if self._skip:
            self._skip -= 1
            return None
        depth = frame.as_depth_frame()
        if not depth:
            raise Garbage("it sent a frame that is no depth picture")
        calculated = self._points.calculate(depth)  # its memory must live until the cloud is copied out of it
        vertices = np.asanyarray(calculated.get_vertices()).view(np.float32)
        points = vertices.reshape(depth.get_height(), depth.get_width(), 3).copy()
        del calculated
        cloud = checked_cloud(points, 1.0, self._far_m)
        stamp, number = 1e-3 * float(depth.get_timestamp()), int(depth.get_frame_number())
        host = depth.frame_timestamp_domain != self._rs.timestamp_domain.hardware_clock
        if host:  # librealsense has mapped it to this computer's clock
            return Delivery(datum=cloud, arrived=arrived, unix_time=stamp, number=number, request=self._request)
        return Delivery(datum=cloud, arrived=arrived, device_time=stamp, number=number, request=self._request)

    def close(self) -> None:
        """See Source."""
        if self._sensor is not None:
            for stop in (self._sensor.stop, self._sensor.close):
                try:
                    stop()
                except RuntimeError:  # it is gone, or was not started
                    continue
        self._sensor = self._device = self._queue = None

    def _found(self) -> Any:
        serials = {self._serial(device): device for device in self._devices()}
        wanted = self._config.serial or (next(iter(serials)) if len(serials) == 1 else None)
        found = None if wanted is None else serials.get(wanted)
        if found is None:
            names = ", ".join(serials) or "none"
            raise DeviceLost(f"there is no such camera (there are: {names}); plug it in, or write its serial number")
        return found

    def _serial(self, device: Any) -> str:
        info = self._rs.camera_info.serial_number
        return str(device.get_info(info)) if device.supports(info) else ""

    def _stream(self, sensor: Any) -> Any:
        """Return the depth stream of the configured size and rate."""
        c, sizes = self._config, []
        for profile in sensor.get_stream_profiles():
            video = profile.as_video_stream_profile()
            if profile.stream_type() != self._rs.stream.depth or profile.format() != self._rs.format.z16:
                continue
            sizes.append(f"{video.width()} x {video.height()} at {profile.fps()}")
            if (video.width(), video.height(), profile.fps()) == (c.stream_width, c.stream_height, c.fps):
                return profile
        raise DeviceLost(
            f"it has no depth stream of {c.stream_width} x {c.stream_height} at {c.fps} Hz: set scanner.stream_width, "
            f"stream_height and fps to one of {', '.join(sorted(set(sizes))[:12]) or 'none'}"
        )

    def _set_options(self, sensor: Any) -> None:
        wanted: dict[str, float] = {}
        if self._config.depth_unit_mm is not None:
            wanted["depth_units"] = 1e-3 * self._config.depth_unit_mm
        if self._config.exposure_ms is not None:
            wanted |= {"enable_auto_exposure": 0.0, "exposure": 1e3 * self._config.exposure_ms}
        for name, value in {**wanted, **self._config.options}.items():
            option = getattr(self._rs.option, name, None)
            if option is None or not sensor.supports(option) or sensor.is_option_read_only(option):
                raise DeviceLost(f"it has no option {name} that can be set: correct it in the scenario")
            try:
                sensor.set_option(option, float(value))
            except RuntimeError as error:
                raise DeviceLost(f"it does not accept {value:g} for its option {name} ({error})") from error


def preflight(config: RealSense) -> Sensed:
    """Take one scan. Raises InputError for keys that cannot be used."""
    return look_at_scanner(acquire(config, config.source()), streams=config.streams)


def ApplyDriverConfig(config: RealSense, build: StationBuild) -> None:
    """Open the camera and add the scanner's ports."""
    add_scanner(config, config.source(), build)
