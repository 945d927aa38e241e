"""A straight groove played by `weldcal emulate-cell` in processes of its own, with a cell that welds it by wire."""

import contextlib
import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.models.errors import InputError, WeldcalError
from weldcal.systems.scenario.loading import SCENARIO_FOLDER
from weldcal.tools.emulators.ur.process import CONTROL_PORT, Emulator

DELAY_S = 2.0
LOOK_S = 0.02
BLOCK = 65_536
SEED = 12


class Bridge:
    """A port that a cell connects to, and the device's own port behind it; one client at a time."""

    def __init__(
        self, listen: tuple[str, int], device: tuple[str, int], now: Callable[[], float] = time.monotonic
    ) -> None:
        self.how, self._now = "", now
        self._listen, self._device = listen, device
        self._server: socket.socket | None = None
        self._hear()
        self._ends = threading.Event()
        self._rng = np.random.default_rng(SEED)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ends.set()
        self._thread.join()
        self._be_deaf()

    def _serve(self) -> None:
        while not self._ends.is_set():
            if self.how == "killed":  # nobody listens any more
                self._be_deaf()
                self._ends.wait(LOOK_S)
                continue
            # what either side does to its connection, or a world that ends
            with contextlib.suppress(OSError, InputError):
                client, _ = self._hear().accept()
                with client, socket.create_connection(self._device, 5.0) as device:
                    self._pass_on(client, device)

    def _hear(self) -> socket.socket:
        if self._server is None:
            self._server = socket.create_server(self._listen)
            self._server.settimeout(LOOK_S)
        return self._server

    def _be_deaf(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None

    def _pass_on(self, client: socket.socket, device: socket.socket) -> None:
        """Carry bytes to and fro until a side closes or the bridge is killed."""
        kept: deque[tuple[float, bool, bytes]] = deque()  # when it is passed on, whether to the client, what
        while not self._ends.is_set() and self.how != "killed":
            for side in select.select([client, device], [], [], LOOK_S)[0]:
                data = side.recv(BLOCK)
                if not data:
                    return
                delayed = self.how == "delayed" and side is device
                kept.append((self._now() + DELAY_S if delayed else 0.0, side is device, data))
            while kept and self.how != "frozen" and (kept[0][0] == 0.0 or kept[0][0] <= self._now()):
                _, up, data = kept.popleft()
                if up:
                    self._up(client, data)
                else:
                    device.sendall(data)

    def _up(self, client: socket.socket, data: bytes) -> None:
        client.sendall(self._rng.bytes(len(data)) if self.how == "garbage" else data)


class PictureBridge(Bridge):
    """Of an MJPEG stream: garbage is random bytes in place of the stream's."""


class ScannerBridge(Bridge):
    """Of a scanner's trigger and of the folder into which it writes: garbage is a cloud of random bytes."""

    def __init__(
        self,
        listen: tuple[str, int],
        device: tuple[str, int],
        written: Path,
        read: Path,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._written, self._read = written, read
        super().__init__(listen, device, now)

    def _up(self, client: socket.socket, data: bytes) -> None:
        for suffix in (".json", ".npz"):  # the note first, as the scanner does
            for path in sorted(self._written.glob(f"[!.]*{suffix}")):
                if suffix == ".npz" and self.how == "garbage":
                    path.write_bytes(self._rng.bytes(20_000))
                os.replace(path, self._read / path.name)
        client.sendall(data)


PLAYED_HOST, PLAYED_SCANS = "127.30.0.1", "/tmp/weldcal-cell/scans"
CELL = "wired_straight_groove"
TRIGGER_PORT, STREAM_PORT, BRIDGED = 5020, 8081, 100  # a bridge's port is so much above its device's
X_BC = "{xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}"
WELD_ONLY = "job: {{calibrate: false, X_BC: {X_BC}}}\nwelding: {{seam_length_mm: {seam_mm}}}\n"
WORLD = """\
description: A straight groove whose scanner stands where the drawing has it.
robot: !SimulatedUr {}
scanner: !RenderedScanner
  {preset: ideal, mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0, width: 824, height: 616}
finger_camera: !RenderedFingerCamera {}
workpiece:
  shape: straight
  pose_guess: {xyz_m: [0.65, 0.0, 0.02], rpy_deg: [0.0, 0.0, 90.0]}
  placement_error: {translation_mm: 3.0, rotation_deg: 0.5}
  groove_error: {translation_mm: 1.0, rotation_deg: 0.2}
home_deg: [190.0, -120.0, 135.0, -105.0, -90.0, 90.0]
"""


PLAYED_PIXELS, SMALL_PIXELS = "width: 824, height: 616", "width: 412, height: 308"
SOON = (  # small scans, and what a bridged cell allows for one, s of the world
    ("scan_timeout_s: 60.0", "scan_timeout_s: 2.0"),
    ("width: 824\n  height: 616", "width: 412\n  height: 308"),
)


class NoWorld(WeldcalError):
    """The process that plays the world has not begun."""


@dataclass(frozen=True)
class Played:
    """`weldcal emulate-cell` in a process of its own: that process, those of its devices, and the file of its truth."""

    process: subprocess.Popen[str]
    children: list[int]
    truth_file: Path

    def truth(self) -> dict[str, Any]:
        """Return the contents of the truth file."""
        found: dict[str, Any] = json.loads(self.truth_file.read_text(encoding="utf-8"))
        return found


@dataclass(frozen=True)
class WiredWorld(Played):
    """A running world with its address, the cell's scenario file and the bridges to its devices."""

    host: str
    cell: Path
    bridges: Mapping[str, Bridge]

    @property
    def scanner(self) -> int:
        """The process of the scanner."""
        return self.children[0]

    @property
    def finger(self) -> int:
        """The process of the finger camera."""
        return self.children[-1]

    @contextmanager
    def control(self) -> Iterator[Emulator]:
        """A connection to the controller's control channel, for one thread."""
        with _controller(self.process, self.host) as emulator:
            yield emulator

    def ask(self, **request: Any) -> dict[str, Any]:
        """One request to the controller's control channel."""
        with self.control() as controller:
            return controller.ask(**request)


@contextmanager
def played_world(folder: Path, world: str, wires: str, seed: int) -> Iterator[Played]:
    """Play a world, the text of a scenario, behind the wires of a cell's scenario for the duration of the block.

    Raises:
        NoWorld: it has not begun.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: folder / name for name in ("wires.yaml", "world.yaml", "truth.json", "log")}
    paths["wires.yaml"].write_text(wires, encoding="utf-8")
    paths["world.yaml"].write_text(world, encoding="utf-8")
    command = [sys.executable, "-P", "-m", "weldcal.tools", "emulate-cell", "--scenario", str(paths["world.yaml"])]
    command += ["--cell", str(paths["wires.yaml"]), "--seed", str(seed), "--truth", str(paths["truth.json"])]
    command += ["--parent", str(os.getpid())]
    with paths["log"].open("w") as log:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True)
    children: list[int] = []
    with contextlib.ExitStack() as stack:
        stack.callback(_end, process, children)
        line = process.stdout.readline() if process.stdout is not None else ""
        children += [int(pid) for pid in re.findall(r"process (\d+)", line)]
        if not children:
            words = line + paths["log"].read_text(encoding="utf-8")
            raise NoWorld(f"The world in '{folder}' has not begun: {words.strip() or 'it ended without a word'}")
        yield Played(process, children, paths["truth.json"])


@contextmanager
def wired_world(folder: Path, host: str, seed: int, seam_mm: float, *, bridged: bool = False) -> Iterator[WiredWorld]:
    """Play the world at a loopback address for the duration of the block.

    `bridged`: scanner and camera through bridges, with small scans and a short limit for each.

    Raises:
        NoWorld: it has not begun.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cell = folder / "cell.yaml"
    scans, passed = folder / "scans", folder / "passed"
    text = (SCENARIO_FOLDER / f"{CELL}.yaml").read_text(encoding="utf-8")
    text = text.replace("pace: 0.5", "pace: 1.0") + WELD_ONLY.format(X_BC=X_BC, seam_mm=seam_mm)
    text = text.replace(PLAYED_HOST, host)
    wires = text.replace(PLAYED_SCANS, str(scans))
    if bridged:
        passed.mkdir(exist_ok=True)
        for port in (TRIGGER_PORT, STREAM_PORT):
            text = text.replace(f"{host}:{port}", f"{host}:{port + BRIDGED}")
        for usual, soon in SOON:
            text = text.replace(usual, soon)
    cell.write_text(text.replace(PLAYED_SCANS, str(passed if bridged else scans)), encoding="utf-8")
    small = WORLD.replace(PLAYED_PIXELS, SMALL_PIXELS)
    with contextlib.ExitStack() as stack:
        played = stack.enter_context(played_world(folder, small if bridged else WORLD, wires, seed))
        bridges: dict[str, Bridge] = {}
        if bridged:
            trigger, stream = (host, TRIGGER_PORT), (host, STREAM_PORT)
            clocks = [stack.enter_context(_controller(played.process, host)) for _ in range(2)]  # one for each thread
            trigger_clock, stream_clock = (
                lambda clock=clock: float(clock.ask(ask="time")["timestamp"]) for clock in clocks
            )
            bridges["scanner"] = ScannerBridge((host, TRIGGER_PORT + BRIDGED), trigger, scans, passed, trigger_clock)
            bridges["finger camera"] = PictureBridge((host, STREAM_PORT + BRIDGED), stream, stream_clock)
            for bridge in bridges.values():
                stack.callback(bridge.close)
        yield WiredWorld(played.process, played.children, played.truth_file, host, cell, bridges)


@contextmanager
def _controller(process: subprocess.Popen[str], host: str) -> Iterator[Emulator]:
    emulator = Emulator(process, host, CONTROL_PORT)
    try:
        yield emulator
    finally:
        emulator.leave()


def _end(process: subprocess.Popen[str], children: list[int]) -> None:
    for pid in children:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(10.0)
    process.kill()
    process.wait()
