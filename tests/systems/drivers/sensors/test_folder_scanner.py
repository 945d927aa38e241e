"""Clouds that another program drops into a folder: whole ones only, those that were asked for, with the time they were
taken."""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.systems.drivers.sensors.scripted import wait_until
from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import Acquisition, DeviceFault
from weldcal.systems.drivers.sensors.folder_scanner import FolderScanner
from weldcal.systems.drivers.sensors.folder_source import KEEP_ALIVE, LISTING_SHARE, FolderSource, NewFiles, TcpTrigger
from weldcal.systems.drivers.sensors.wired_scanner import Cloud, acquire

Start = Callable[..., Acquisition[Cloud]]


def cloud(number: int, shape: tuple[int, ...] = (12, 16)) -> np.ndarray:
    """A plane at a distance that tells its number, in m."""
    points = np.zeros((*shape, 3))
    points[..., 0] = np.linspace(-0.1, 0.1, points[..., 0].size).reshape(shape)
    points[..., 2] = 0.6 + 0.01 * number
    return points


def drop(folder: Path, name: str, points: np.ndarray, **beside: object) -> Path:
    """As a careful program writes: the sidecar first, then the cloud under another name, then the rename."""
    if beside:
        (folder / name).with_suffix(".json").write_text(json.dumps(beside))
    unfinished = folder / f".{name}.tmp"
    with unfinished.open("wb") as file:
        np.savez(file, points=points)
    os.replace(unfinished, folder / name)
    return folder / name


def number_of(points: np.ndarray) -> int:
    return round((float(np.nanmedian(points[..., 2])) - 0.6) / 0.01)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    running = []

    def begin(wait_s: float = 2.0, **keys: object) -> Acquisition[Cloud]:
        config = FolderScanner(**{"folder": str(tmp_path), "settle_s": 0.05, "scan_timeout_s": 10.0, **keys})
        acquisition = acquire(config, config.source())
        acquisition.start(wait_s, first_frame=False)
        running.append(acquisition)
        return acquisition

    yield begin
    for acquisition in running:
        acquisition.close()


def answer(acquisition: Acquisition[Cloud], number: int) -> Cloud:
    assert wait_until(lambda: acquisition.answer(number) is not None, 10.0), acquisition.fault(time.monotonic())
    found = acquisition.answer(number)
    assert found is not None
    return found.datum


def test_a_file_that_comes_after_the_request_answers_it(start: Start, tmp_path: Path) -> None:
    drop(tmp_path, "old.npz", cloud(7))
    scanner = start()
    scanner.request(1)
    time.sleep(0.15)
    assert scanner.answer(1) is None  # what was there before is no answer
    drop(tmp_path, "a.npz", cloud(1))
    assert number_of(answer(scanner, 1)) == 1
    scanner.request(2)
    time.sleep(0.1)
    assert scanner.answer(2) is None
    drop(tmp_path, "a.npz", cloud(2))  # a program may write the same name again and again
    points = answer(scanner, 2)
    assert number_of(points) == 2
    assert (points.shape, points.dtype) == ((12, 16, 3), np.float32)


def test_a_folder_that_takes_long_to_list_is_listed_a_tenth_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listings, complete = [], NewFiles.complete

    def slow(files: NewFiles) -> list[Path]:
        listings.append(time.monotonic())
        time.sleep(0.01)
        return complete(files)

    monkeypatch.setattr(NewFiles, "complete", slow)
    source = FolderSource(
        name="scanner",
        folder=str(tmp_path),
        trigger="",
        suffixes=(".npz",),
        read=Path.read_bytes,
        settle_s=0.0,
        remove_read=False,
    )
    source.open()
    while len(listings) < 5:
        assert source.next(0.02) is None
    assert np.diff(listings).min() >= 0.01 / LISTING_SHARE
    path = drop(tmp_path, "new.npz", cloud(1))
    found = next(filter(None, (source.next(0.02) for _ in range(100))))
    assert found.datum == path.read_bytes()


def test_a_file_is_taken_only_when_it_is_whole(start: Start, tmp_path: Path) -> None:
    whole = drop(tmp_path, "made.npz", cloud(3, (60, 80))).read_bytes()
    scanner = start()
    scanner.request(1)
    time.sleep(0.05)
    with (tmp_path / "slow.npz").open("wb", buffering=0) as file:
        for k in range(0, len(whole), len(whole) // 8):
            file.write(whole[k : k + len(whole) // 8])
            # longer than the settling time: the reader's own check must refuse it
            time.sleep(0.08)
            assert scanner.answer(1) is None or k + len(whole) // 8 >= len(whole)
    assert number_of(answer(scanner, 1)) == 3
    assert scanner.counts.garbled == 0


def test_a_text_file_that_still_grows_is_not_taken_though_its_first_half_could_be_read(
    start: Start, tmp_path: Path
) -> None:
    scanner = start(settle_s=0.3)
    scanner.request(1)
    time.sleep(0.05)
    lines = [f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in cloud(3).reshape(-1, 3)]
    with (tmp_path / "slow.xyz").open("w") as file:
        for half in (lines[:96], lines[96:]):
            file.writelines(half)
            file.flush()
            time.sleep(0.1)
    assert answer(scanner, 1).shape == (192, 3)
    assert scanner.counts.received == 1


def test_a_damaged_file_is_named_and_the_timeout_says_so(start: Start, tmp_path: Path) -> None:
    scanner = start(scan_timeout_s=2.6)
    scanner.request(1)
    (tmp_path / "bad.ply").write_bytes(b"ply\nnothing\n")
    assert wait_until(lambda: scanner.fault(time.monotonic()) is not None)
    said = scanner.fault(time.monotonic()) or ""
    assert "did not deliver scan 1 within 2.6 s" in said
    assert "bad.ply" in said
    assert scanner.counts.garbled == 1
    drop(tmp_path, "good.npz", cloud(4))
    assert number_of(answer(scanner, 1)) == 4


def test_the_time_of_the_scan_is_its_sidecars_or_that_of_its_arrival(start: Start, tmp_path: Path) -> None:
    scanner = start()
    scanner.request(1)
    time.sleep(0.05)
    taken, taken_unix = time.monotonic(), time.time()
    time.sleep(0.2)
    drop(tmp_path, "a.npz", cloud(1), capture_time=taken_unix, request=1)
    answer(scanner, 1)
    found = scanner.frames()[-1]
    assert abs(found.stamp.captured - taken) < 0.005
    assert found.stamp.clock == "host"
    assert found.note == "a.npz, time from a.json"
    scanner.request(2)
    time.sleep(0.05)
    drop(tmp_path, "b.npz", cloud(2))
    answer(scanner, 2)
    found = scanner.frames()[-1]
    assert found.stamp.captured == found.arrived
    assert (found.stamp.clock, found.note) == ("arrival", "b.npz, time from its arrival")


@pytest.mark.parametrize(
    ("beside", "said"),
    [
        ({"capture_time": 0.0}, "was captured before it was asked for"),
        ({"request": 8}, "answers the trigger 8, and the newest is 1"),
        ({"capture_time": "noon"}, "is not a JSON object with capture_time, device_time and request"),
    ],
)
def test_a_scan_of_another_time_is_refused(start: Start, tmp_path: Path, beside: dict[str, object], said: str) -> None:
    scanner = start(scan_timeout_s=1.0)
    scanner.request(1)
    time.sleep(0.05)
    drop(tmp_path, "a.npz", cloud(1), **beside)
    assert wait_until(lambda: said in (scanner.fault(time.monotonic()) or ""))
    assert scanner.answer(1) is None


@pytest.mark.parametrize("jump_s", [3600.0, -3600.0])
@pytest.mark.parametrize("at", ["before its capture", "after its capture"])
def test_a_clock_that_is_set_while_a_scan_is_taken_refuses_no_scan(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jump_s: float, at: str
) -> None:
    def set_clock(unix: Callable[[], float] = time.time) -> None:
        monkeypatch.setattr(time, "time", lambda: unix() + jump_s)

    scanner = start()
    scanner.request(1)
    time.sleep(0.05)
    if at == "before its capture":
        set_clock()
    taken, taken_unix = time.monotonic(), time.time()
    if at == "after its capture":
        set_clock()
    drop(tmp_path, "a.npz", cloud(1), capture_time=taken_unix, request=1)
    assert number_of(answer(scanner, 1)) == 1
    assert abs(scanner.frames()[-1].stamp.captured - taken) < 0.005
    assert scanner.counts.garbled == 0


def test_a_file_that_still_grows_is_not_old_because_the_clock_was_set(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scanner = start(settle_s=0.3)
    scanner.request(1)
    time.sleep(0.05)
    unix = time.time
    monkeypatch.setattr(time, "time", lambda: unix() + 3600.0)
    (tmp_path / "slow.xyz").write_text(
        "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in cloud(3).reshape(-1, 3)[:96])
    )
    time.sleep(0.1)
    assert scanner.counts.received == 0
    assert answer(scanner, 1).shape == (96, 3)


def test_a_stream_keeps_the_time_of_the_scanners_own_clock_beside_that_of_the_host(
    start: Start, tmp_path: Path
) -> None:
    scanner = start(streams=True, settle_s=0.0, remove_read=True)
    for number in (1, 2, 3):
        taken = time.time()
        drop(tmp_path, f"f{number}.npz", cloud(number), capture_time=taken, device_time=48000.0 + number)
        assert wait_until(lambda: number in [number_of(f.datum) for f in scanner.frames()])  # noqa: B023
    assert [f.device_time for f in scanner.frames()] == [48001.0, 48002.0, 48003.0]
    assert {f.stamp.clock for f in scanner.frames()} == {"host"}
    assert scanner.fault(time.monotonic()) is None
    assert wait_until(lambda: "sent nothing usable for 1 s" in (scanner.fault(time.monotonic()) or ""))


def test_points_in_another_unit_are_refused_and_read_with_the_right_one(start: Start, tmp_path: Path) -> None:
    scanner = start(scan_timeout_s=1.0)
    scanner.request(1)
    time.sleep(0.05)
    drop(tmp_path, "a.npz", 1e3 * cloud(1))
    assert wait_until(lambda: "Set scanner.unit" in (scanner.fault(time.monotonic()) or ""))
    in_mm = start(unit="mm")
    in_mm.request(1)
    time.sleep(0.05)
    drop(tmp_path, "b.npz", 1e3 * cloud(1))
    assert np.allclose(answer(in_mm, 1), cloud(1), atol=1e-6)


def test_a_folder_that_goes_is_a_lost_scanner_and_one_that_comes_back_works(start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    scanner = start(folder=str(folder))
    folder.rename(tmp_path / "away")
    assert wait_until(lambda: "is not connected" in (scanner.fault(time.monotonic()) or ""))
    assert "cannot be read" in (scanner.fault(time.monotonic()) or "") or "no folder" in (
        scanner.fault(time.monotonic()) or ""
    )
    (tmp_path / "away").rename(folder)
    assert wait_until(lambda: scanner.fault(time.monotonic()) is None)
    scanner.request(1)
    time.sleep(0.1)
    drop(folder, "a.npz", cloud(5))
    assert number_of(answer(scanner, 1)) == 5


def test_read_files_are_removed_where_the_scenario_says_so(start: Start, tmp_path: Path) -> None:
    scanner = start(remove_read=True)
    scanner.request(1)
    time.sleep(0.05)
    path = drop(tmp_path, "a.npz", cloud(1), request=1)
    answer(scanner, 1)
    assert wait_until(lambda: not path.exists() and not path.with_suffix(".json").exists())


def test_a_trigger_file_is_replaced_as_a_whole(start: Start, tmp_path: Path) -> None:
    there = tmp_path / "scan_now"
    scanner = start(trigger=f"file:{there}")
    scanner.request(1)
    assert wait_until(there.exists)
    assert there.read_text() == "scan 1\n"
    scanner.request(2)
    assert wait_until(lambda: there.read_text() == "scan 2\n")


class ScanProgram(threading.Thread):
    """Listens for the line `scan N` and writes cloud N."""

    def __init__(self, folder: Path, says: str = "") -> None:
        super().__init__(daemon=True)
        self._folder, self._says = folder, says
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.clients: list[socket.socket] = []
        self.start()

    @property
    def trigger(self) -> str:
        return f"tcp://127.0.0.1:{self.listener.getsockname()[1]}"

    def run(self) -> None:
        try:
            while True:
                client, _ = self.listener.accept()
                self.clients.append(client)
                for line in client.makefile("r"):
                    number = int(line.split()[1])
                    if self._says:
                        client.sendall(self._says.encode())
                    else:
                        drop(self._folder, f"scan_{number}.npz", cloud(number), request=number)
        except OSError:
            return

    def kill(self) -> None:
        self.listener.shutdown(socket.SHUT_RDWR)
        self.listener.close()
        for client in self.clients:
            client.shutdown(socket.SHUT_RDWR)
            client.close()


def test_a_program_is_triggered_over_tcp_and_missed_when_it_ends(start: Start, tmp_path: Path) -> None:
    program = ScanProgram(tmp_path)
    scanner = start(trigger=program.trigger)
    for number in (1, 2, 3):
        scanner.request(number)
        assert number_of(answer(scanner, number)) == number
    begin = time.monotonic()
    program.kill()
    assert wait_until(lambda: scanner.fault(time.monotonic()) is not None)
    assert time.monotonic() - begin < 1.0
    assert "is not connected: its trigger at 127.0.0.1" in (scanner.fault(time.monotonic()) or "")


def test_a_cable_that_is_pulled_between_scans_is_missed_within_seconds() -> None:
    """The kernel asks the other side; that it answers nothing any more cannot be played on one computer."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        trigger = TcpTrigger(*server.getsockname())
        trigger.open()
        try:
            asked = trigger._socket
            assert asked is not None
            assert asked.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
            idle, between, count = (asked.getsockopt(socket.IPPROTO_TCP, getattr(socket, o)) for o in KEEP_ALIVE)
            assert idle + between * count <= 5
        finally:
            trigger.close()


def test_what_the_program_says_is_in_the_fault(start: Start, tmp_path: Path) -> None:
    program = ScanProgram(tmp_path, "error the projector is too hot\n")
    scanner = start(trigger=program.trigger)
    scanner.request(1)
    assert wait_until(lambda: scanner.fault(time.monotonic()) is not None)
    assert "the program that scans says: the projector is too hot" in (scanner.fault(time.monotonic()) or "")
    program.kill()


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"folder": ""}, "Write the folder of its files in the scenario: scanner: !FolderScanner"),
        ({"trigger": "http://here"}, "must be empty, file:PATH or tcp://HOST:PORT"),
        ({"unit": "inch"}, "must be m or mm"),
        ({"scan_timeout_s": 0.0}, "scanner.scan_timeout_s must be from 0.1 to 600"),
        ({"settle_s": -1.0}, "scanner.settle_s must be from 0 to 60"),
    ],
)
def test_a_wrong_key_is_refused_before_anything_is_opened(start: Start, keys: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        start(**keys)


def test_a_missing_folder_is_a_sentence(start: Start, tmp_path: Path) -> None:
    with pytest.raises(DeviceFault, match=r"does not answer: there is no folder"):
        start(folder=str(tmp_path / "nowhere"), wait_s=0.3)
