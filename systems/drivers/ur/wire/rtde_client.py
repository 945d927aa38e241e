"""A small RTDE client: reads outputs once, checks whether inputs are free, and writes the registers it claims.

Packages of protocol version 2 are big endian: uint16 size (header included), uint8 type, payload.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence
from types import TracebackType

import numpy as np

from weldcal.systems.drivers.ur.faults import Fault, RobotUnreachable, reported_as, sentence
from weldcal.systems.drivers.ur.wire.line import SocketLine

RTDE_PORT = 30004
IN_USE, NOT_FOUND = "IN_USE", "NOT_FOUND"
FREQUENCY_HZ = 125.0  # the rate of CB3, which every controller has; values are read once
SLOWEST_HZ = 1.0  # a choice: the slowest whole rate; nothing reads these packages
PROTOCOL_VERSION = 2
MAX_NAMES_BYTES = 2048

_PROTOCOL, _VERSION, _DATA, _OUTPUTS, _INPUTS, _START, _PAUSE = (ord(letter) for letter in "VvUOISP")
CODES = {
    "DOUBLE": "d",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "UINT8": "B",
    "BOOL": "?",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}

Value = float | int | bool | tuple[float, ...] | tuple[int, ...]
# The command and its numbers, from register 0 or (upper registers) 24 on.
# Two more numbers are the set points of the power source, where they are wired.
INTEGERS, DOUBLES, SET_POINTS, UPPER_OFFSET = 1, 8, 2, 24


class NotFinite(RobotUnreachable):
    """The controller reports an output as not a finite number."""

    def __init__(self, name: str) -> None:
        super().__init__(sentence(Fault.STATE_NOT_FINITE, reported_as(name)))
        self.output = name


class RtdeProbe:
    """One connection to a controller's RTDE port; a context manager that releases all claimed inputs at its end.

    Raises (all methods):
        RobotUnreachable: nothing answers in time, or what answers is not RTDE.
    """

    def __init__(self, host: str, timeout_s: float = 2.0, port: int = RTDE_PORT) -> None:
        self._line = SocketLine(host, port, "RTDE", timeout_s)
        try:
            (accepted,) = self._unpack(">?", self._request(_PROTOCOL, struct.pack(">H", PROTOCOL_VERSION)))
            if not accepted:
                raise RobotUnreachable(
                    f"The controller at {host} speaks version 1 of RTDE only: update PolyScope to 5.12 or newer."
                )
            major, minor, bugfix, build = self._unpack(">4I", self._request(_VERSION, b""))
        except BaseException:
            self._line.close()
            raise
        self.version: tuple[int, int, int, int] = (major, minor, bugfix, build)

    def __enter__(self) -> RtdeProbe:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Hangs up."""
        self._line.close()

    def read(self, names: Sequence[str]) -> dict[str, Value]:
        """Read the next values of these outputs, all of one control step; names unknown to the controller are omitted.

        Vectors are tuples; poses are x, y, z (m) and a rotation vector (rad), joints rad and rad/s.

        Raises:
            NotFinite: a value is not a finite number.
        """
        types = self.subscribe(names)
        wanted = [name for name, kind in zip(names, types, strict=True) if kind != NOT_FOUND]
        if not wanted:
            return {}
        if len(wanted) < len(names):
            types = self.subscribe(wanted)
        if not set(types) <= set(CODES):
            raise self._line.nonsense()
        (started,) = self._unpack(">?", self._request(_START, b""))
        if not started:
            raise self._line.nonsense()
        payload = self._next(_DATA)
        self._request(_PAUSE, b"")
        layout, places = package_layout(wanted, types)
        if len(payload) != layout.size:
            raise self._line.nonsense()
        numbers = layout.unpack(payload)
        values: dict[str, Value] = {name: numbers[place] for name, place in places.items()}
        for name, value in values.items():
            if not np.isfinite(value).all():
                raise NotFinite(name)
        return values

    def claim(self, names: Sequence[str]) -> dict[str, str]:
        """Claim these inputs; returns the type of each where it is free, else IN_USE or NOT_FOUND.

        Nothing is written to them. Claimed inputs belong to this connection until it is closed.
        """
        answer: dict[str, str] = {}
        for group in _groups(names):
            types = self._types(self._request(_INPUTS, ",".join(group).encode()), len(group))
            answer |= dict(zip(group, types, strict=True))
        return answer

    def claim_recipe(self, names: Sequence[str]) -> tuple[int, list[str]]:
        """Claim these inputs as one recipe; returns its number and the type of each, or IN_USE or NOT_FOUND."""
        payload = self._request(_INPUTS, ",".join(names).encode())
        return payload[0], self._types(payload, len(names))

    def start(self) -> tuple[socket.socket, bytearray]:
        """Start the stream; returns the connection, which stays this client's, and what has arrived of it."""
        (started,) = self._unpack(">?", self._request(_START, b""))
        if not started:
            raise self._line.nonsense()
        return self._line.release()

    def grant(self, names: Sequence[str]) -> int | None:
        """Claim these inputs for `write`, and start.

        Returns the recipe's number, or None where one of them is not free.
        """
        payload = self._request(_INPUTS, ",".join(names).encode())
        if {IN_USE, NOT_FOUND} & set(self._types(payload, len(names))):
            return None
        # a controller starts only a client with outputs; one package a second costs almost nothing
        self.subscribe(("timestamp",), SLOWEST_HZ)
        self._request(_START, b"")
        return payload[0]

    def write(self, package: bytes) -> None:
        """Send one input package, which starts with its recipe's number, and discard the received data."""
        self._line.drain()
        self._line.send(struct.pack(">HB", len(package) + 3, _DATA) + package)

    def subscribe(self, names: Sequence[str], frequency_hz: float = FREQUENCY_HZ) -> list[str]:
        """Choose the outputs of the stream; returns the type of each, or NOT_FOUND."""
        request = struct.pack(">d", frequency_hz) + ",".join(names).encode()
        return self._types(self._request(_OUTPUTS, request), len(names))

    def _types(self, payload: bytes, count: int) -> list[str]:
        types = payload[1:].decode("ascii", "replace").split(",")
        if len(types) != count:
            raise self._line.nonsense()
        return types

    def _request(self, kind: int, payload: bytes) -> bytes:
        self._line.send(struct.pack(">HB", len(payload) + 3, kind) + payload)
        return self._next(kind)

    def _next(self, kind: int) -> bytes:
        """Payload of the next package of this type; others (text messages, late data) are skipped."""
        until = self._line.deadline()
        while True:
            size, found = struct.unpack(">HB", self._line.read(3, until))
            if size < 3:
                raise self._line.nonsense()
            payload = self._line.read(size - 3, until)
            if found == kind:
                return payload

    def _unpack(self, code: str, payload: bytes) -> tuple[int, ...]:
        if len(payload) != struct.calcsize(code):
            raise self._line.nonsense()
        return struct.unpack(code, payload)


def package_layout(names: Sequence[str], kinds: Sequence[str]) -> tuple[struct.Struct, dict[str, slice | int]]:
    """Return the layout of an output package, its recipe's number first, and each output's place among its numbers."""
    places: dict[str, slice | int] = {}
    at = 1
    for name, kind in zip(names, kinds, strict=True):
        width = int(CODES[kind][0]) if kind.startswith("VECTOR") else 0
        places[name] = slice(at, at + width) if width else at
        at += width or 1
    return struct.Struct(">B" + "".join(CODES[kind] for kind in kinds)), places


def _groups(names: Sequence[str]) -> list[list[str]]:
    """Split the names into lists that each fit into one recipe."""
    groups: list[list[str]] = [[]]
    size = 0
    for name in names:
        size += len(name) + 1
        if size > MAX_NAMES_BYTES:
            groups.append([])
            size = len(name) + 1
        groups[-1].append(name)
    return [group for group in groups if group]


def register_names(offset: int, doubles: int = DOUBLES) -> list[str]:
    """The names, from a register on."""
    integers = [f"input_int_register_{i}" for i in range(offset, offset + INTEGERS)]
    return integers + [f"input_double_register_{i}" for i in range(offset, offset + doubles)]


def ranges(names: list[str]) -> str:
    """Register names as ranges, such as: int 24-31, double 24-41."""
    parts = []
    for kind in ("int", "double"):
        numbers = sorted(int(name.rpartition("_")[2]) for name in names if name.startswith(f"input_{kind}_"))
        runs: list[list[int]] = []
        for number in numbers:
            if runs and number == runs[-1][-1] + 1:
                runs[-1].append(number)
            else:
                runs.append([number])
        parts += [f"{kind} {run[0]}" + (f"-{run[-1]}" if len(run) > 1 else "") for run in runs]
    return ", ".join(parts)
