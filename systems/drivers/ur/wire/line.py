"""A TCP connection to a controller with a time limit on each call, and the dashboard's client on it."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from types import TracebackType

from weldcal.systems.addresses import controller_address
from weldcal.systems.drivers.ur.faults import RobotUnreachable

RELEASE_WAIT_S = 0.3  # a choice: a controller closes in some frames; one that does not delays every command by this
DASHBOARD_PORT = 29999
SCRIPT_PORT = 30003
Ask = Callable[[str, str, float], str]  # host, command of the dashboard, longest time (s): the answer


class SocketLine:
    """One connection; each read or write call ends within `timeout_s`, even where data arrive byte by byte.

    Raises (all methods):
        AddressError: the host is not an address. RobotUnreachable: nothing answers; the message says what to check.
    """

    def __init__(self, host: str, port: int, service: str, timeout_s: float) -> None:
        host = controller_address(host)
        self._host, self._port, self._service, self._timeout_s = host, port, service, timeout_s
        self._inbox = bytearray()
        address = resolve(host, port, timeout_s)
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

    def __enter__(self) -> SocketLine:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def send(self, data: bytes) -> None:
        """Write all of `data`."""
        try:
            self._socket.settimeout(self._timeout_s)
            self._socket.sendall(data)
        except OSError as error:
            raise self._lost("accepts no data") from error

    def deadline(self) -> float:
        """Return the time at which a call that starts now must end (s, monotonic)."""
        return time.monotonic() + self._timeout_s

    def read(self, size: int, until: float) -> bytes:
        """Read exactly `size` bytes."""
        while len(self._inbox) < size:
            self._fill(until)
        data = bytes(self._inbox[:size])
        del self._inbox[:size]
        return data

    def read_line(self, until: float) -> str:
        """Read text up to the next newline, without it."""
        while b"\n" not in self._inbox:
            self._fill(until)
            if len(self._inbox) > 65536:
                raise self.nonsense()
        return self.read(self._inbox.index(b"\n") + 1, until).decode("utf-8", "replace").strip()

    def drain(self) -> None:
        """Discard the received data."""
        self._inbox.clear()
        self._socket.settimeout(0.0)
        with contextlib.suppress(OSError):
            while self._socket.recv(65536):
                pass

    def release(self) -> tuple[socket.socket, bytearray]:
        """Return the connection and what has arrived of it, for a caller that reads without waiting."""
        return self._socket, self._inbox

    def nonsense(self) -> RobotUnreachable:
        """Return the exception for data that do not follow the protocol."""
        return RobotUnreachable(
            f"The server at {self._host} port {self._port} is not a UR controller: compare the address with the one on "
            "the pendant under Settings > System > Network."
        )

    def _fill(self, until: float) -> None:
        left = until - time.monotonic()
        if left <= 0.0:
            raise self._lost("sends no data")
        try:
            self._socket.settimeout(left)
            data = self._socket.recv(65536)
        except TimeoutError as error:
            raise self._lost("sends no data") from error
        except OSError as error:
            raise self._lost("hangs up") from error
        if not data:
            raise self._lost("hangs up")
        self._inbox += data

    def _lost(self, what: str) -> RobotUnreachable:
        return RobotUnreachable(
            f"{self._host} accepts a connection on its {self._service} port {self._port} but {what}: check that this is"
            " the robot's address, and restart the control box if it is."
        )

    def close(self) -> None:
        """Close the connection and wait briefly for the other side to close; claimed inputs are free then."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
            until = time.monotonic() + RELEASE_WAIT_S
            while (left := until - time.monotonic()) > 0.0:
                self._socket.settimeout(left)
                if not self._socket.recv(65536):
                    break
        self._socket.close()


def resolve(host: str, port: int, timeout_s: float) -> tuple[str, int]:
    """Resolve the address of a host in a thread, because the system's look-up has no time limit.

    Raises:
        RobotUnreachable: no host has this name.
    """
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


def ask(host: str, command: str, timeout_s: float = 2.0, port: int = DASHBOARD_PORT) -> str:
    """Return the controller's answer to one dashboard command, such as `is in remote control`.

    Args:
        host: name or address of the controller.
        command: one line, without its newline.
        timeout_s: longest time of the connection, and of the exchange.
        port: port of the dashboard.

    Raises:
        RobotUnreachable: no dashboard answers in time (PolyScope X has none).
    """
    with SocketLine(host, port, "Dashboard Server", timeout_s) as line:
        until = line.deadline()
        if not line.read_line(until).startswith("Connected"):
            raise line.nonsense()
        line.send(f"{command}\n".encode())
        return line.read_line(until)


def stop_program(host: str, timeout_s: float = 2.0, asks: Ask = ask) -> str:
    """Stop the running or paused program; returns "Stopped", the controller's refusal, or an empty text.

    After a fault only a stop is safe: `play` would continue with the velocity that the registers still hold. `asks` is
    the dashboard, or the Robot API of PolyScope X. Where it does not answer, the command goes to the script port, which
    does not answer either.

    Raises:
        RobotUnreachable: neither port answers in time.
    """
    try:
        return asks(host, "stop", timeout_s)
    except RobotUnreachable:
        with SocketLine(host, SCRIPT_PORT, "Script", timeout_s) as line:
            line.send(b"stop program\n")
        return ""
