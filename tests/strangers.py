"""What strangers do to the ports of a run: idle connections, readers that do not read, requests of foreign pages.

python -m tests.strangers [CONNECTIONS] [OPTIONS OF weldcal demo]     against a whole run, every port that it opens
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import resource
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import psutil  # type: ignore[import-untyped]

Address = tuple[str, int]


def connect(address: Address) -> socket.socket | None:
    """A connection, or None where it was refused or ended at once."""
    try:
        return socket.create_connection(address, timeout=5.0)
    except OSError:
        return None


@contextlib.contextmanager
def strangers(
    address: Address, idle: int, slow: int = 0, path: str | None = "/events"
) -> Iterator[list[socket.socket]]:
    """Idle connections, and some that ask for a stream and never read it, for the duration of the block."""
    found = [c for c in (connect(address) for _ in range(idle)) if c is not None]
    for _ in range(slow):
        if (reader := connect(address)) is not None:
            reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            with contextlib.suppress(OSError):
                if path is not None:  # a controller takes a line of text for a program
                    reader.sendall(f"GET {path} HTTP/1.1\r\nHost: {address[0]}:{address[1]}\r\n\r\n".encode())
            found.append(reader)
    try:
        yield found
    finally:
        for connection in found:
            connection.close()


def status(address: Address, path: str, method: str = "GET", **headers: str) -> int:
    """The status of an answer; 0 where the connection was ended."""
    connection = http.client.HTTPConnection(*address, timeout=5.0)
    try:
        connection.request(method, path, "{}" if method == "POST" else None, headers)
        return connection.getresponse().status
    except OSError:
        return 0
    except http.client.HTTPException:
        return 0
    finally:
        connection.close()


def key_of(address: Address) -> str:
    """The key in the page itself."""
    connection = http.client.HTTPConnection(*address, timeout=5.0)
    connection.request("GET", "/")
    text = connection.getresponse().read().decode()
    return text.split('name="weldcal-key" content="')[1].split('"')[0]


def hold_ms(address: Address, key: str) -> float:
    """How long the page takes to answer Hold, ms; infinite where it does not."""
    began = time.perf_counter()
    connection = http.client.HTTPConnection(*address, timeout=5.0)
    try:
        connection.request("POST", "/act/hold", "{}", {"X-Weldcal-Key": key, "Content-Type": "application/json"})
        answer = connection.getresponse()
        done = answer.status == 200 and "done" in json.loads(answer.read())
    except (OSError, http.client.HTTPException):
        done = False
    finally:
        connection.close()
    return 1e3 * (time.perf_counter() - began) if done else float("inf")


def ports_of(process: psutil.Process) -> dict[Address, str]:
    """Every TCP port that a process or its children listen at, with the name of the process."""
    found: dict[Address, str] = {}
    for one in [process, *process.children(recursive=True)]:
        with contextlib.suppress(psutil.Error):
            for c in one.net_connections("tcp"):
                if c.status == psutil.CONN_LISTEN:
                    host = {"0.0.0.0": "127.0.0.1", "::": "127.0.0.1", "::1": "127.0.0.1"}.get(c.laddr.ip, c.laddr.ip)
                    found[host, c.laddr.port] = " ".join(one.cmdline())[-60:]
    return found


def main(count: int, options: list[str]) -> int:
    """Attack each port of a run in turn; prints what Hold took and whether the run went on to its end."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    command = [
        "sh",
        "-c",
        'ulimit -Sn 1024; exec "$@"',
        "sh",
        sys.executable,
        "-m",
        "weldcal.tools",
        "demo",
        "--share",
        *options,
    ]
    run = subprocess.Popen(
        command, env=os.environ | {"BROWSER": "true"}, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    assert run.stderr is not None
    addresses: list[str] = []
    for line in run.stderr:
        if line.startswith(("dashboard", "read-only")):
            addresses.append(line.split()[-1])
        if line.startswith("[") and "build" not in line:
            break
    text = "".join(addresses)
    print(*addresses, sep="\n")
    said: list[str] = []
    threading.Thread(target=lambda: said.extend(run.stderr or ()), daemon=True).start()
    page = ("127.0.0.1", int(addresses[0].split(":")[2].strip("/")))
    key, token = key_of(page), text.rstrip("/").rpartition("/")[2]
    top = psutil.Process(run.pid)
    for address, owner in ports_of(top).items():
        path = None if address[0] != "127.0.0.1" else "/events" if address == page else f"/{token}/events"
        before = [hold_ms(page, key) for _ in range(5)]
        began, during = time.monotonic(), list[float]()
        flood = threading.Event()

        def often(flood: threading.Event = flood, during: list[float] = during) -> None:
            while not flood.is_set():
                during.append(hold_ms(page, key))
                time.sleep(0.01)

        watcher = threading.Thread(target=often)
        watcher.start()
        with strangers(address, count, 100, path) as found:
            took = time.monotonic() - began
            flood.set()
            watcher.join()
            after = [hold_ms(page, key) for _ in range(50)]
            foreign = None if path is None else status(address, path, Origin="http://elsewhere.example")
            job = [(p.num_fds(), p.num_threads()) for p in (top, *top.children(recursive=True))[:1]]
        with contextlib.suppress(OSError):
            status(page, "/act/go_on", "POST", **{"X-Weldcal-Key": key})
        print(
            f"{address} {owner}\n  {len(found)} connections in {took:.1f} s; Hold before"
            f" {statistics.median(before):.0f} ms, while they came median {statistics.median(during):.0f} worst"
            f" {max(during):.0f} ms ({len(during)}), then median {statistics.median(after):.0f} worst {max(after):.0f}"
            f" ms; foreign page {foreign}; job (descriptors, threads) {job}; runs {run.poll() is None}",
            flush=True,
        )
    code = run.wait()
    print("exit code", code, "load", os.getloadavg(), *said[-3:], sep="\n")
    return code


if __name__ == "__main__":
    raise SystemExit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 5000, sys.argv[2:]))
