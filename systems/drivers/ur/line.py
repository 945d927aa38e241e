"""A TCP connection to a controller on which no call waits longer than it was told, and every failure is a sentence."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from types import TracebackType

from weldcal.models.errors import InputError
from weldcal.systems.drivers.ur.errors import RobotUnreachable

RELEASE_WAIT_S = 0.3


class Line:
    """One connection; every reading or writing call ends within `timeout_s`, however slowly the bytes drip.

    Raises (all methods):
        RobotUnreachable: nothing answers, in one sentence that says what to look at.
    """

    def __init__(self, host: str, port: int, service: str, timeout_s: float) -> None:
        if not host.strip():
            raise InputError("Give the robot's host name or IP address, such as 192.168.56.101.")
        self._host, self._port, self._service, self._timeout_s = host, port, service, timeout_s
        self._inbox = bytearray()
        address = _resolve(host, port, timeout_s)
        try:
            self._socket = socket.create_connection(address, timeout=timeout_s)
        except ConnectionRefusedError as error:
            raise RobotUnreachable(
                f"{host} is there but its {service} port {port} is closed: wait until PolyScope has started, or "
                f"enable {service} on the pendant under Settings > Security > Services."
            ) from error
        except OSError as error:
            raise RobotUnreachable(
                f"No answer from {host}: switch the control box on, check the network cable, and compare the address "
                "with the one on the pendant under Settings > System > Network."
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __enter__(self) -> Line:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def send(self, data: bytes) -> None:
        """Writes all of it."""
        try:
            self._socket.settimeout(self._timeout_s)
            self._socket.sendall(data)
        except OSError as error:
            raise self._lost("took nothing in") from error

    def deadline(self) -> float:
        """When a call that starts now must end (s, monotonic)."""
        return time.monotonic() + self._timeout_s

    def read(self, size: int, until: float) -> bytes:
        """Exactly `size` bytes."""
        while len(self._inbox) < size:
            self._fill(until)
        data = bytes(self._inbox[:size])
        del self._inbox[:size]
        return data

    def read_line(self, until: float) -> str:
        """Text up to the next newline, without it."""
        while b"\n" not in self._inbox:
            self._fill(until)
            if len(self._inbox) > 65536:
                raise self.nonsense()
        return self.read(self._inbox.index(b"\n") + 1, until).decode("utf-8", "replace").strip()

    def drain(self) -> None:
        """Throws away what has arrived."""
        self._inbox.clear()
        self._socket.settimeout(0.0)
        with contextlib.suppress(OSError):
            while self._socket.recv(65536):
                pass

    def nonsense(self) -> RobotUnreachable:
        """What to raise where the bytes make no sense."""
        return RobotUnreachable(
            f"What answers at {self._host} port {self._port} is no UR controller: compare the address with the one on "
            "the pendant under Settings > System > Network."
        )

    def _fill(self, until: float) -> None:
        left = until - time.monotonic()
        if left <= 0.0:
            raise self._lost("says nothing")
        try:
            self._socket.settimeout(left)
            data = self._socket.recv(65536)
        except TimeoutError as error:
            raise self._lost("says nothing") from error
        except OSError as error:
            raise self._lost("hangs up") from error
        if not data:
            raise self._lost("hangs up")
        self._inbox += data

    def _lost(self, what: str) -> RobotUnreachable:
        return RobotUnreachable(
            f"{self._host} takes a connection on its {self._service} port {self._port} but {what}: check that this is "
            "the robot's address, and restart the control box if it is."
        )

    def close(self) -> None:
        """Hangs up and waits a moment for the other side to do so too: what was claimed is free then."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
            until = time.monotonic() + RELEASE_WAIT_S
            while (left := until - time.monotonic()) > 0.0:
                self._socket.settimeout(left)
                if not self._socket.recv(65536):
                    break
        self._socket.close()


def _resolve(host: str, port: int, timeout_s: float) -> tuple[str, int]:
    """The address of a host; the system's own look-up knows no deadline, so it runs beside us."""
    found: list[tuple[str, int]] = []

    def look_up() -> None:
        with contextlib.suppress(OSError, UnicodeError):
            entries = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_STREAM)
            found.extend((str(entry[4][0]), port) for entry in entries)

    seeker = threading.Thread(target=look_up, daemon=True)
    seeker.start()
    seeker.join(timeout_s)
    if not found:
        raise RobotUnreachable(
            f"There is no host named {host!r}: give the robot's IP address, which the pendant shows under "
            "Settings > System > Network."
        )
    return found[0]
