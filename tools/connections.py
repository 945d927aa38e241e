"""Limit connections and timeouts of every port that weldcal opens, so that strangers take no resources."""

import os
import resource
import selectors
import socket
import socketserver
import stat
import struct
import threading
import time
import weakref
from contextlib import suppress
from typing import Any

CONNECTIONS = 64  # of one port; one more ends the oldest that serves nobody
STREAMS = 12  # of one page: connections that stay, and are not ended by a newer one
VIEWS = 32  # connections of the 3D view's port
BACKLOG = 4096  # connections that wait to be accepted; more would be asked again by their system after a second
TIMEOUT_S = 10.0  # for a client that sends no request, or does not read its answer
LARGEST_REQUEST = 4096  # bytes of a request's body
DESCRIPTORS = 65_536  # of the process that draws the 3D view, where the system allows them
AT_ONCE = 64  # connections that are accepted before a request that has come is looked at
LOOK_S = 0.1
_PEACEFUL = 64  # open descriptors of a run up to which nothing is looked at
_TCP_BYTES_RECEIVED = struct.Struct("@128xQ")  # of Linux's tcp_info


class Limited(socketserver.ThreadingMixIn, socketserver.TCPServer):
    """A server with at most CONNECTIONS connections that wait for a request, and as many that are answered.

    Comes before its own class.

    A thread is started when a request begins. Every client has TIMEOUT_S to send it and to read its answer. A new
    connection ends the oldest that is not kept, so idle connections keep nobody away.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = BACKLOG

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self._lock = threading.Lock()
        self._open: dict[
            socket.socket, bool
        ] = {}  # those with a thread, in the order of their requests; whether each is kept
        self._ends, self._ended = threading.Event(), threading.Event()
        super().__init__(*arguments, **named)

    def keep(self, connection: socket.socket) -> None:
        """Let a connection last, whatever comes after it."""
        with self._lock:
            if connection in self._open:
                self._open[connection] = True

    def serve_forever(self, poll_interval: float = LOOK_S) -> None:
        """Serve until `shutdown`."""
        waiting: dict[
            socket.socket, Any
        ] = {}  # connections without a request and whose they are, in the order in which they came
        self.socket.setblocking(False)
        try:
            with selectors.DefaultSelector() as selector:
                selector.register(self.socket, selectors.EVENT_READ)
                while not self._ends.is_set():
                    ready = [key.fileobj for key, _ in selector.select(poll_interval)]
                    for one in (c for c in ready if c in waiting):
                        selector.unregister(one)
                        self.process_request(one, waiting.pop(one))
                    with suppress(OSError):  # none waits any more, or there is no descriptor left
                        for _ in range(AT_ONCE if self.socket in ready else 0):
                            connection, address = self.get_request()
                            if len(waiting) >= CONNECTIONS:
                                selector.unregister(oldest := next(iter(waiting)))
                                del waiting[oldest]
                                self.shutdown_request(oldest)
                            waiting[connection] = address
                            selector.register(connection, selectors.EVENT_READ)
        finally:
            for connection in waiting:
                self.shutdown_request(connection)
            self.server_close()
            self._ended.set()

    def shutdown(self) -> None:
        """End `serve_forever`, which runs in another thread."""
        self._ends.set()
        self._ended.wait()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection in a thread of its own."""
        with self._lock:
            if len(self._open) >= CONNECTIONS:
                oldest = next((c for c, kept in self._open.items() if not kept), request)
                self._open.pop(oldest, None)
                with suppress(OSError):
                    oldest.shutdown(socket.SHUT_RDWR)
            self._open[request] = False
        request.settimeout(TIMEOUT_S)
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """See ThreadingMixIn."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._open.pop(request, None)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that leaves, or is ended, is no news."""


def guard(view: Any) -> None:
    """Limit the connections of a Meshcat, whose server has no limit, by a thread for as long as it lives.

    Of more than VIEWS connections those are ended that have sent least.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < DESCRIPTORS:  # what comes between two looks must not end the run
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, DESCRIPTORS), hard))

    port, alive = view.port(), weakref.ref(view)

    def watch() -> None:
        while alive() is not None:
            time.sleep(LOOK_S)
            with suppress(OSError):  # a system without /proc
                if len(os.listdir("/proc/self/fd")) > _PEACEFUL:
                    end_surplus(port)

    threading.Thread(target=watch, daemon=True, name="connections").start()


def end_surplus(port: int) -> None:
    """End all but VIEWS connections at a port of this process."""
    found: list[tuple[int, socket.socket]] = []
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                copy = socket.socket(fileno=os.dup(int(name)))
                there = copy.family in (socket.AF_INET, socket.AF_INET6) and copy.getsockname()[1] == port
                if there and not copy.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                    info = copy.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_BYTES_RECEIVED.size)
                    found.append((_TCP_BYTES_RECEIVED.unpack(info)[0], copy))
                else:
                    copy.close()
    found.sort(key=lambda one: -one[0])
    for number, (_, connection) in enumerate(found):
        if number >= VIEWS:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            time.sleep(0.0)  # the control loop is not kept waiting
        connection.close()


def network_address() -> str:
    """Return the address of this computer on its network; 127.0.0.1 where there is none. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address of documentation
            return str(probe.getsockname()[0])
        except OSError:
            return "127.0.0.1"
