"""A device that does what a test says, and an MJPEG camera on loopback."""

from __future__ import annotations

import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import cv2
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem

from weldcal.systems.drivers.sensors.acquisition import Delivery
from weldcal.systems.messages import UrStatus


class Scripted:
    """Delivers, or raises, what is put into `script`; nothing comes where it is empty."""

    name = "The scripted device"

    def __init__(self, *script: Any) -> None:
        self.script: deque[Any] = deque(script)
        self.asked: list[int] = []
        self.opened = self.closed = 0
        self.refuses: Exception | None = None

    def open(self) -> None:
        self.opened += 1
        if self.refuses is not None:
            raise self.refuses

    def ask(self, request: int) -> None:
        self.asked.append(request)

    def next(self, timeout_s: float) -> Delivery[Any] | None:
        if not self.script:
            time.sleep(min(timeout_s, 0.002))
            return None
        found = self.script.popleft()
        if isinstance(found, Exception):
            raise found
        return found if isinstance(found, Delivery) else Delivery(datum=found, arrived=time.monotonic())

    def close(self) -> None:
        self.closed += 1

    def end(self) -> None:
        self.close()


class StatusSource(LeafSystem):
    """A robot that is ready."""

    def __init__(self) -> None:
        super().__init__()
        self.status = UrStatus()
        self.DeclareAbstractOutputPort("status", lambda: AbstractValue.Make(UrStatus()), self._output)

    def _output(self, context: Context, output: Any) -> None:
        output.set_value(self.status)


def speckle(number: int, width: int = 64, height: int = 48) -> np.ndarray:
    """A grey picture that no other number has, and from which the number can be read back."""
    picture = np.random.default_rng(number).integers(90, 110, (height, width), dtype=np.uint8)
    for bit in range(16):
        picture[:8, 4 * bit : 4 * bit + 4] = 255 if number >> bit & 1 else 0
    return picture


def number_in(picture: np.ndarray) -> int:
    """The number of a speckle."""
    return sum(int(picture[2:6, 4 * bit + 1 : 4 * bit + 3].mean() > 128) << bit for bit in range(16))


class MjpegCamera:
    """Sends speckles at a rate to every client; a test may change its behaviour at any time."""

    def __init__(self, rate_hz: float = 50.0) -> None:
        self.rate_hz = rate_hz
        self.frozen = self.garbage = self.silent = self.lengthless = False
        self.delay_s = self.blur_px = 0.0
        self.draws: Callable[[int], np.ndarray] = speckle
        self.epoch_s: float | None = 0.0  # of the stamps: 0 for Unix time, None for no stamp
        self.taken: dict[int, float] = {}  # when (s, monotonic) each number was taken
        self._listener: socket.socket | None = None
        self._clients: list[socket.socket] = []
        self._stop = threading.Event()
        self.port = 0
        self.plug_in()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/stream"

    def blurred(self, picture: np.ndarray) -> np.ndarray:
        """The picture out of focus by `blur_px`."""
        return cv2.GaussianBlur(picture, (0, 0), self.blur_px) if self.blur_px else picture

    def plug_in(self) -> None:
        """Listen at the same port as before."""
        self._stop = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", self.port))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, args=(self._listener, self._stop), daemon=True).start()

    def unplug(self) -> None:
        """End every connection and listen no more."""
        self._stop.set()
        assert self._listener is not None
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for client in self._clients:
            client.close()
        self._clients.clear()

    def _accept(self, listener: socket.socket, stop: threading.Event) -> None:
        with suppress(OSError):
            while not stop.is_set():
                client, _ = listener.accept()
                self._clients.append(client)
                threading.Thread(target=self._serve, args=(client, stop), daemon=True).start()

    def _serve(self, client: socket.socket, stop: threading.Event) -> None:
        under_way: deque[tuple[float, bytes]] = deque()
        number, due = len(self.taken), time.monotonic()
        with suppress(OSError):
            client.recv(4096)
            client.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n")
            while not stop.is_set():
                time.sleep(max(due - time.monotonic(), 0.0))
                due += 1.0 / self.rate_hz
                if self.silent:
                    continue
                if not self.frozen:
                    number += 1
                # the two clocks read together: what draws and encodes comes after
                self.taken[number], unix_s = time.monotonic(), time.time()
                under_way.append((self.taken[number] + self.delay_s, self._part(number, unix_s)))
                while under_way and under_way[0][0] <= time.monotonic():
                    client.sendall(under_way.popleft()[1])

    def _part(self, number: int, unix_s: float) -> bytes:
        jpeg = bytes(cv2.imencode(".jpg", self.draws(number))[1])
        if self.garbage:
            jpeg = bytes(np.random.default_rng(number).integers(0, 255, len(jpeg), dtype=np.uint8))
        stamp = b"" if self.epoch_s is None else f"X-Timestamp: {self.epoch_s + unix_s:.6f}\r\n".encode()
        length = b"" if self.lengthless else f"Content-Length: {len(jpeg)}\r\n".encode()
        return b"--frame\r\nContent-Type: image/jpeg\r\n" + length + stamp + b"\r\n" + jpeg + b"\r\n"


@contextmanager
def mjpeg_camera(rate_hz: float = 50.0) -> Iterator[MjpegCamera]:
    """A camera that is unplugged in the end."""
    camera = MjpegCamera(rate_hz)
    try:
        yield camera
    finally:
        camera.unplug()


def wait_until(condition: Any, limit_s: float = 5.0) -> bool:
    """Whether it became true in time."""
    until = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > until:
            return False
        time.sleep(0.002)
    return True
