"""Client of Modbus TCP: reads and writes 16-bit registers (functions 3, 4, 6 and 16).

Source: MODBUS Application Protocol Specification V1.1b3 and MODBUS Messaging on TCP/IP Implementation Guide V1.0b.
"""

import contextlib
import socket
import struct
from collections.abc import Sequence

from weldcal.models.errors import WeldcalError

READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_MANY = 3, 4, 6, 16
MOST_READ, MOST_WRITTEN = 125, 123  # registers of one request, by the specification
LARGEST_REGISTER = 0xFFFF
_HEADER = struct.Struct(">HHHB")  # transaction, protocol 0, bytes that follow, unit
_REFUSALS = {
    1: "it does not have this function",
    2: "it does not have this register",
    3: "it does not take this value",
    4: "it failed",
    6: "it is busy",
    11: "the device behind the gateway does not answer",
}


class ModbusError(WeldcalError):
    """The device cannot be reached, answers with something else than Modbus TCP, or refuses a request."""


class ModbusClient:
    """A connection to a Modbus TCP server; each call waits for the answer, at most `timeout_s`.

    Raises:
        ModbusError: nothing listens there.
    """

    def __init__(self, host: str, port: int = 502, unit: int = 1, timeout_s: float = 2.0) -> None:
        self.where, self._unit, self._number = f"{host}:{port}", unit, 0
        try:
            self._socket = socket.create_connection((host, port), timeout_s)
        except OSError as error:
            raise ModbusError(f"{self.where} does not answer ({error}).") from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self, address: int, count: int, function: int = READ_HOLDING) -> tuple[int, ...]:
        """Read registers from an address (from 0) on; `function` 3: holding registers, 4: input registers."""
        answer = self._ask(struct.pack(">BHH", function, address, count))
        if len(answer) != 2 + 2 * count or answer[1] != 2 * count:
            raise ModbusError(f"{self.where} answered with {max(len(answer) - 2, 0)} bytes in place of {2 * count}.")
        return struct.unpack(f">{count}H", answer[2:])

    def write(self, address: int, values: Sequence[int]) -> None:
        """Write holding registers from an address on; one of them by function 6, more by function 16."""
        if len(values) == 1:
            request = struct.pack(">BHH", WRITE_ONE, address, values[0])
            expected = request
        else:
            head = struct.pack(">BHH", WRITE_MANY, address, len(values))
            request, expected = head + struct.pack(f">B{len(values)}H", 2 * len(values), *values), head
        if self._ask(request) != expected:
            raise ModbusError(f"{self.where} did not confirm the write to register {address}.")

    def _ask(self, request: bytes) -> bytes:
        """Send a request and return its answer, both from the function code on."""
        self._number = (self._number + 1) % 0x10000
        try:
            self._socket.sendall(_HEADER.pack(self._number, 0, 1 + len(request), self._unit) + request)
            number, protocol, size, _ = _HEADER.unpack(self._take(_HEADER.size))
            if number != self._number or protocol != 0 or not 2 < size < 256:
                raise ModbusError(f"{self.where} does not speak Modbus TCP: look at host and port.")
            answer = self._take(size - 1)
        except OSError as error:
            raise ModbusError(f"{self.where} does not answer ({error}).") from None
        if answer[0] == request[0] | 0x80:
            why = _REFUSALS.get(answer[1], "")
            raise ModbusError(f"{self.where} refused function {request[0]} with code {answer[1]}: {why or 'unknown'}.")
        if answer[0] != request[0]:
            raise ModbusError(f"{self.where} answered function {request[0]} with function {answer[0]}.")
        return answer

    def _take(self, count: int) -> bytes:
        found = b""
        while len(found) < count:
            part = self._socket.recv(count - len(found))
            if not part:
                raise ModbusError(f"{self.where} closed the connection.")
            found += part
        return found

    def close(self) -> None:
        """Close the connection; a second call has no effect."""
        with contextlib.suppress(OSError):
            self._socket.close()
