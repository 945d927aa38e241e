"""Emulated power source: a Modbus TCP server with the registers of a map, and an arc that follows them."""

from __future__ import annotations

import contextlib
import socketserver
import struct
import threading
import time
from types import TracebackType

import numpy as np

from weldcal.systems.drivers.power.register_map import RegisterMap
from weldcal.systems.drivers.simulated.power_source import SimulatedPowerSource

WATCHDOG_S = 0.5  # a choice: as real sources, which end the arc when the connection is silent
SIZE = 0x10000  # registers of a Modbus device


class _Connection(socketserver.BaseRequestHandler):
    """One connection. Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, section 3.1.3."""

    server: _Server

    def handle(self) -> None:
        with contextlib.suppress(OSError):
            while (head := self._take(7)) is not None:
                body = self._take(int.from_bytes(head[4:6], "big") - 1)
                if body is None:
                    return
                answer = self.server.emulator.answered(body)
                if answer is None:
                    return
                self.request.sendall(head[:4] + (len(answer) + 1).to_bytes(2, "big") + head[6:] + answer)

    def _take(self, count: int) -> bytes | None:
        found = b""
        while len(found) < count:
            part = self.request.recv(count - len(found))
            if not part:
                return None
            found += part
        return found


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address, daemon_threads = True, True
    emulator: PowerSourceEmulator


class PowerSourceEmulator:
    """A power source on loopback; a context that serves while it is entered.

    Attributes:
        holding: its holding registers.
        error: the number that it reports.
        silent: whether it takes requests without an answer. refuses: an exception code for all requests.
        requests: function codes of all requests so far.
    """

    def __init__(
        self, registers: RegisterMap, arc: SimulatedPowerSource | None = None, host: str = "127.0.0.1", port: int = 0
    ) -> None:
        self.registers, self._arc = registers, arc or SimulatedPowerSource(noise=0.0)
        self.holding = [0] * SIZE
        self.error, self.silent, self.refuses = 0.0, False, 0
        self.requests: list[int] = []
        self._lit_since: float | None = None
        self._toggled_at, self._toggle = time.monotonic(), 0.0
        self._server = _Server((host, port), _Connection)
        self._server.emulator = self

    @property
    def port(self) -> int:
        """The port that it listens at."""
        return int(self._server.server_address[1])

    def __enter__(self) -> PowerSourceEmulator:
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._server.shutdown()
        self._server.server_close()

    @staticmethod
    def serve(registers: RegisterMap, host: str, port: int) -> None:
        """Serve until the process ends."""
        with PowerSourceEmulator(registers, host=host, port=port):
            threading.Event().wait()

    def set_value(self, name: str) -> float:
        """The set value that it has got, by a name of SET."""
        register = self.registers.set[name]
        return register.value(self.holding[register.address])

    @property
    def asked(self) -> bool:
        """Whether the arc is asked for, and the watchdog, where the map has one, toggles."""
        now, watched = time.monotonic(), "watchdog" in self.registers.set
        return self.set_value("arc_on") > 0.5 and not (watched and now - self._toggled_at > WATCHDOG_S)

    @property
    def shown(self) -> dict[str, float]:
        """What it shows, by names of SHOWN."""
        now = time.monotonic()
        self._lit_since = (self._lit_since or now) if self.asked else None
        burning = self._lit_since is not None and now - self._lit_since >= self._arc.ignition_s and not self.error
        given = [
            self.set_value(name) if name in self.registers.set else np.nan
            for name in ("job", "wire_feed_m_min", "voltage_V", "current_A")
        ]
        # a register that nobody has written is no set value
        current, voltage = self._arc.aim(np.array([v if v else np.nan for v in given])) if burning else (0.0, 0.0)
        return {
            "arc_established": float(burning),
            "current_A": float(current),
            "voltage_V": float(voltage),
            "ready": float(not self.error),
            "error": self.error,
        }

    def answered(self, request: bytes) -> bytes | None:
        """Answer a request, from the function code on; None closes the connection."""
        function, address, count = struct.unpack(">BHH", request[:5])
        self.requests.append(function)
        if self.silent:
            time.sleep(5.0)
            return None
        if self.refuses or function not in (3, 4, 6, 16):
            return bytes([function | 0x80, self.refuses or 1])
        if function in (3, 4):
            shown = self.shown
            words = self.holding.copy() if function == 3 else [0] * SIZE
            if (function == 4) == self.registers.input_registers:
                for name, register in self.registers.shown.items():
                    words[register.address] |= register.word(shown[name])
            return struct.pack(f">BB{count}H", function, 2 * count, *words[address : address + count])
        values = (count,) if function == 6 else struct.unpack(f">{count}H", request[6:])
        self.holding[address : address + len(values)] = values
        if "watchdog" in self.registers.set and self.set_value("watchdog") != self._toggle:
            self._toggle, self._toggled_at = self.set_value("watchdog"), time.monotonic()
        return request[:5]
