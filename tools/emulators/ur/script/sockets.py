"""URScript functions that speak: to people and clients of the primary port, and as a client of sockets on loopback."""

import math
import re
import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from weldcal.tools.emulators.ur.controller.motions import STEP_S
from weldcal.tools.emulators.ur.controller.registers import Popup, Text
from weldcal.tools.emulators.ur.script.arithmetic import EFFORT, Effort, text_of
from weldcal.tools.emulators.ur.script.compiler import Slices
from weldcal.tools.emulators.ur.script.forces import Forces
from weldcal.tools.emulators.ur.script.syntax import ScriptError

OPEN_LIMIT_S = 0.02
OPEN_FRAMES = 4  # [M] how long a connection takes
NAME = "socket_0"
MOST_SOCKETS, MOST_UNREAD, MOST_NUMBERS = 20, 1 << 17, 1000  # [M]


class ScriptSocket:
    """One open socket and what has arrived on it."""

    def __init__(self, address: str, port: int) -> None:
        self._socket = socket.create_connection((address, port), timeout=OPEN_LIMIT_S)
        self._socket.setblocking(False)
        self.inbox = bytearray()

    def send(self, data: bytes) -> bool:
        """False where the other side is gone or does not read."""
        try:
            return self._socket.send(data) == len(data)
        except OSError:
            return False

    def fill(self) -> None:
        """Takes in what has arrived."""
        with suppress(OSError):
            while len(self.inbox) < MOST_UNREAD and (data := self._socket.recv(65536)):
                self.inbox += data

    def close(self) -> None:
        """FIN."""
        self._socket.close()


class Sockets(Forces):
    """Sockets belong to their program and close with it; reads answer 0 values, then nan or -1, when time runs out."""

    def textmsg(self, s1: Any, s2: Any = "") -> None:
        text = text_of(s1) + text_of(s2)
        self._controller.note(f"script: {text}")
        self._controller.tell(Text(text))

    def popup(
        self, s: Any, title: str = "Popup", warning: bool = False, error: bool = False, blocking: bool = False
    ) -> Slices:
        """One that blocks waits until an operator closes it: the dashboard's `close popup`."""
        c = self._controller
        c.note(f"popup: {title}: {text_of(s)}")
        c.tell(Popup(text_of(s), text_of(title), warning, error, blocking))
        c.popup_open = blocking
        while blocking and c.popup_open:
            yield

    def protective_stop(self) -> None:
        """Stop the program from its next frame on; one that has nothing left to do ends."""
        self._controller.protective_stop("a protective stop was triggered", code=209)

    def socket_open(self, address: str, port: int, socket_name: str = NAME) -> Slices:
        # so that the other side sees the connections of a script in their order, as over a network
        for _ in range(OPEN_FRAMES):
            yield
        return self._open(address, port, socket_name)

    def _open(self, address: str, port: int, socket_name: str) -> bool:
        if not re.fullmatch(r"127(\.\d{1,3}){3}", str(address)):
            self._controller.note(f"socket_open: {address} is not on loopback")
            return False
        self.socket_close(socket_name)
        if len(self._program.sockets) >= MOST_SOCKETS:
            raise ScriptError(f"A program has no more than {MOST_SOCKETS} sockets.")
        try:
            self._program.sockets[socket_name] = ScriptSocket(str(address), int(port))
        except OSError as error:
            self._controller.note(f"socket_open: {address}:{port} ({error})")
            return False
        return True

    def socket_close(self, socket_name: str = NAME) -> None:
        opened = self._program.sockets.pop(socket_name, None)
        if opened is not None:
            opened.close()

    def socket_send_string(self, str: Any, socket_name: str = NAME) -> bool:
        return self._send(text_of(str).encode(), socket_name)

    def socket_send_line(self, str: Any, socket_name: str = NAME) -> bool:
        return self._send(text_of(str).encode() + b"\n", socket_name)

    def socket_send_int(self, value: int, socket_name: str = NAME) -> bool:
        return self._send(struct.pack(">i", int(value)), socket_name)

    def socket_send_byte(self, value: int, socket_name: str = NAME) -> bool:
        return self._send(bytes([int(value) & 0xFF]), socket_name)

    def socket_set_var(self, name: str, value: int, socket_name: str = NAME) -> bool:
        return self._send(f"SET {text_of(name)} {int(value)}\n".encode(), socket_name)

    def socket_get_var(self, name: str, socket_name: str = NAME) -> Slices:
        self._send(f"GET {text_of(name)}\n".encode(), socket_name)
        answer = yield from self.socket_read_line(socket_name)
        found = re.fullmatch(r"(\S+) (-?\d{1,10})", answer)
        return int(found[2]) if found and found[1] == name else 0

    def socket_read_line(self, socket_name: str = NAME, timeout: float = 2.0) -> Slices:
        line = yield from self._read(socket_name, timeout, lambda inbox: inbox.find(b"\n") + 1)
        return line.decode("utf-8", "replace").rstrip("\r\n")

    def socket_read_string(
        self,
        socket_name: str = NAME,
        prefix: str = "",
        suffix: str = "",
        interpret_escape: bool = False,
        timeout: float = 2.0,
    ) -> Slices:
        end = suffix.encode().decode("unicode_escape") if interpret_escape else suffix

        def whole(inbox: bytearray) -> int:
            return (inbox.find(end.encode()) + len(end)) * (end.encode() in inbox) if end else len(inbox)

        text = (yield from self._read(socket_name, timeout, whole)).decode("utf-8", "replace")
        return text.partition(prefix)[2].removesuffix(end) if prefix else text.removesuffix(end)

    def socket_read_ascii_float(self, number: int, socket_name: str = NAME, timeout: float = 2.0) -> Slices:
        _count(number)
        text = yield from self._read(socket_name, timeout, lambda inbox: inbox.find(b")") + 1)
        found = [float(value) for value in re.findall(rb"[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?", text)]
        return [len(found), *found] if len(found) == number else [0, *[math.nan] * int(number)]

    def socket_read_binary_integer(self, number: int, socket_name: str = NAME, timeout: float = 2.0) -> Slices:
        return (yield from self._numbers(_count(number), "i", socket_name, timeout))

    def socket_read_byte_list(self, number: int, socket_name: str = NAME, timeout: float = 2.0) -> Slices:
        return (yield from self._numbers(_count(number), "B", socket_name, timeout))

    def _numbers(self, number: int, code: str, name: str, timeout: float) -> Slices:
        size = struct.calcsize(f">{number}{code}")
        data = yield from self._read(name, timeout, lambda inbox: size * (len(inbox) >= size))
        return [number, *struct.unpack(f">{number}{code}", data)] if data else [0, *[-1] * number]

    def _send(self, data: bytes, name: str) -> bool:
        opened = self._program.sockets.get(name)
        return opened is not None and opened.send(data)

    def _read(self, name: str, timeout: float, whole: Callable[[bytearray], int]) -> Slices:
        """What `whole` says is complete, taken off the inbox; nothing when the time is up.

        A timeout of 0 waits for ever.
        """
        opened = self._program.sockets.get(name)
        if opened is None:
            raise ScriptError(f"The socket {name!r} is not open.")
        frames = 0
        while True:
            opened.fill()
            length = whole(opened.inbox)
            if length > 0:
                data = bytes(opened.inbox[:length])
                del opened.inbox[:length]
                if 2 * Effort.left < EFFORT:
                    # a client that sends faster than its program reads costs the program frames, and does not end it
                    yield
                return data
            if timeout > 0.0 and frames * STEP_S >= timeout:
                return b""
            frames += 1
            yield


def _count(number: Any) -> int:
    """How many numbers a read asks for."""
    if not 0 <= number <= MOST_NUMBERS:
        raise ScriptError(f"A read has 0 to {MOST_NUMBERS} numbers, not {number!r}.")
    return int(number)
