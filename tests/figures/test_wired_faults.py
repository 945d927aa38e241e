"""What stands between a cell and its devices in the studies by wire does what wires and devices do."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.figures.robot.wired import FLAT_MB_H, grows, growth
from tests.worlds.robot.played import Bridge, PictureBridge, ScannerBridge
from tests.worlds.robot.wired_job import DEVICES, FAULTS, PHASES, Happening
from weldcal.tools.emulators.cell.wires import DELAY_S, InputWire

HOST = "127.0.0.1"


@contextlib.contextmanager
def echo() -> Iterator[tuple[str, int]]:
    """A device that answers each line with the same line."""
    with socket.create_server((HOST, 0)) as server:

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    client, _ = server.accept()
                    threading.Thread(target=answer, args=(client,), daemon=True).start()

        def answer(client: socket.socket) -> None:
            with client, contextlib.suppress(OSError):
                while data := client.recv(1000):
                    client.sendall(data)

        threading.Thread(target=serve, daemon=True).start()
        yield server.getsockname()
        server.shutdown(socket.SHUT_RDWR)


def free_port() -> int:
    with socket.create_server((HOST, 0)) as server:
        return int(server.getsockname()[1])


def told(bridge: Bridge, client: socket.socket, line: bytes, within_s: float) -> bytes:
    """What comes back for a line; nothing where nothing comes in time or the connection ends."""
    client.settimeout(within_s)
    try:
        client.sendall(line)
        return client.recv(1000)
    except OSError:
        return b""


def test_a_bridge_passes_on_or_does_what_its_fault_says() -> None:
    port = free_port()
    with echo() as device, contextlib.closing(PictureBridge((HOST, port), device)) as bridge:
        with socket.create_connection((HOST, port)) as client:
            assert told(bridge, client, b"right", 5.0) == b"right"
            bridge.how = "garbage"
            assert told(bridge, client, b"right", 5.0) not in (b"right", b"")
            bridge.how = "delayed"
            begun = time.monotonic()
            assert told(bridge, client, b"late", 5.0) == b"late"
            assert time.monotonic() - begun >= 2.0
            bridge.how = "frozen"
            assert told(bridge, client, b"kept", 0.3) == b""
            bridge.how = "killed"
            assert client.recv(10) == b""
        time.sleep(0.1)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((HOST, port)).close()
        bridge.how = ""
        time.sleep(0.1)
        with socket.create_connection((HOST, port)) as client:
            assert told(bridge, client, b"again", 5.0) == b"again"


def test_a_scan_is_in_its_folder_before_its_answer_comes(tmp_path: Path) -> None:
    written, read, port = tmp_path / "written", tmp_path / "read", free_port()
    written.mkdir()
    read.mkdir()
    with (
        echo() as device,
        contextlib.closing(ScannerBridge((HOST, port), device, written, read)) as bridge,
        socket.create_connection((HOST, port)) as client,
    ):
        for how in ("", "garbage"):
            bridge.how = how
            np.savez(written / "scan_1.npz", points=np.ones((4, 3)))
            (written / "scan_1.json").write_text("{}")
            assert told(bridge, client, b"ok 1\n", 5.0) == b"ok 1\n"
            assert sorted(path.name for path in read.iterdir()) == ["scan_1.json", "scan_1.npz"]
            if not how:
                with np.load(read / "scan_1.npz") as found:
                    assert found["points"].shape == (4, 3)
    assert (read / "scan_1.npz").read_bytes()[:2] != b"PK"


def readings(how: str, wrong_at: float) -> list[tuple[float, bool]]:
    """When the arc's input reads what, of an arc that burns from 1 s to 6 s."""
    wire = InputWire()
    found = []
    for k in range(5000):
        now = 0.002 * k
        wire.how = how if now >= wrong_at else ""
        found.append((now, wire.step(now, 1.0 <= now < 6.0, False)[0]))
    return found


@pytest.mark.parametrize(
    ("how", "on"),
    [("", (1.0, 6.0)), ("killed", (1.0, 3.0)), ("frozen", (1.0, 10.0)), ("delayed", (1.0, 6.0 + DELAY_S))],
)
def test_an_input_reads_as_its_wire_lets_it(how: str, on: tuple[float, float]) -> None:
    lit = [now for now, value in readings(how, 3.0) if value]
    assert (min(lit), max(lit)) == pytest.approx(on, abs=0.004)


def test_a_noisy_input_changes_often() -> None:
    values = [value for now, value in readings("garbage", 3.0) if now >= 3.0]
    assert sum(a != b for a, b in itertools.pairwise(values)) > 100


def test_a_fault_may_pass_only_where_no_signal_differs() -> None:
    silent = {(d, f, p) for d in DEVICES for f in FAULTS for p in PHASES if Happening(d, f, p).silent}
    scanner = {("scanner", f, p) for f in ("frozen", "delayed", "garbage") for p in ("approach", "feel", "weld")}
    assert silent == scanner | {("digital inputs", f, "calibrate") for f in ("killed", "frozen", "delayed")}


def test_memory_that_grows_is_told_from_memory_that_does_not() -> None:
    hours, rng = np.linspace(0.0, 1.0, 40), np.random.default_rng(3)
    noise = 5.0 * rng.standard_normal(40)
    assert growth(hours, 400.0 + noise)["flat"] is True
    leak = growth(hours, 400.0 + 100.0 * hours + noise)
    assert leak["flat"] is False
    assert leak["low"] is not None
    assert leak["low"] > FLAT_MB_H
    assert leak["mb_per_h"] == pytest.approx(100.0, abs=12.0)
    assert growth(hours[:4], noise[:4])["flat"] is None
    # three minutes in which each cycle loads a megabyte more say nothing of the hours
    assert growth(0.05 * hours, 400.0 + 20.0 * hours)["flat"] is None


def test_memory_that_grows_until_the_longest_job_has_run_is_flat_from_then_on() -> None:
    hours = np.linspace(0.0, 1.0, 60)
    assert growth(hours, 400.0 + 150.0 * np.minimum(hours, 0.3))["flat"] is True
    assert growth(hours, 400.0 + 150.0 * np.maximum(hours, 0.5))["flat"] is False


def test_the_cell_is_judged_by_what_it_uses_and_not_by_the_gaps_that_its_library_keeps() -> None:
    level, rises, unknown = {"flat": True}, {"flat": False}, {"flat": None}
    others = {"world": level, "scanner": level, "finger": level}
    assert grows({"cell": rises, **others, "in_use": level}) == []
    assert grows({"cell": rises, **others, "in_use": rises}) == ["in_use"]
    assert grows({"cell": rises, **others, "in_use": unknown}) == ["cell"], "another library than GNU's"
    assert grows({"cell": level, **others, "world": rises, "in_use": level}) == ["world"]
