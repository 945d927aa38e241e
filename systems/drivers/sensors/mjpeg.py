"""Reads an MJPEG stream over HTTP: the pictures of a multipart/x-mixed-replace answer with the header of each part."""

import socket
import time
from base64 import b64encode
from dataclasses import dataclass
from urllib.parse import unquote, urlsplit

from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import DeviceLost, Garbage

CONNECT_S = 3.0
LARGEST_HEADER, LARGEST_PART = 16_384, 16 * 1024**2
_BLOCK = 65_536
_START, _END = b"\xff\xd8", b"\xff\xd9"


@dataclass(frozen=True)
class Part:
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

    def next(self, timeout_s: float) -> Part | None:
        """The next whole part; None where none came in time. Raises DeviceLost, and Garbage for a part that is no JPEG."""
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

    def _part(self) -> Part | None:
        """The first whole part of what is unread."""
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
        return Part(jpeg, headers, time.monotonic())

    def _shorten(self) -> None:
        """Refuse a stream that never comes to a part's end."""
        if len(self._unread) > LARGEST_PART:
            self._unread.clear()
            raise Garbage("it sent more bytes than a picture has, without an end of the picture")


def _headers(lines: list[str]) -> dict[str, str]:
    """Header lines as a dictionary with names in lower case."""
    pairs = (line.split(":", 1) for line in lines if ":" in line)
    return {name.strip().lower(): value.strip() for name, value in pairs}
