"""Serve the dashboard's pages, each by a process: on loopback, and read-only for the network behind a token."""

from __future__ import annotations

import secrets
import socket
import threading
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

from weldcal.systems.interrupts import deferred
from weldcal.tools.connections import BACKLOG, network_address
from weldcal.tools.dashboard.page_process import FILES_S, LAST_WORDS_S, LOOPBACK, PageSetup, serve_page

ANYWHERE = "0.0.0.0"
PORTS = range(7580, 7600)  # the first free one, so that a page that is open finds the next run
END_S = FILES_S + LAST_WORDS_S + 1.0


class PageSource(Protocol):
    """What a page shows, and what its buttons do; the methods are called from the server's threads."""

    files: dict[str, Path]

    def values(self) -> dict[str, Any]:
        """Return all present values of the page."""

    def rows(self, weld: int, scans: int) -> dict[str, Any]:
        """Return the rows of the plots from these numbers on."""

    def act(self, what: str, value: Any = None) -> bool:
        """Do what a button asks; False where there is no such button."""

    def picture(self) -> bytes | None:
        """Return the newest picture as a PNG, or None."""


class Dashboard:
    """The pages of a run, served from when they are made until they are closed.

    The buttons need a key that only the page itself can read: a foreign page in the same browser can neither read nor
    use it, and nothing is answered under a foreign host name. `url` is the page's address on this computer;
    `shared_url` the one for the network, with its token, or None. What strangers do to a port reaches its process only:
    the run answers one question of a page at a time.
    """

    def __init__(self, source: PageSource, view_url: str | None, share: bool = False, page: str = "dashboard") -> None:
        self.source, self._page = source, page
        self._over = threading.Event()
        self._processes: list[Any] = []
        self.url = f"http://{LOOPBACK}:{self._start(LOOPBACK, view_url, secrets.token_urlsafe(24), None)}/"
        self.shared_url: str | None = None
        if share:
            token = secrets.token_urlsafe(12)
            self.shared_url = f"http://{network_address()}:{self._start(ANYWHERE, None, None, token)}/{token}/"

    def close(self) -> None:
        """Stop serving; the pages that are open get the last values first. A second call has no effect."""
        self._over.set()
        while self._processes:
            process = self._processes.pop()
            process.join(END_S)
            process.kill()
            process.join()

    def _start(self, host: str, view_url: str | None, key: str | None, token: str | None) -> int:
        """Start the process of a page on a free port of this host; returns the port."""
        context = get_context("spawn")
        with _bound(host) as listener:
            ours, its = context.Pipe()
            with deferred():
                process = context.Process(
                    target=serve_page, args=(its, PageSetup(listener, view_url, key, token, self._page)), daemon=True
                )
                process.start()
                self._processes.append(process)
            its.close()
            threading.Thread(target=self._answer, args=(ours, key is not None), daemon=True, name="dashboard").start()
            return int(listener.getsockname()[1])

    def _answer(self, pipe: Connection, acts: bool) -> None:
        """Answer a page's questions until its process ends; one without a key cannot act, whatever it asks."""
        with pipe, suppress(EOFError, OSError):
            while True:
                what, *given = pipe.recv()
                answer: Any = None
                with suppress(Exception):  # values that cannot be shown must not take Hold away
                    answer = self._found(what, given) if acts or what != "act" else False
                pipe.send(answer)

    def _found(self, what: str, given: list[Any]) -> Any:
        source = self.source
        if what == "look":
            return source.values(), source.rows(*given)
        if what == "act":
            return source.act(*given)
        if what == "picture":
            return source.picture()
        if what == "files":
            return list(source.files)
        if what == "file":
            return source.files[given[0]].read_bytes() if given[0] in source.files else None
        return self._over.is_set()


def _bound(host: str) -> socket.socket:
    """Return a listening socket on the first free port of PORTS, or on any."""
    for port in (*PORTS, 0):
        found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            if port:
                found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            found.bind((host, port))
            found.listen(BACKLOG)
        except OSError:
            found.close()
            if port == 0:
                raise
            continue
        return found
    raise AssertionError("port 0 is always tried")
