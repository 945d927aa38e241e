"""Finger camera over UVC, RTSP, MJPEG over HTTP, or a video file: `!VideoFingerCamera`."""

import dataclasses as dc
import math
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import Delivery, DeviceLost, Garbage, Source
from weldcal.systems.drivers.sensors.mjpeg import MjpegStream
from weldcal.systems.drivers.sensors.preflight import Sensed, look_at_camera
from weldcal.systems.drivers.sensors.wired_camera import (
    Picture,
    WiredFingerCamera,
    acquire_pictures,
    add_camera,
    checked_picture,
)
from weldcal.systems.drivers.station_build import StationBuild

STAMPS = ("host", "device", "none")
READ_MS, OPEN_MS = 1000, 5000
UNDECODED = "it sent a picture that cannot be decoded"


@dc.dataclass(kw_only=True)
class VideoFingerCamera(WiredFingerCamera):
    """`!VideoFingerCamera`: where the pictures come from.

    `source`: http://HOST:PORT/PATH (MJPEG), rtsp://..., the number or path of a video device (0, /dev/video0), or a video file.
    `stamps` of an MJPEG stream's header X-Timestamp (s): host, of this computer's clock (Unix time); device, of a clock of its
    own, whose offset is found from the earliest arrivals; none. Without stamps a picture was taken `latency_s` before it came.
    """

    source: str = ""
    stamps: str = "none"

    def open_source(self) -> Source[Picture]:
        """The source of pictures that `source` names. Raises InputError where it names none."""
        if not self.source:
            raise InputError(
                "Write the camera's source in the scenario: finger_camera: !VideoFingerCamera {source: http://HOST:PORT/PATH}."
            )
        if self.stamps not in STAMPS:
            raise InputError(f"finger_camera.stamps must be {', '.join(STAMPS)}, not '{self.stamps}'.")
        if self.source.startswith("http://"):
            if self.exposure_ms is not None or self.gain is not None:
                raise InputError(
                    "The exposure of an MJPEG stream is set at its camera: leave finger_camera.exposure_ms and gain at null."
                )
            return MjpegSource(self)
        if self.stamps != "none":
            raise InputError("Only an MJPEG stream over http has stamps: set finger_camera.stamps to none.")
        return CaptureSource(self)


class MjpegSource(Source[Picture]):
    """The pictures of an MJPEG stream, with the stamps of their parts."""

    def __init__(self, config: VideoFingerCamera) -> None:
        self._config = config
        self._stream = MjpegStream(config.source)
        self.name = f"The finger camera at {config.source.rsplit('@', 1)[-1].removeprefix('http://')}"

    def open(self) -> None:
        """See Source."""
        self._stream.open()

    def ask(self, request: int) -> None:
        """See Source."""

    def next(self, timeout_s: float) -> Delivery[Picture] | None:
        """See Source."""
        part = self._stream.next(timeout_s)
        if part is None:
            return None
        picture = cv2.imdecode(np.frombuffer(part.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        if picture is None:
            raise Garbage(UNDECODED)
        grey = checked_picture(picture, self._config.width, self._config.height)
        if self._config.stamps == "none":
            return Delivery(datum=grey, arrived=part.arrived)
        text = part.headers.get("x-timestamp", "")
        try:
            stamp = float(text)
        except ValueError:
            stamp = math.nan
        if not math.isfinite(stamp):
            raise Garbage(f"its header X-Timestamp is '{text[:40]}', not seconds: set finger_camera.stamps to none")
        if self._config.stamps == "host":
            return Delivery(datum=grey, arrived=part.arrived, unix_time=stamp)
        return Delivery(datum=grey, arrived=part.arrived, device_time=stamp)

    def close(self) -> None:
        """See Source."""
        self._stream.close()


class CaptureSource(Source[Picture]):
    """A camera or a file that OpenCV reads."""

    def __init__(self, config: VideoFingerCamera) -> None:
        self._config, self._source = config, config.source
        self.name = f"The finger camera '{config.source.rsplit('@', 1)[-1]}'"
        self._capture: Any = None
        self._is_file = False
        self._due = 0.0

    def open(self) -> None:
        """See Source."""
        source, config = self._source, self._config
        timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, OPEN_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, READ_MS]
        if source.isdigit() or source.startswith("/dev/"):
            self._capture = cv2.VideoCapture(int(source) if source.isdigit() else source, cv2.CAP_V4L2)
            self._set(cv2.CAP_PROP_FRAME_WIDTH, config.width)
            self._set(cv2.CAP_PROP_FRAME_HEIGHT, config.height)
            self._set(cv2.CAP_PROP_FPS, config.rate_hz)
            self._set(cv2.CAP_PROP_BUFFERSIZE, 1)
        else:
            self._is_file = "://" not in source
            if self._is_file and not Path(source).is_file():
                raise DeviceLost(f"there is no file '{source}'")
            self._capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, timeouts)
        if not self._capture.isOpened():
            raise DeviceLost(
                "it cannot be opened: look at its cable and its address, and close other programs that use it"
            )
        if config.exposure_ms is not None:
            # V4L2 counts 0.1 ms, and 1 is its manual mode
            self._set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)
            self._must_set(cv2.CAP_PROP_EXPOSURE, 10.0 * config.exposure_ms, "exposure_ms")
        if config.gain is not None:
            self._must_set(cv2.CAP_PROP_GAIN, config.gain, "gain")
        self._due = time.monotonic()

    def ask(self, request: int) -> None:
        """See Source."""

    def next(self, timeout_s: float) -> Delivery[Picture] | None:
        """See Source."""
        if self._is_file:  # at the file's own rate
            if (wait := self._due - time.monotonic()) > timeout_s:
                time.sleep(timeout_s)
                return None
            time.sleep(max(wait, 0.0))
            self._due = max(self._due + 1.0 / self._config.rate_hz, time.monotonic() - 1.0)
        there, picture = self._capture.read()
        arrived = time.monotonic()
        if not there or picture is None:
            raise DeviceLost("the file has ended" if self._is_file else "it sends no pictures any more")
        grey = checked_picture(picture, self._config.width, self._config.height)
        return Delivery(datum=grey, arrived=arrived)

    def close(self) -> None:
        """See Source."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _set(self, key: int, value: float) -> bool:
        return bool(self._capture.set(key, value))

    def _must_set(self, key: int, value: float, name: str) -> None:
        if not self._set(key, value):
            raise DeviceLost(f"it does not accept finger_camera.{name}: leave it at null")


def preflight(config: VideoFingerCamera) -> Sensed:
    """Take the pictures of a second. Raises InputError for keys that cannot be used."""
    return look_at_camera(acquire_pictures(config, config.open_source()), config.rate_hz)


def ApplyDriverConfig(config: VideoFingerCamera, build: StationBuild) -> None:
    """Start the stream and add the finger camera's ports."""
    add_camera(config, config.open_source(), build)
