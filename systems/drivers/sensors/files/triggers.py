"""Triggers of scanners that another program drives: a line over TCP, a file, or none."""

import os
import socket
from pathlib import Path
from typing import Protocol

from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import DeviceFault, DeviceLost

CONNECT_S = 2.0
LONGEST_LINE = 4096


# s without a word until the other side is asked, s between such questions, and how many without an answer are the end
KEEP_ALIVE = {"TCP_KEEPIDLE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}


class Trigger(Protocol):
    """Tells another program to scan."""

    def open(self) -> None:
        """Connect. Raises DeviceLost."""

    def send(self, request: int) -> None:
        """Ask for scan number `request`. Raises DeviceLost."""

    def look(self) -> None:
        """Read what the other program said. Raises DeviceLost where it is gone, DeviceFault where it refuses."""

    def close(self) -> None:
        """Disconnect; a second call has no effect."""


class NoTrigger:
    """A person, or the other program by itself, scans after the arm has come to rest."""

    def open(self) -> None:
        """See Trigger."""

    def send(self, request: int) -> None:
        """See Trigger."""

    def look(self) -> None:
        """See Trigger."""

    def close(self) -> None:
        """See Trigger."""


class FileTrigger:
    """Replaces a file as a whole: its content is the line `scan N`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def open(self) -> None:
        """See Trigger."""
        if not self._path.parent.is_dir():
            raise DeviceLost(f"there is no folder '{self._path.parent}' for the trigger file")

    def send(self, request: int) -> None:
        """See Trigger."""
        unfinished = self._path.with_name(f".{self._path.name}.tmp")
        try:
            unfinished.write_text(f"scan {request}\n", encoding="ascii")
            os.replace(unfinished, self._path)
        except OSError as error:
            raise DeviceLost(f"the trigger file '{self._path}' cannot be written: {error.strerror}") from error

    def look(self) -> None:
        """See Trigger."""

    def close(self) -> None:
        """See Trigger."""


class TcpTrigger:
    """Sends the line `scan N` over a TCP connection that stays open; the other program may answer `ok N` or `error TEXT`."""

    def __init__(self, host: str, port: int) -> None:
        self._at = (host, port)
        self._socket: socket.socket | None = None
        self._unread = b""

    def open(self) -> None:
        """See Trigger."""
        try:
            self._socket = socket.create_connection(self._at, CONNECT_S)
        except OSError as error:
            raise DeviceLost(
                f"its trigger at {self._at[0]}:{self._at[1]} does not answer ({error.strerror or error}): "
                "start the program that scans"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # nothing is sent between scans, so that a pulled cable would show at the next one only
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in KEEP_ALIVE.items():
            if hasattr(socket, option):
                self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        self._unread = b""

    def send(self, request: int) -> None:
        """See Trigger."""
        if self._socket is None:
            raise DeviceLost("its trigger is not connected")
        self._socket.settimeout(CONNECT_S)
        try:
            self._socket.sendall(f"scan {request}\n".encode("ascii"))
        except OSError as error:
            raise DeviceLost(f"its trigger at {self._at[0]}:{self._at[1]} is gone") from error

    def look(self) -> None:
        """See Trigger."""
        if self._socket is None:
            return
        self._socket.settimeout(0.0)
        try:
            found = self._socket.recv(LONGEST_LINE)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            raise DeviceLost(f"its trigger at {self._at[0]}:{self._at[1]} is gone") from error
        if not found:
            raise DeviceLost(f"its trigger at {self._at[0]}:{self._at[1]} has ended the connection")
        *lines, self._unread = (self._unread + found).split(b"\n")
        self._unread = self._unread[-LONGEST_LINE:]
        for line in lines:
            said = line.decode("utf-8", "replace").strip()
            if said.startswith("error"):
                raise DeviceFault(f"the program that scans says: {said.removeprefix('error').strip()[:200]}")

    def close(self) -> None:
        """See Trigger."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def trigger_of(text: str) -> Trigger:
    """The trigger of a scenario's word: empty, `file:PATH`, or `tcp://HOST:PORT`.

    Raises:
        InputError: it is none of these.
    """
    if not text:
        return NoTrigger()
    if text.startswith("file:") and len(text) > 5:
        return FileTrigger(Path(text[5:]))
    host, _, port = text.removeprefix("tcp://").rpartition(":")
    if text.startswith("tcp://") and host and port.isdigit() and 0 < int(port) < 65536:
        return TcpTrigger(host, int(port))
    raise InputError(
        f"scanner.trigger must be empty, file:PATH or tcp://HOST:PORT, not '{text[:100]}': give the port at which the program "
        "that scans listens, such as tcp://127.0.0.1:5020."
    )
