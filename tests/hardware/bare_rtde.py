"""A bare RTDE client of a few lines, so that the tests see every byte that the emulator sends."""

from __future__ import annotations

import socket
import struct
import time
from typing import Any

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
}


class Rtde:
    """One connection to port 30004."""

    def __init__(self, host: str, version: int = 2) -> None:
        self.socket = socket.create_connection((host, 30004), timeout=5.0)
        assert self.send(b"V", struct.pack(">H", version)) == b"\x01"
        self.fields: list[tuple[str, struct.Struct]] = []

    def exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            piece = self.socket.recv(count - len(data))
            if not piece:
                raise ConnectionError("the controller closed the connection")
            data += piece
        return data

    def receive(self, kind: bytes) -> bytes:
        """The payload of the next package of this kind; others are passed over."""
        while True:
            size, found = struct.unpack(">HB", self.exactly(3))
            payload = self.exactly(size - 3)
            if bytes([found]) == kind:
                return payload

    def send(self, kind: bytes, payload: bytes = b"") -> bytes:
        self.put(kind, payload)
        return self.receive(kind)

    def put(self, kind: bytes, payload: bytes = b"") -> None:
        self.socket.sendall(struct.pack(">H", len(payload) + 3) + kind + payload)

    def watch(self, *names: str, hz: float = 500.0) -> Rtde:
        """Starts the stream of these outputs."""
        types = self.send(b"O", struct.pack(">d", hz) + ",".join(names).encode())[1:].decode().split(",")
        self.fields = [(name, struct.Struct(">" + CODES[kind])) for name, kind in zip(names, types, strict=True)]
        assert self.send(b"S") == b"\x01"
        return self

    def next(self) -> dict[str, Any]:
        """The next package of the stream."""
        payload, at, values = self.receive(b"U"), 1, {}
        for name, packer in self.fields:
            found = packer.unpack_from(payload, at)
            values[name] = found[0] if len(found) == 1 else list(found)
            at += packer.size
        return values

    def during(self, seconds: float) -> list[dict[str, Any]]:
        """All packages of this time."""
        until, found = time.monotonic() + seconds, []
        while time.monotonic() < until:
            found.append(self.next())
        return found

    def until(self, name: str, value: Any, limit_s: float = 2.0) -> dict[str, Any]:
        """The first package in which `name` has this value."""
        deadline = time.monotonic() + limit_s
        while (found := self.next())[name] != value:
            assert time.monotonic() < deadline, f"{name} is {found[name]}, not {value}"
        return found

    def __enter__(self) -> Rtde:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()
