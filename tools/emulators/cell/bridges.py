"""Bridges between a cell and its world's scanner and finger camera, which fail as wires and devices do.

Each is a thread in the tester's process: it passes on what the device says, or is killed (refuses and closes), frozen
(says nothing), delayed by 2 s of the world's time, or sends garbage. `how` may change at any time; "" is right again.
"""

import contextlib
import os
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from weldcal.models.errors import InputError

DELAY_S = 2.0
LOOK_S = 0.02
BLOCK = 65_536
SEED = 12


class Bridge:
    """A port that a cell connects to, and the device's own port behind it; one client at a time."""

    def __init__(
        self, listen: tuple[str, int], device: tuple[str, int], now: Callable[[], float] = time.monotonic
    ) -> None:
        self.how, self._now = "", now
        self._listen, self._device = listen, device
        self._server: socket.socket | None = None
        self._hear()
        self._ends = threading.Event()
        self._rng = np.random.default_rng(SEED)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ends.set()
        self._thread.join()
        self._be_deaf()

    def _serve(self) -> None:
        while not self._ends.is_set():
            if self.how == "killed":  # nobody listens any more
                self._be_deaf()
                self._ends.wait(LOOK_S)
                continue
            # what either side does to its connection, or a world that ends
            with contextlib.suppress(OSError, InputError):
                client, _ = self._hear().accept()
                with client, socket.create_connection(self._device, 5.0) as device:
                    self._pass_on(client, device)

    def _hear(self) -> socket.socket:
        if self._server is None:
            self._server = socket.create_server(self._listen)
            self._server.settimeout(LOOK_S)
        return self._server

    def _be_deaf(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None

    def _pass_on(self, client: socket.socket, device: socket.socket) -> None:
        """Carry bytes to and fro until a side closes or the bridge is killed."""
        kept: deque[tuple[float, bool, bytes]] = deque()  # when it is passed on, whether to the client, what
        while not self._ends.is_set() and self.how != "killed":
            for side in select.select([client, device], [], [], LOOK_S)[0]:
                data = side.recv(BLOCK)
                if not data:
                    return
                delayed = self.how == "delayed" and side is device
                kept.append((self._now() + DELAY_S if delayed else 0.0, side is device, data))
            while kept and self.how != "frozen" and (kept[0][0] == 0.0 or kept[0][0] <= self._now()):
                _, up, data = kept.popleft()
                if up:
                    self._up(client, data)
                else:
                    device.sendall(data)

    def _up(self, client: socket.socket, data: bytes) -> None:
        client.sendall(self._rng.bytes(len(data)) if self.how == "garbage" else data)


class PictureBridge(Bridge):
    """Of an MJPEG stream: garbage is random bytes in place of the stream's."""


class ScannerBridge(Bridge):
    """Of a scanner's trigger and of the folder into which it writes: garbage is a cloud of random bytes."""

    def __init__(
        self,
        listen: tuple[str, int],
        device: tuple[str, int],
        written: Path,
        read: Path,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._written, self._read = written, read
        super().__init__(listen, device, now)

    def _up(self, client: socket.socket, data: bytes) -> None:
        for suffix in (".json", ".npz"):  # the note first, as the scanner does
            for path in sorted(self._written.glob(f"[!.]*{suffix}")):
                if suffix == ".npz" and self.how == "garbage":
                    path.write_bytes(self._rng.bytes(20_000))
                os.replace(path, self._read / path.name)
        client.sendall(data)
