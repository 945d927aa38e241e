"""Process of the world's finger camera: draws the tag and serves an MJPEG stream with the time of each exposure."""

import contextlib
import signal
import socketserver
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler
from multiprocessing.connection import Connection

import cv2
import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.arrays import Array
from weldcal.models.tool import FingerCamera, WeldingTool
from weldcal.systems.drivers.simulated.rendered_finger_camera import TagView, with_noise
from weldcal.tools.connections import Limited

QUALITY = 97
BOUNDARY = "picture"


@dataclass(frozen=True)
class FingerSetup:
    """What the camera's process is started with. It serves http://host:port/stream."""

    tool: WeldingTool
    camera: FingerCamera
    seed: int
    host: str
    port: int


class PictureStream:
    """The newest part of the stream, for any number of clients."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._number, self._part = 0, b""
        self._clients = 0

    @property
    def watched(self) -> bool:
        """Whether any client is connected."""
        return self._clients > 0

    @contextlib.contextmanager
    def client(self) -> Iterator[int]:
        """A client is connected for the duration of the block.

        Gives the number of the newest part, which may be old.
        """
        with self._news:
            self._clients += 1
            number = self._number
        try:
            yield number
        finally:
            with self._news:
                self._clients -= 1

    def put(self, jpeg: bytes, taken: float) -> None:
        """Show another picture, taken at this Unix time (s)."""
        head = (
            f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\nX-Timestamp:"
            f" {taken:.6f}\r\n\r\n"
        )
        with self._news:
            self._number, self._part = self._number + 1, head.encode("ascii") + jpeg + b"\r\n"
            self._news.notify_all()

    def next(self, after: int) -> tuple[int, bytes]:
        """The newest part once it is newer than number `after`; (after, b"") where none came within a second."""
        with self._news:
            self._news.wait_for(lambda: self._number > after, 1.0)
            return (self._number, self._part) if self._number > after else (after, b"")


class _Server(Limited, socketserver.ThreadingTCPServer):
    allow_reuse_address = True


def _handler(stream: PictureStream) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            assert isinstance(self.server, _Server)
            self.server.keep(self.connection)
            with contextlib.suppress(OSError), stream.client() as number:
                while True:
                    number, part = stream.next(number)
                    self.wfile.write(part)

        def log_message(self, format: str, *args: object) -> None:
            """Nothing: a client that comes and goes is no news."""

    return Handler


def draw(view: TagView, X_FM: Array, noise_grey: float, rng: np.random.Generator) -> bytes:
    """Return the JPEG of the tag at X_FM (4, 4)."""
    grey = with_noise(view.picture(RigidTransform(X_FM)), noise_grey, rng)
    _, jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return bytes(jpeg)


def run_finger_camera(setup: FingerSetup, world: Connection) -> None:
    """Serve until the world closes its end of the pipe.

    It sends (Unix time s, X_FM (4, 4)) for each exposure, and is told when the picture is shown.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    cv2.setNumThreads(1)
    view, stream, rng = TagView(setup.tool, setup.camera), PictureStream(), np.random.default_rng([setup.seed, 3])
    with _Server((setup.host, setup.port), _handler(stream)) as server, contextlib.suppress(EOFError, OSError):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        world.send("ready")
        while True:
            taken, X_FM = world.recv()
            if stream.watched:
                stream.put(draw(view, X_FM, setup.camera.noise_grey, rng), taken)
            world.send("shown")
