"""The process of one page: Flask, behind the limits of connections.py.

It asks the run over a pipe for all that it shows.
"""

from __future__ import annotations

import json
import os
import secrets
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from flask import Flask, Response, abort, jsonify, render_template, request
from werkzeug.serving import ThreadedWSGIServer, WSGIRequestHandler

from weldcal.tools.connections import LARGEST_REQUEST, STREAMS, Limited

LOOPBACK = "127.0.0.1"
PERIOD_S = 0.1
QUIET_S = 1.0  # something is sent at least so often: a page that hears nothing for longer says so
LAST_WORDS_S = 0.6
FILES_S = 6.0  # for an open page to load the recording and the report, which it shows when the program has ended
NICENESS = 10  # of the page for the network
_PAGE = Path(__file__).parent / "page"


@dataclass(frozen=True)
class PageSetup:
    """What the process starts with: listening socket, key of the buttons or None, token of the address or None.

    ``page``: name of its files in the folder of the pages.
    """

    listener: socket.socket
    view_url: str | None
    key: str | None
    token: str | None
    page: str = "dashboard"


class _Handler(WSGIRequestHandler):
    """Writes no line for each request: the terminal belongs to the progress bar."""

    def log(self, type: str, message: str, *args: Any) -> None:
        """See WSGIRequestHandler."""


class _Server(Limited, ThreadedWSGIServer):
    def log(self, type: str, message: str, *args: Any) -> None:
        """See BaseWSGIServer."""


def serve_page(pipe: Connection, setup: PageSetup) -> None:
    """Serve until the run ends the page, or nobody is at the other end of the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if setup.token is not None:
        os.nice(NICENESS)
    with suppress(EOFError, OSError):
        _Page(pipe, setup).serve()
    os._exit(0)  # the threads of connections have nothing to close


class _Page:
    def __init__(self, pipe: Connection, setup: PageSetup) -> None:
        self._pipe, self._setup = pipe, setup
        self._lock = threading.Lock()
        self._values: dict[str, Any] = {}
        self._rows: dict[str, list[Any]] = {"weld": [], "scans": []}
        self._looked_at = float("-inf")
        self._closing = threading.Event()
        self._streams = 0
        self._sent: set[str] = set()
        host, port = setup.listener.getsockname()[:2]
        self._server = _Server(host, port, self._application(), _Handler, fd=setup.listener.fileno())

    def serve(self) -> None:
        """Raises EOFError, OSError: the run has ended."""
        threading.Thread(target=self._server.serve_forever, args=(PERIOD_S,), daemon=True).start()
        while not self._ask("over"):
            time.sleep(PERIOD_S)
        until = time.monotonic() + FILES_S
        while self._streams and set(self._ask("files")) - self._sent and time.monotonic() < until:
            time.sleep(0.02)
        until = time.monotonic() + LAST_WORDS_S
        self._closing.set()
        while self._streams and time.monotonic() < until:
            time.sleep(0.02)

    def _ask(self, *question: Any) -> Any:
        with self._lock:
            self._pipe.send(question)
            return self._pipe.recv()

    def _fresh(self) -> dict[str, Any]:
        """Return the values, no older than half a period, however many watch; the rows are fetched with them."""
        with self._lock:
            if time.monotonic() - self._looked_at > 0.5 * PERIOD_S:
                self._pipe.send(("look", *map(len, self._rows.values())))
                found = self._pipe.recv()
                if found is not None:
                    self._values = found[0]
                    for name, rows in self._rows.items():
                        rows.extend(found[1][name])
                self._looked_at = time.monotonic()
            return self._values

    def _application(self) -> Flask:
        """Return the pages: with a key they have buttons, with a token they are under it."""
        view_url, key, token = self._setup.view_url, self._setup.key, self._setup.token
        root = "" if token is None else f"/{token}"
        app = Flask("weldcal.dashboard", template_folder=str(_PAGE), static_folder=None)
        app.config["MAX_CONTENT_LENGTH"] = LARGEST_REQUEST
        frames = "'none'" if view_url is None else f"'self' {view_url}"

        @app.before_request
        def refuse_foreign_pages() -> None:
            own = f"http://{request.host}"
            name = request.host.rpartition(":")[0]
            if request.headers.get("Origin", own) != own or (token is None and name not in (LOOPBACK, "localhost")):
                abort(403)

        @app.after_request
        def restrict(response: Response) -> Response:
            response.headers["Content-Security-Policy"] = (
                f"default-src 'self'; img-src 'self' data:; frame-src {frames}; frame-ancestors 'none'; base-uri 'none'"
                if request.endpoint != "result_file"
                else "default-src 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'self'; base-uri 'none'"
            )
            response.headers["X-Content-Type-Options"] = "nosniff"
            response.headers["Referrer-Policy"] = "no-referrer"
            response.headers["Cache-Control"] = "no-store"
            return response

        @app.get(f"{root}/")
        def page() -> str:
            return render_template(f"{self._setup.page}.html", view_url=view_url, key=key or "")

        @app.get(f"{root}/dashboard.css")
        def style() -> Response:
            names = dict.fromkeys(("dashboard.css", f"{self._setup.page}.css"))
            return Response("".join((_PAGE / name).read_text() for name in names), mimetype="text/css")

        @app.get(f"{root}/dashboard.js")
        def script() -> Response:
            return Response((_PAGE / f"{self._setup.page}.js").read_text(), mimetype="text/javascript")

        @app.get(f"{root}/picture/<int:number>")
        def picture(number: int) -> Response:
            found = self._ask("picture")
            if found is None:
                abort(404)
            return Response(found, mimetype="image/png")

        @app.get(f"{root}/values")
        def values() -> Response:
            return jsonify(self._fresh())

        @app.get(f"{root}/events")
        def events() -> Response:
            if self._streams >= STREAMS:
                abort(503)
            self._server.keep(request.environ["werkzeug.socket"])
            return Response(self._events(), mimetype="text/event-stream")

        if key is not None:

            @app.get("/result/<name>")
            def result_file(name: str) -> Response:
                found = self._ask("file", name)
                if found is None:
                    abort(404)
                sent = Response(found, mimetype="text/html")
                sent.call_on_close(lambda: self._sent.add(name))
                return sent

            @app.post("/act/<what>")
            def act(what: str) -> Response:
                given = request.headers.get("X-Weldcal-Key", "")
                if not secrets.compare_digest(given.encode(), key.encode()):
                    abort(403)
                asked = request.get_json(silent=True)
                value = asked.get("value") if isinstance(asked, dict) else None
                value = float(value) if isinstance(value, int | float) else value if isinstance(value, str) else None
                return jsonify({"done": self._ask("act", what, value)})

        return app

    def _events(self) -> Iterator[str]:
        """The values as server-sent events: all rows of the plots first, then what is new."""
        self._streams += 1
        try:
            sent = dict.fromkeys(self._rows, 0)
            last, sent_at = "", 0.0
            while True:
                closing = self._closing.is_set()
                values = self._fresh()
                rows = {name: self._rows[name][n:] for name, n in sent.items()}
                sent = {name: n + len(rows[name]) for name, n in sent.items()}
                text = json.dumps(values | {"rows": rows, "closing": closing}, allow_nan=False)
                now = time.monotonic()
                if text != last or closing or now - sent_at > QUIET_S:
                    last, sent_at = text, now
                    yield f"data: {text}\n\n"
                if closing:
                    return
                self._closing.wait(PERIOD_S)
        finally:
            self._streams -= 1
