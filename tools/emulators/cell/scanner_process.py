"""The world's triggered scanner: its process, which renders and drops files, and its end in the world."""

import contextlib
import json
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.systems.messages import ProfileScan, Scan
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.emulators.cell.physics import still, true_station

POSE, DONE = "pose", "done"  # what the scanner says: it exposes now; its file lies in the folder
SCAN_S = 0.5  # of the world, from the exposure to the file, at most
# of the host in each frame: the world goes on slowly, and a cell that follows it sees no broken link
FRAME_WAITS_S = 0.05
LIMIT_S = 20.0  # of the host for one scan; a scanner that has stopped is not waited for any longer
EXPOSED_S = 0.3  # of the copy's time: a little longer than the scanner's exposure
PROFILED_S = 0.03  # of the copy's time, for a profiler
SCANNER, PROFILER = "scanner", "profiler"
CLOUD = 3  # columns of a cloud; a profile has two
POSE_LIMIT_S = 30.0
LONGEST_LINE = 4096


class Scans:
    """Answers the scanner, and slows the world down while a scan takes longer than SCAN_S of its time on this computer.

    Args:
        pipe: to the scanner's process.
        standing: what the scanner is told: (Unix time s, plant positions).
    """

    def __init__(self, pipe: Connection, standing: Callable[[], object]) -> None:
        self._pipe, self._standing = pipe, standing
        self._begun_s: float | None = None  # the world's time of the newest exposure, while its file is not there
        self._waited_s = 0.0

    def answer(self, time_s: float) -> None:
        """Take what the scanner has sent by this time of the world (s). Never waits."""
        with contextlib.suppress(OSError, EOFError):
            while self._pipe.poll(0.0):
                if self._pipe.recv() == POSE:
                    self._pipe.send(self._standing())
                    self._begun_s, self._waited_s = time_s, 0.0
                else:
                    self._begun_s = None

    def step(self, time_s: float) -> None:
        """Answer in a frame of the world at this time (s), and wait where a scan is late."""
        self.answer(time_s)
        if self._begun_s is None or time_s - self._begun_s < SCAN_S or self._waited_s > LIMIT_S:
            return
        begun = time.monotonic()
        with contextlib.suppress(OSError, EOFError):
            self._pipe.poll(FRAME_WAITS_S)
        self._waited_s += time.monotonic() - begun
        self.answer(time_s)


@dataclass(frozen=True, kw_only=True)
class ScannerSetup:
    """What the scanner's process is started with. It listens at `host`:`port` and writes into `folder`."""

    scenario: str  # of the world, by name or path
    arm: ArmModel
    seed: int
    host: str
    port: int
    folder: Path
    device: str = SCANNER  # or PROFILER


class Renderer:
    """A copy of the world that is posed as the world is when the scanner is triggered."""

    def __init__(self, setup: ScannerSetup) -> None:
        self._device = setup.device
        self._station = true_station(load_scenario(setup.scenario), setup.arm, setup.seed)
        assert self._station.world is not None
        self._world = self._station.world
        self._scans = 0

    def scan(self, positions: Array) -> Array:
        """Return the organised cloud (H, W, 3) m, float32, of a world with these positions of its plant, at rest.

        A profile is (n, 2) m.
        """
        self._scans += 1
        plant = self._world.plant
        simulator, context = still(self._station, positions[:6])
        plant.SetPositions(plant.GetMyContextFromRoot(context), positions)
        diagram = self._station.diagram
        diagram.GetInputPort("arm.desired_state").FixValue(context, np.concatenate([positions[:6], np.zeros(6)]))
        diagram.GetInputPort(f"{self._device}.trigger").FixValue(context, float(self._scans))
        simulator.AdvanceTo(EXPOSED_S if self._device == SCANNER else PROFILED_S)
        if self._device == PROFILER:
            profile: ProfileScan = diagram.GetOutputPort("profiler.profile").Eval(context)
            return np.asarray(profile.points)
        found: Scan = diagram.GetOutputPort("scanner.scan").Eval(context)
        if not found.sequence:
            raise RuntimeError("the scanner made no scan within its exposure")
        return np.asarray(found.points_C, dtype=np.float32)


def drop(folder: Path, number: int, points: NDArray[Any], note: Mapping[str, float]) -> Path:
    """Write a cloud as a program of a real scanner should.

    The note first, then the cloud under another name, then its name.
    """
    name, suffix = f"scan_{number:04d}", ".npz" if points.shape[-1] == CLOUD else ".npy"
    hidden, path = folder / f".{name}.json.tmp", folder / f"{name}.json"
    hidden.write_text(json.dumps(note), encoding="ascii")
    os.replace(hidden, path)
    hidden, path = folder / f".{name}{suffix}.tmp", folder / f"{name}{suffix}"
    with hidden.open("wb") as file:
        if points.shape[-1] == CLOUD:
            np.savez(file, points=points)
        else:
            np.save(file, points)
    os.replace(hidden, path)
    return path


def run_scanner(setup: ScannerSetup, world: Connection) -> None:
    """Serve until the world closes its end of the pipe. `world` answers POSE with (Unix time s, plant positions)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    renderer = Renderer(setup)
    with socket.create_server((setup.host, setup.port)) as server, contextlib.suppress(EOFError, OSError):
        world.send("ready")
        server.settimeout(0.2)
        numbers = iter(range(1, 1_000_000))
        while True:
            with contextlib.suppress(TimeoutError):
                client, _ = server.accept()
                with client:
                    _serve(client, renderer, setup.folder, world, numbers)
            _still_there(world)


def _serve(client: socket.socket, renderer: Renderer, folder: Path, world: Connection, numbers: Iterator[int]) -> None:
    """Answer the lines of one client until it leaves.

    `ok N` when the scan of `scan N` lies in the folder, or `error TEXT`.
    """
    client.settimeout(0.2)
    unread = b""
    while True:
        try:
            found = client.recv(LONGEST_LINE)
        except TimeoutError:
            _still_there(world)
            continue
        except OSError:
            return
        if not found:
            return
        *lines, unread = (unread + found).split(b"\n")
        unread = unread[-LONGEST_LINE:]
        for line in lines:
            answer = _answer(line.decode("ascii", "replace").strip(), renderer, folder, world, next(numbers))
            try:
                client.sendall(answer.encode("ascii") + b"\n")
            except OSError:
                return


def _answer(line: str, renderer: Renderer, folder: Path, world: Connection, number: int) -> str:
    word, _, request = line.partition(" ")
    if word != "scan" or not request.isdigit():
        return "error send: scan N"
    world.send(POSE)
    if not world.poll(POSE_LIMIT_S):
        return "error the world stands still"
    taken, positions = world.recv()
    drop(folder, number, renderer.scan(positions), {"capture_time": taken, "request": int(request)})
    world.send(DONE)
    return f"ok {request}"


def _still_there(world: Connection) -> None:
    """Raise EOFError where the world has ended."""
    if world.poll(0.0):
        world.recv()
