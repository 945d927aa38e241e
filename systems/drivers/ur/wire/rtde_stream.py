"""The stream of packages between the worker and the controller.

The newest outputs are read, the command registers written.

One connection, no thread: the worker's loop reads what has arrived. Packages as in `rtde_client`.
"""

from __future__ import annotations

import contextlib
import math
import select
import struct
import time
from collections.abc import Sequence

from weldcal.systems.drivers.ur.faults import RobotRefused, RobotUnreachable
from weldcal.systems.drivers.ur.wire.rtde_client import CODES, IN_USE, NOT_FOUND, NotFinite, RtdeProbe, package_layout

E_SERIES, FASTEST_HZ, CB3_HZ = 5, 500.0, 125.0
DATA = ord("U")
HEADER = struct.Struct(">HB")


class RtdeStream:
    """Outputs at the controller's own rate, and one recipe of inputs that this connection has claimed.

    Without `inputs` it only reads.

    Raises:
        RobotUnreachable: nothing answers, or not as RTDE does. RobotRefused: the inputs are taken, or an output is
            unknown.
    """

    def __init__(self, host: str, outputs: Sequence[str], inputs: Sequence[str]) -> None:
        self._probe = RtdeProbe(host)
        try:
            self._recipe, kinds = self._probe.claim_recipe(inputs) if inputs else (0, [])
            if {IN_USE, NOT_FOUND} & set(kinds):
                raise RobotRefused("Another client or a fieldbus writes the command registers.")
            self._inputs = len(kinds)
            self._package = struct.Struct(">B" + "".join(CODES[kind] for kind in kinds))
            rate = FASTEST_HZ if self._probe.version[0] >= E_SERIES else CB3_HZ
            kinds = self._probe.subscribe(outputs, rate)
            if not set(kinds) <= set(CODES):
                raise RobotRefused("The controller does not report all that the driver reads.")
        except BaseException:
            self._probe.close()
            raise
        self._socket, self._inbox = self._probe.start()
        self._layout, self._at = package_layout(outputs, kinds)
        self._newest: tuple[float, ...] | None = None
        self._read = 0
        self.connected = True
        self.not_finite = ""  # an output of the newest package that was dropped because it is not a finite number

    def poll(self) -> None:
        """Read all packages that have arrived; the newest finite one counts.

        `connected` shows whether the connection has ended.
        """
        self.packages()

    def packages(self) -> list[tuple[float, ...]]:
        """Every package since the last call, oldest first: the recipe's number, then the outputs' numbers in order.

        See poll.
        """
        found = [package for at in self._arrived() if (package := self._finite(at)) is not None]
        self._newest = found[-1] if found else self._newest
        del self._inbox[: self._read]
        return found

    def _finite(self, at: int) -> tuple[float, ...] | None:
        """Return the package that begins there in the inbox; None where one of its numbers is not finite."""
        package = self._layout.unpack_from(self._inbox, at)
        if all(map(math.isfinite, package)):
            return package
        self.not_finite = next(
            name
            for name, k in self._at.items()
            if not all(map(math.isfinite, package[k] if isinstance(k, slice) else (package[k],)))
        )
        return None

    def _arrived(self) -> list[int]:
        """Where the outputs of whole packages begin in the inbox, of which `_read` bytes are then read."""
        self._read = 0
        if not self.connected:
            return []
        self._socket.settimeout(0.0)
        try:
            while data := self._socket.recv(65536):
                self._inbox += data
            self.connected = False
        except (BlockingIOError, InterruptedError):
            pass
        except OSError:
            self.connected = False
        return self._starts()

    def wait(self, seconds: float) -> None:
        """Poll, after the next package or this time."""
        with contextlib.suppress(OSError, ValueError):
            select.select([self._socket], [], [], max(seconds, 0.0))
        self.poll()

    def first(self, limit_s: float) -> None:
        """Wait for the first package.

        Raises:
            RobotUnreachable: none comes, or one that is not finite.
        """
        until = time.monotonic() + limit_s
        while self._newest is None:
            if self.not_finite:
                raise NotFinite(self.not_finite)
            if not self.connected or time.monotonic() > until:
                raise RobotUnreachable("The controller accepts the recipe and sends no data.")
            self.wait(0.01)

    def number(self, name: str) -> float:
        """Return an output in the newest package."""
        at = self._at[name]
        assert isinstance(at, int)
        return self._package_now[at]

    def vector(self, name: str) -> tuple[float, ...]:
        """Return an output of several numbers in the newest package."""
        at = self._at[name]
        assert isinstance(at, slice)
        return self._package_now[at]

    @property
    def _package_now(self) -> tuple[float, ...]:
        if self._newest is None:
            raise RobotUnreachable("The controller has sent no data yet.")
        return self._newest

    def send(self, *values: float) -> None:
        """Write the inputs, in the order in which they were claimed; those that are left out are zero."""
        payload = self._package.pack(self._recipe, *values, *[0] * (self._inputs - len(values)))
        try:
            self._socket.settimeout(0.0)
            sent = self._socket.send(HEADER.pack(len(payload) + HEADER.size, DATA) + payload)
        except OSError:
            # what cannot be sent at once would arrive late: the guard slows the arm and stops it, and the echo tells
            return
        if sent < len(payload) + HEADER.size:
            self.connected = False  # half a package is in the stream: what follows would be read wrongly

    def close(self) -> None:
        """Hang up, which releases the inputs."""
        self._probe.close()

    def _starts(self) -> list[int]:
        found, inbox, at = [], self._inbox, 0
        while len(inbox) - at >= HEADER.size:
            size, kind = HEADER.unpack_from(inbox, at)
            if size < HEADER.size:
                self.connected = False
                return []
            if len(inbox) - at < size:
                break
            if kind == DATA and size - HEADER.size == self._layout.size:
                found.append(at + HEADER.size)
            at += size
        self._read = at
        return found
