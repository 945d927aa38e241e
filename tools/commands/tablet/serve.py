"""Serve the page to a tablet under an unguessable path and receive its touches as a CSV file."""

import errno
import ipaddress
import secrets
import socket
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from weldcal.models.errors import InputError
from weldcal.systems.addresses import is_loopback, own_address
from weldcal.tools.cli.options import Call, check_writable, command, option
from weldcal.tools.connections import Limited, network_address
from weldcal.tools.report.render import write_atomic

LARGEST_CSV = 1_000_000
FIRST_COLUMNS = "landmark,time_utc,"


@command("tablet serve", short_help="Serve the target page to a tablet.", common=("debug",))
def serve(
    call: Call,
    host: Annotated[
        str, option("--host", "ADDRESS", "Address to listen on; 0.0.0.0 admits the whole network.")
    ] = "127.0.0.1",
    port: Annotated[int, option("--port", "PORT", "Port; 0 takes any free one.")] = 8077,
    out: Annotated[Path, option("--out", "FOLDER", "Folder for the touches that the tablet sends.")] = Path(
        "weldcal-out/tablet"
    ),
) -> None:
    """Serve the target page to a tablet until interrupted: landmarks at true scale, touches to a tenth of a pixel."""
    check_writable(out)
    run_server(host, port, out, typer.echo)


def page() -> str:
    """Return the page: one self-contained HTML text."""
    return files("weldcal.tools.commands.tablet").joinpath("tablet.html").read_text(encoding="utf-8")


class TabletServer(Limited, ThreadingHTTPServer):
    """Serves one page under a path that nobody can guess and receives touches, each written to the next free file name.

    It answers only requests that name its own address, so that a foreign page cannot reach it under another name.
    """

    def __init__(self, host: str, port: int, folder: Path, said: Callable[[str], None]) -> None:
        self.folder, self.said = folder, said
        self.html = page().encode()
        self.token = secrets.token_urlsafe(16)
        if ipaddress.ip_address(host).version == 6:
            self.address_family = socket.AF_INET6
        super().__init__((host, port), _Handler)

    def address(self, host: str) -> str:
        """Return the page's URL on a host."""
        return f"http://{_in_url(host)}:{self.server_address[1]}/{self.token}/"

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
    server_version, sys_version = "weldcal", ""

    def do_GET(self) -> None:
        if self._welcome(""):
            self._answer(HTTPStatus.OK, self.server.html, "text/html; charset=utf-8")

    def do_POST(self) -> None:
        if not self._welcome("touches"):
            return None
        # A foreign page cannot send this content type without a preflight request, which is not answered.
        if self.headers.get_content_type() != "text/csv":
            return self._say(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "Only touches are accepted.")
        if self.headers.get("Origin", self._own()[0]) not in self._own():
            return self._say(HTTPStatus.FORBIDDEN, "Touches are taken from this page only.")
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal()):
            return self._say(HTTPStatus.LENGTH_REQUIRED, "The length is missing.")
        if len(length) > 12 or not 0 < int(length) <= LARGEST_CSV:
            return self._say(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "This is not a list of touches.")
        body = self.rfile.read(int(length))
        text = body.decode("utf-8", errors="replace")
        if len(body) < int(length) or not text.startswith(FIRST_COLUMNS):
            return self._say(HTTPStatus.BAD_REQUEST, "This is not a list of touches.")
        path = self.server.take(text)
        return self._say(HTTPStatus.OK, f"Written to {path.name} on the computer.")

    def _own(self) -> list[str]:
        """List this server's origins as a connection reaches it: its own address, and localhost on loopback."""
        here = ipaddress.ip_address(str(self.connection.getsockname()[0]).partition("%")[0])
        host = str(getattr(here, "ipv4_mapped", None) or here)
        names = [_in_url(host), *(["localhost"] if is_loopback(host) else [])]
        port = self.server.server_address[1]
        return [f"http://{name}:{port}" for name in names] + (
            [f"http://{name}" for name in names] if port == 80 else []
        )

    def _welcome(self, name: str) -> bool:
        """Return whether the request names this server and this path; a refusal is sent otherwise."""
        if f"http://{self.headers.get('Host', '')}" not in self._own():
            self._say(HTTPStatus.MISDIRECTED_REQUEST, "This server has another name.")
            return False
        wanted = f"/{self.server.token}/{name}"
        if not secrets.compare_digest(self.path.encode("utf-8", "replace"), wanted.encode()):
            self._say(HTTPStatus.NOT_FOUND, "There is nothing here: open the address that the computer shows.")
            return False
        return True

    def _say(self, status: HTTPStatus, sentence: str) -> None:
        self._answer(status, sentence.encode(), "text/plain; charset=utf-8")

    def _answer(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Frame-Options", "DENY")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing per request."""


def open_server(host: str, port: int, folder: Path, said: Callable[[str], None]) -> TabletServer:
    """Return a server that listens but does not serve yet; port 0 takes any free one.

    Raises:
        InputError: the port is in use or not allowed, or the host is not an IP address of this machine.
    """
    host = own_address(host)
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


def tablet_host(host: str) -> str:
    """Return the address of this machine to open on the tablet, for a server that listens on `host`."""
    if not ipaddress.ip_address(host).is_unspecified:
        return host
    return network_address()


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def run_server(host: str, port: int, folder: Path, said: Callable[[str], None]) -> None:
    """Serve until interrupted; reports the address and every received file."""
    with open_server(host, port, folder, said) as server:
        bound = str(server.server_address[0])
        said(f"Open {server.address(tablet_host(bound))} on the tablet. Stop with Ctrl+C.")
        if is_loopback(bound):
            said("Only this machine can reach it. For a tablet in the network give --host 0.0.0.0.")
        try:
            server.serve_forever(poll_interval=0.1)
        except KeyboardInterrupt:
            said("Stopped.")
