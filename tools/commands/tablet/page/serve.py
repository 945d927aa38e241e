"""Serves the page to a tablet and receives its touches as a CSV file; on loopback by default."""

import errno
import ipaddress
import socket
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path

from weldcal.models.errors import InputError
from weldcal.tools.report.render import write_atomic

LARGEST_CSV = 1_000_000
FIRST_COLUMNS = "landmark,time_utc,"


def page() -> str:
    """The page: one self-contained HTML text."""
    return files("weldcal.tools.commands.tablet.page").joinpath("tablet.html").read_text(encoding="utf-8")


class TabletServer(ThreadingHTTPServer):
    """Serves one page and receives touches, each written to the next free file name of a folder."""

    daemon_threads = True

    def __init__(self, host: str, port: int, folder: Path, said: Callable[[str], None]) -> None:
        self.folder, self.said = folder, said
        self.html = page().encode()
        super().__init__((host, port), _Handler)

    def take(self, text: str) -> Path:
        """Write the touches to touches.csv, touches-2.csv ... and return the path."""
        number = 1
        while (path := self.folder / f"touches{'' if number == 1 else f'-{number}'}.csv").exists():
            number += 1
        write_atomic(path, text)
        self.said(f"{text.count(chr(10)) - 1} touches written to {path}")
        return path


class _Handler(BaseHTTPRequestHandler):
    server: TabletServer
    timeout = 10

    def do_GET(self) -> None:
        if self.path.split("?")[0] in ("/", "/tablet.html"):
            self._answer(HTTPStatus.OK, self.server.html, "text/html; charset=utf-8")
        else:
            self._say(HTTPStatus.NOT_FOUND, "There is only one page.")

    def do_POST(self) -> None:
        # a foreign page cannot send this content type without a preflight request, which is not answered
        if self.path != "/touches" or self.headers.get_content_type() != "text/csv":
            return self._say(HTTPStatus.NOT_FOUND, "Only touches are accepted.")
        try:
            length = int(self.headers.get("Content-Length", ""))
        except ValueError:
            return self._say(HTTPStatus.LENGTH_REQUIRED, "The length is missing.")
        if not 0 < length <= LARGEST_CSV:
            return self._say(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "This is not a list of touches.")
        text = self.rfile.read(length).decode("utf-8", errors="replace")
        if not text.startswith(FIRST_COLUMNS):
            return self._say(HTTPStatus.BAD_REQUEST, "This is not a list of touches.")
        path = self.server.take(text)
        return self._say(HTTPStatus.OK, f"Written to {path.name} on the computer.")

    def _say(self, status: HTTPStatus, sentence: str) -> None:
        self._answer(status, sentence.encode(), "text/plain; charset=utf-8")

    def _answer(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing per request."""


def open_server(host: str, port: int, folder: Path, said: Callable[[str], None]) -> TabletServer:
    """A server that listens but does not serve yet; port 0 takes any free one.

    Raises:
        InputError: the port is in use or not allowed, or the host is not an address of this machine.
    """
    try:
        return TabletServer(host, port, folder, said)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise InputError(f"Port {port} is in use on {host}. Choose another with --port.") from error
        if error.errno in (errno.EACCES, errno.EPERM):
            raise InputError(f"Port {port} may not be used. Choose one above 1023 with --port.") from error
        raise InputError(f"'{host}' is not an address of this machine. Give one with --host.") from error
    except OverflowError as error:
        raise InputError("The port must be from 0 to 65535.") from error


def addresses(host: str, port: int) -> list[str]:
    """The addresses to open on the tablet."""
    if not _unspecified(host):
        return [f"http://{f'[{host}]' if ':' in host else host}:{port}/"]
    # connecting a datagram socket sends nothing, and tells which of this machine's addresses would be used
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            name = str(probe.getsockname()[0])
        except OSError:  # no network at all
            name = "127.0.0.1"
    return [f"http://{name}:{port}/"]


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach that host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _unspecified(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False


def run_server(host: str, port: int, folder: Path, said: Callable[[str], None]) -> None:
    """Serve until interrupted; reports the address and every received file."""
    with open_server(host, port, folder, said) as server:
        for address in addresses(host, server.server_address[1]):
            said(f"Open {address} on the tablet. Stop with Ctrl+C.")
        if is_loopback(host):
            said("Only this machine can reach it. For a tablet in the network give --host 0.0.0.0.")
        try:
            server.serve_forever(poll_interval=0.1)
        except KeyboardInterrupt:
            said("Stopped.")
