"""Finger camera over UVC, RTSP, MJPEG over HTTP, or a video file: `!VideoFingerCamera`."""

import dataclasses as dc
import math
import socket
import time
from base64 import b64encode
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np

from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import Delivery, DeviceLost, Garbage, Source
from weldcal.systems.drivers.sensors.preflight import Sensed, look_at_camera
from weldcal.systems.drivers.sensors.wired_camera import (
    Picture,
    WiredFingerCamera,
    acquire_pictures,
    add_camera,
    checked_picture,
)
from weldcal.systems.drivers.station_build import StationBuild

CONNECT_S = 3.0  # a choice: cameras answer within 1 s; one that is off delays each attempt by this
LARGEST_HEADER, LARGEST_PART = 16_384, 16 * 1024**2
_BLOCK = 65_536
_START, _END = b"\xff\xd8", b"\xff\xd9"


@dataclass(frozen=True)
class StreamedPicture:
    """One picture, as JPEG, with its headers (names in lower case) and its arrival (s, host monotonic)."""

    jpeg: bytes
    headers: dict[str, str]
    arrived: float


class MjpegStream:
    """The connection to one stream. A part with Content-Length is taken by it, one without by its boundary.

    Raises:
        InputError: the URL is not http.
    """

    def __init__(self, url: str) -> None:
        try:
            parts = urlsplit(url)
            self._host, self._port = parts.hostname or "", parts.port or 80
        except ValueError:
            parts, self._host = urlsplit(""), ""
        if parts.scheme != "http" or not self._host:
            raise InputError(f"'{url[:200]}' is not the URL of an MJPEG stream: give http://HOST:PORT/PATH.")
        self._path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        self._login = ""
        if parts.username:
            words = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
            self._login = f"Authorization: Basic {b64encode(words.encode()).decode('ascii')}\r\n"
        self._socket: socket.socket | None = None
        self._unread = bytearray()
        self._boundary = b""

    def open(self) -> None:
        """Connect and read the answer's header. Raises DeviceLost."""
        where = f"{self._host}:{self._port}"
        try:
            self._socket = socket.create_connection((self._host, self._port), CONNECT_S)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # HTTP/1.0: a server then does not send chunks
            request = (
                f"GET {self._path} HTTP/1.0\r\nHost: {where}\r\n{self._login}Accept: multipart/x-mixed-replace\r\n\r\n"
            )
            self._socket.sendall(request.encode("latin-1", "replace"))
        except OSError as error:
            raise DeviceLost(f"nothing answers at {where} ({error.strerror or error}): switch the camera on") from error
        self._unread.clear()
        until = time.monotonic() + CONNECT_S
        while (end := self._unread.find(b"\r\n\r\n")) < 0:
            if time.monotonic() > until or len(self._unread) > LARGEST_HEADER:
                raise DeviceLost(f"{where} does not answer as an HTTP server")
            self._receive(0.1)
        first, *lines = bytes(self._unread[:end]).decode("latin-1").split("\r\n")
        del self._unread[: end + 4]
        status = first.split(" ", 2)[1:2]
        if status != ["200"]:
            raise DeviceLost(f"{where} answers '{first[:100]}': look at the path and the login of the URL")
        kind = _headers(lines).get("content-type", "")
        if not kind.lower().startswith("multipart/x-mixed-replace") or "boundary=" not in kind:
            raise DeviceLost(f"{where} sends '{kind[:100]}', not an MJPEG stream: look at the path of the URL")
        boundary = kind.split("boundary=", 1)[1].split(";")[0].strip().strip('"')
        self._boundary = b"--" + boundary.removeprefix("--").encode("latin-1")

    def next(self, timeout_s: float) -> StreamedPicture | None:
        """Return the next whole part; None where none came in time.

        Raises DeviceLost, and Garbage for a part that is no JPEG.
        """
        until = time.monotonic() + timeout_s
        while (found := self._part()) is None:
            left = until - time.monotonic()
            if left <= 0.0 or not self._receive(left):
                return None
        return found

    def close(self) -> None:
        """Disconnect; a second call has no effect."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _receive(self, timeout_s: float) -> bool:
        """Read what has come, waiting for it at most so long."""
        if self._socket is None:
            raise DeviceLost("it is not connected")
        self._socket.settimeout(max(timeout_s, 1e-3))
        try:
            found = self._socket.recv(_BLOCK)
        except TimeoutError:
            return False
        except OSError as error:
            raise DeviceLost(f"the connection broke ({error.strerror or error})") from error
        if not found:
            raise DeviceLost("it ended its stream")
        self._unread += found
        return True

    def _part(self) -> StreamedPicture | None:
        """Return the first whole part of what is unread."""
        start = self._unread.find(self._boundary)
        if start < 0:
            self._shorten()
            return None
        end = self._unread.find(b"\r\n\r\n", start)
        if end < 0:
            self._shorten()
            return None
        lines = bytes(self._unread[start:end]).decode("latin-1").split("\r\n")[1:]
        headers, begin = _headers(lines), end + 4
        length = headers.get("content-length", "")
        if length:
            if not length.isdigit() or not 0 < int(length) <= LARGEST_PART:
                del self._unread[:begin]
                raise Garbage(f"a picture of {length[:40]} bytes was announced")
            stop = begin + int(length)
            if len(self._unread) < stop:
                return None
        else:
            stop = self._unread.find(b"\r\n" + self._boundary, begin)
            if stop < 0:
                self._shorten()
                return None
        jpeg = bytes(self._unread[begin:stop])
        del self._unread[:stop]
        if not jpeg.startswith(_START) or not jpeg.rstrip(b"\x00\r\n").endswith(_END):
            raise Garbage("it sent a picture that is not a whole JPEG")
        return StreamedPicture(jpeg, headers, time.monotonic())

    def _shorten(self) -> None:
        """Refuse a stream that never comes to a part's end."""
        if len(self._unread) > LARGEST_PART:
            self._unread.clear()
            raise Garbage("it sent more bytes than a picture has, without an end of the picture")


def _headers(lines: list[str]) -> dict[str, str]:
    """Header lines as a dictionary with names in lower case."""
    pairs = (line.split(":", 1) for line in lines if ":" in line)
    return {name.strip().lower(): value.strip() for name, value in pairs}


STAMPS = ("host", "device", "none")
READ_MS, OPEN_MS = 1000, 5000
UNDECODED = "it sent a picture that cannot be decoded"


@dc.dataclass(kw_only=True)
class VideoFingerCamera(WiredFingerCamera):
    """`!VideoFingerCamera`: where the pictures come from.

    `source`: http://HOST:PORT/PATH (MJPEG), rtsp://..., the number or path of a video device (0, /dev/video0), or a
    video file. `stamps` of an MJPEG stream's header X-Timestamp (s): host, of this computer's clock (Unix time);
    device, of a clock of its own, whose offset is found from the earliest arrivals; none. Without stamps a picture was
    taken `latency_s` before it came.
    """

    source: str = ""
    stamps: str = "none"

    def open_source(self) -> Source[Picture]:
        """Return the source of pictures that `source` names. Raises InputError where it names none."""
        if not self.source:
            raise InputError(
                "Write the camera's source in the scenario: finger_camera: !VideoFingerCamera {source:"
                " http://HOST:PORT/PATH}."
            )
        if self.stamps not in STAMPS:
            raise InputError(f"finger_camera.stamps must be {', '.join(STAMPS)}, not '{self.stamps}'.")
        if self.source.startswith("http://"):
            if self.exposure_ms is not None or self.gain is not None:
                raise InputError(
                    "The exposure of an MJPEG stream is set at its camera: leave finger_camera.exposure_ms and gain at"
                    " null."
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
