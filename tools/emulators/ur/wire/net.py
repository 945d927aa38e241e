"""Sockets of the emulator in one loop, with injected network faults per connection."""

import contextlib
import select
import socket
import struct
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from weldcal.tools.connections import CONNECTIONS

# A client that does not read is dropped after this long, as the controller does.
UNREAD_LIMIT_S = 10.0
MAX_QUEUED = 1 << 20
MOST_CONNECTIONS = 200  # select() cannot watch more than about 1000
DIAL_LIMIT_S = 0.02
TORN_S = 0.001


@dataclass(kw_only=True)
class LinkFaults:
    """What is wrong with one connection; times are on the host's monotonic clock (s)."""

    drop_until: float = 0.0
    drop_share: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    delay_until: float = 0.0
    delay_clock: Callable[[], float] | None = None  # of the delay; None: the host's
    freeze_until: float = 0.0
    deaf_until: float = 0.0
    deaf_clock: Callable[[], float] | None = None  # of deaf_until; None: the host's
    corrupt: int = 0
    wrong_size: int = 0
    piece: int = 0
    half_open: bool = False

    def deaf(self, now: float) -> bool:
        """Return whether what comes in is not heard."""
        return (now if self.deaf_clock is None else self.deaf_clock()) < self.deaf_until


class Connection:
    """One accepted socket: bytes in, whole packages out."""

    def __init__(self, kind: str, sock: socket.socket, rng: np.random.Generator) -> None:
        self.kind = kind
        self.sock = sock
        self.faults = LinkFaults()
        self.inbox = bytearray()
        self.closed = self.heard = False
        self.patient = False  # never dropped for not reading
        self._rng = rng
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._outbox = bytearray()
        self._stuck_since: float | None = None
        self._held, self._held_until = 0, 0.0

    def send(self, package: bytes, now: float, *, droppable: bool = False) -> None:
        """Queues a package; one that is droppable is left out where the client does not read, and by the faults."""
        faults = self.faults
        if faults.half_open or self.closed:
            return
        if droppable:
            if now < faults.drop_until or (faults.drop_share > 0.0 and self._rng.random() < faults.drop_share):
                return
            if self._outbox and self._stuck_since is not None:
                return
        if faults.corrupt > 0 and len(package) > 3:
            faults.corrupt -= 1
            spoiled = bytearray(package)
            spoiled[int(self._rng.integers(3, len(package)))] ^= 0xFF
            package = bytes(spoiled)
        if faults.wrong_size > 0 and len(package) > 3:
            faults.wrong_size -= 1
            package = struct.pack(">H", len(package) + 5) + package[2:]
        due = clock = now if faults.delay_clock is None else faults.delay_clock()
        if now < faults.delay_until:
            due = clock + faults.delay_s + (self._rng.uniform(0.0, faults.jitter_s) if faults.jitter_s else 0.0)
        if self._waiting or due > clock:
            # packages keep their order, whatever the jitter
            self._waiting.append((max(due, self._waiting[-1][0]) if self._waiting else due, package))
        else:
            self._outbox += package

    @property
    def unread(self) -> bool:
        """The client does not read: its socket is full."""
        return self._stuck_since is not None

    def flush(self, now: float) -> None:
        """Writes what is due and what fits."""
        clock = now if self.faults.delay_clock is None else self.faults.delay_clock()
        while self._waiting and self._waiting[0][0] <= clock:
            self._outbox += self._waiting.popleft()[1]
        if not self._outbox or self.closed or self.faults.half_open or now < self.faults.freeze_until:
            return
        ready = len(self._outbox)
        if self.faults.piece and (ready != self._held or now < self._held_until):
            # torn packages: the last bytes of what is due come a frame later, as the start of the next piece
            self._held = min(ready, self.faults.piece)
            ready -= self._held
            self._held_until = now + TORN_S
            if not ready:
                return
        try:
            sent = self.sock.send(self._outbox[:ready])
        except (BlockingIOError, InterruptedError):
            sent = 0
        except OSError:
            self.closed = True
            return
        del self._outbox[:sent]
        if not self._outbox or sent == ready:
            self._stuck_since = None
        elif self._stuck_since is None:
            self._stuck_since = now
        elif (now - self._stuck_since > UNREAD_LIMIT_S and not self.patient) or len(self._outbox) > MAX_QUEUED:
            self.close(reset=True)

    def receive(self, now: float) -> bytes:
        """What has arrived; empty where there is nothing, or where a fault keeps us from reading."""
        try:
            data = self.sock.recv(65536)
        except (BlockingIOError, InterruptedError):
            return b""
        except OSError:
            self.closed = True
            return b""
        self.heard = self.heard or bool(data)
        if not data:
            self.closed = True
        return b"" if self.faults.deaf(now) else data

    def lines(self, data: bytes) -> Iterator[bytes]:
        """The lines that are complete with these bytes, without their ends; the rest waits in the inbox."""
        *lines, rest = (self.inbox + data).split(b"\n")
        self.inbox[:] = rest
        if len(rest) > MAX_QUEUED:
            self.close(reset=True)
        yield from map(bytes, lines)

    def readable(self, now: float) -> bool:
        """Return whether the loop should look at this socket."""
        return not (self.closed or self.faults.half_open or now < self.faults.freeze_until)

    def close(self, *, reset: bool) -> None:
        """RST or FIN."""
        if reset:
            with contextlib.suppress(OSError):
                self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        with contextlib.suppress(OSError):
            self.sock.close()
        self.closed = True


class Server:
    """The protocol of one port."""

    kind = ""

    def opened(self, connection: Connection, now: float) -> None:
        """A client has come."""

    def arrived(self, connection: Connection, data: bytes, now: float) -> None:
        """Bytes from a client."""

    def gone(self, connection: Connection) -> None:
        """A client has left."""

    def frame(self, now: float) -> None:
        """A control frame is over."""


class Network:
    """Listeners and connections of all servers."""

    def __init__(self, host: str, seed: int) -> None:
        self._host = host
        self._rng = np.random.default_rng(seed)
        self._listeners: dict[socket.socket, tuple[Server, int]] = {}
        self._ports: list[tuple[Server, int]] = []
        self.connections: dict[Connection, Server] = {}

    def listen(self, server: Server, port: int) -> None:
        """Raises OSError where the port is taken."""
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            sock.bind((self._host, port))
        except OSError:
            sock.close()
            raise
        sock.listen(16)
        sock.setblocking(False)
        self._listeners[sock] = (server, port)

    def dial(self, server: Server, address: tuple[str, int], now: float) -> None:
        """Connects as a client; raises OSError where nobody listens."""
        sock = socket.create_connection(address, timeout=DIAL_LIMIT_S)
        self._adopt(sock, server, now)

    def unplug(self, *kept: Server) -> None:
        """Closes every listener and resets every connection but those of the servers named, as a reboot does."""
        for sock, (server, port) in list(self._listeners.items()):
            if server not in kept:
                sock.close()
                del self._listeners[sock]
                self._ports.append((server, port))
        for connection, server in self.connections.items():
            if server not in kept:
                connection.close(reset=True)

    def listening(self) -> list[Server]:
        """The servers that listen."""
        return [server for server, _ in self._listeners.values()]

    def plug(self) -> None:
        """Listens again where `unplug` stopped."""
        ports, self._ports = self._ports, []
        for server, port in ports:
            self.listen(server, port)

    def poll(self, timeout_s: float, clock: Callable[[], float]) -> None:
        """Reads what there is, waiting at most timeout_s for the first byte."""
        now = clock()
        by_socket = {c.sock: c for c in self.connections if c.readable(now)}
        ready, _, _ = select.select([*self._listeners, *by_socket], [], [], max(0.0, timeout_s))
        now = clock()
        for sock in ready:
            if sock in self._listeners:
                self._accept(sock, now)
                continue
            connection = by_socket[sock]
            if connection not in self.connections:  # ended for one that has come
                continue
            data = connection.receive(now)
            if connection.closed:
                # at once: what this client has claimed is free for one that has just come
                self._forget(connection)
            if data:
                self.connections[connection].arrived(connection, data, now)
                connection.flush(now)

    def _accept(self, listener: socket.socket, now: float) -> None:
        server, _ = self._listeners[listener]
        try:
            sock, _ = listener.accept()
        except OSError:
            return
        if len(self.connections) >= CONNECTIONS:
            # one more ends the oldest that has never asked for anything, as a client of RTDE or of the dashboard does
            silent = next((c for c in self.connections if not c.heard), None)
            if silent is None:
                sock.close()
                return
            self._forget(silent)
        self._adopt(sock, server, now)

    def _adopt(self, sock: socket.socket, server: Server, now: float) -> None:
        if len(self.connections) >= MOST_CONNECTIONS:
            sock.close()
            return
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection = Connection(server.kind, sock, self._rng)
        self.connections[connection] = server
        server.opened(connection, now)
        connection.flush(now)

    def flush(self, now: float) -> None:
        """Writes what is due and forgets who has left."""
        for connection in list(self.connections):
            connection.flush(now)
            if connection.closed:
                self._forget(connection)

    def _forget(self, connection: Connection) -> None:
        self.connections.pop(connection).gone(connection)
        connection.close(reset=False)

    def of_kind(self, kind: str) -> list[Connection]:
        """Connections of one protocol, or all but the control channel's for "all"."""
        alive = [c for c in self.connections if not c.closed]
        return [c for c in alive if c.kind == kind or (kind == "all" and c.kind != "control")]

    def close(self) -> None:
        """Closes everything."""
        for sock in self._listeners:
            sock.close()
        for connection in self.connections:
            connection.close(reset=False)
