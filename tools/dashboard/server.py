"""The dashboard's web server: Flask in threads of its own, on loopback; for the network a second one, read-only, behind a token."""

from __future__ import annotations

import json
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from flask import Flask, Response, abort, jsonify, render_template, request
from werkzeug.serving import BaseWSGIServer, WSGIRequestHandler, make_server

from weldcal.tools.dashboard.source import DashboardSource

LOOPBACK, ANYWHERE = "127.0.0.1", "0.0.0.0"
PORTS = range(7580, 7600)  # the first free one, so that a page that is open finds the next run
PERIOD_S = 0.1
QUIET_S = 1.0  # something is sent at least so often: a page that hears nothing for longer says so
STREAMS = 12
LAST_WORDS_S = 0.6
FILES_S = 6.0  # for an open page to load the recording and the report, which it shows when the program has ended
_PAGE = Path(__file__).parent / "page"


class _Connections:
    """The connections of a page. A browser keeps some open that it has not used yet: those would reach a page that is over."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._over = False

    def add(self, connection: socket.socket) -> None:
        """A new connection; it ends at once where the page is over."""
        with self._lock:
            self._open.add(connection)
            if self._over:
                _end(connection)

    def discard(self, connection: socket.socket) -> None:
        """A connection that is closed."""
        with self._lock:
            self._open.discard(connection)

    def end(self) -> None:
        """End all of them, and those that still come."""
        with self._lock:
            self._over = True
            for connection in self._open:
                _end(connection)

    def handler(self) -> type[WSGIRequestHandler]:
        """A handler whose connections these are. It writes no line for each request: the terminal belongs to the progress bar."""
        connections = self

        class Handler(WSGIRequestHandler):
            def setup(self) -> None:
                super().setup()
                connections.add(self.connection)

            def finish(self) -> None:
                connections.discard(self.connection)
                super().finish()

            def log(self, type: str, message: str, *args: Any) -> None:
                """See WSGIRequestHandler."""

        return Handler


class Dashboard:
    """A page of a run, served from when it is made until it is closed.

    Its buttons need a key that only the page itself can read: a foreign page in the same browser can neither read nor use it, and
    nothing is answered under a foreign host name. `url` is the page's address on this computer; `shared_url` the one for the network,
    with its token, or None.
    """

    def __init__(self, source: DashboardSource, view_url: str, share: bool = False) -> None:
        self.source = source
        self._closing = threading.Event()
        self._streams = 0
        self._sent: set[str] = set()
        self._servers: list[BaseWSGIServer] = []
        self._connections = _Connections()
        key = secrets.token_urlsafe(24)
        port = self._serve(self._application(view_url, key, None), LOOPBACK)
        self.url = f"http://{LOOPBACK}:{port}/"
        self.shared_url: str | None = None
        if share:
            token = secrets.token_urlsafe(12)
            port = self._serve(self._application(None, None, token), ANYWHERE)
            self.shared_url = f"http://{_own_address()}:{port}/{token}/"

    def close(self) -> None:
        """Stop serving; the pages that are open get the last values first. A second call has no effect."""
        if self._closing.is_set():
            return
        until = time.monotonic() + FILES_S
        while self._streams and set(self.source.files) - self._sent and time.monotonic() < until:
            time.sleep(0.02)
        until = time.monotonic() + LAST_WORDS_S
        self._closing.set()
        while self._streams and time.monotonic() < until:
            time.sleep(0.02)
        for server in self._servers:
            server.shutdown()
            server.server_close()
        self._connections.end()

    def _serve(self, application: Flask, host: str) -> int:
        """Serve an application on a free port of this host; returns the port."""
        bound = _bound(host)
        with bound:
            server = make_server(
                host, bound.getsockname()[1], application, threaded=True, request_handler=self._connections.handler(),
                fd=bound.fileno(),
            )  # fmt: skip
        self._servers.append(server)
        threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True, name="dashboard").start()
        return int(server.port)

    def _application(self, view_url: str | None, key: str | None, token: str | None) -> Flask:
        """The pages: with a key they have buttons, with a token they are under it; `view_url` is the 3D view's address."""
        root = "" if token is None else f"/{token}"
        app = Flask("weldcal.dashboard", template_folder=str(_PAGE), static_folder=None)
        frames = "'none'" if view_url is None else f"'self' {view_url}"

        @app.before_request
        def refuse_foreign_names() -> None:
            if token is None and request.host.rpartition(":")[0] not in (LOOPBACK, "localhost"):
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
            return render_template("dashboard.html", view_url=view_url, key=key or "")

        @app.get(f"{root}/dashboard.css")
        def style() -> Response:
            return Response((_PAGE / "dashboard.css").read_text(), mimetype="text/css")

        @app.get(f"{root}/dashboard.js")
        def script() -> Response:
            return Response((_PAGE / "dashboard.js").read_text(), mimetype="text/javascript")

        @app.get(f"{root}/picture/<int:number>")
        def picture(number: int) -> Response:
            found = self.source.picture()
            if found is None:
                abort(404)
            return Response(found, mimetype="image/png")

        @app.get(f"{root}/values")
        def values() -> Response:
            return jsonify(self.source.values())

        @app.get(f"{root}/events")
        def events() -> Response:
            if self._streams >= STREAMS:
                abort(503)
            return Response(self._events(), mimetype="text/event-stream")

        if key is not None:

            @app.get("/result/<name>")
            def result_file(name: str) -> Response:
                if name not in self.source.files:
                    abort(404)
                sent = Response(self.source.files[name].read_bytes(), mimetype="text/html")
                sent.call_on_close(lambda: self._sent.add(name))
                return sent

            @app.post("/act/<what>")
            def act(what: str) -> Response:
                own = f"http://{request.host}"
                given = request.headers.get("X-Weldcal-Key", "")
                if not secrets.compare_digest(given.encode(), key.encode()):
                    abort(403)
                if request.headers.get("Origin", own) != own:
                    abort(403)
                asked = request.get_json(silent=True)
                value = asked.get("value") if isinstance(asked, dict) else None
                number = float(value) if isinstance(value, int | float) else None
                return jsonify({"done": self.source.act(what, number)})

        return app

    def _events(self) -> Iterator[str]:
        """The values as server-sent events: all rows of the plots first, then what is new."""
        self._streams += 1
        try:
            weld = scans = 0
            last, sent_at = "", 0.0
            while True:
                closing = self._closing.is_set()
                rows = self.source.rows(weld, scans)
                weld, scans = weld + len(rows["weld"]), scans + len(rows["scans"])
                values = self.source.values()
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


def _end(connection: socket.socket) -> None:
    with suppress(OSError):  # the browser was first
        connection.shutdown(socket.SHUT_RDWR)


def _bound(host: str) -> socket.socket:
    """A listening socket on the first free port of PORTS, or on any."""
    for port in (*PORTS, 0):
        found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            if port:
                found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            found.bind((host, port))
            found.listen(64)
        except OSError:
            found.close()
            if port == 0:
                raise
            continue
        return found
    raise AssertionError("port 0 is always tried")


def _own_address() -> str:
    """The address of this computer on its network, or its name where there is none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # a documentation address: nothing is sent
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()
