"""The world's streaming scanner: its process, which renders, and its end in the world, which times the frames."""

import contextlib
import signal
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.rendered_scanner import TrueScanner, darkness
from weldcal.systems.drivers.simulated.streaming_scanner import StreamingScanner, exposed_cloud
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.emulators.cell.physics import STEP_S, still, true_station
from weldcal.tools.emulators.cell.scanner_process import drop

LIMIT_S = 2.0  # of the host; a cell that follows the world takes a longer silence for a broken link
KEPT = 40  # files; the program of a scanner that nobody reads does not fill the disk
IDLE_S = 0.5  # between frames while no program runs on the controller: nobody looks closely


class Waiter:
    """The world's end of the pipe of a device that says something when it has shown what it was sent."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._unshown = self._gone = False

    def send(self, datum: object) -> None:
        """Send once the last datum is shown.

        A device that does not answer misses this one, and is not waited for until it does.
        """
        with contextlib.suppress(OSError, EOFError):
            if self._unshown and self._pipe.poll(0.0 if self._gone else LIMIT_S):
                self._pipe.recv()
                self._unshown = self._gone = False
            if self._unshown:
                self._gone = True
                return
            self._pipe.send(datum)
            self._unshown = True


@dataclass(frozen=True)
class StreamSetup:
    """What the process is started with. It writes into `folder`."""

    scenario: str  # of the world, by name or path
    arm: ArmModel
    seed: int
    folder: Path


@dataclass(frozen=True, eq=False)
class Exposure:
    """Frame `number`: the plant's positions at its instants, its times (s), and whether the stand was moved before."""

    number: int
    instants: tuple[Array, ...]
    unix_s: float  # of the capture, by the host's clock
    device_s: float  # by the scanner's own
    knocked: bool


class FrameRenderer:
    """A copy of the world that is posed as the world was in each instant of an exposure."""

    def __init__(self, setup: StreamSetup) -> None:
        scenario = load_scenario(setup.scenario)
        if not isinstance(scenario.scanner, StreamingScanner):
            raise InputError("A cell whose scanner streams needs a world with scanner: !StreamingScanner {}.")
        self._config, self._seed = scenario.scanner, setup.seed
        self._station = true_station(scenario, setup.arm, setup.seed)
        truth, world = self._station.truth, self._station.world
        assert isinstance(truth.scanner, TrueScanner)
        assert world is not None
        self._device, self._plant = truth.scanner.device, world.plant
        _, self._context = still(self._station, self._station.q_start)
        sensor = self._station.diagram.GetSubsystemByName("scanner_depth")
        self._depth, self._colour = sensor.depth_image_32F_output_port(), sensor.color_image_output_port()
        self._sensor_context = sensor.GetMyContextFromRoot(self._context)

    def cloud(self, it: Exposure) -> NDArray[np.float32]:
        """Return the organised cloud (H, W, 3) m, float32."""
        # the stand jumps at a time of the copy's context
        knock_s = self._config.knock_s
        self._context.SetTime(0.0 if knock_s is None else knock_s + (1.0 if it.knocked else -1.0))
        depths, dark = [], None
        for k, positions in enumerate(it.instants):
            self._plant.SetPositions(self._plant.GetMyMutableContextFromRoot(self._context), positions)
            depths.append(np.array(self._depth.Eval(self._sensor_context).data[:, :, 0]))
            if k == len(it.instants) // 2:
                rgb = np.asarray(self._colour.Eval(self._sensor_context).data[:, :, :3], dtype=np.float32)
                dark = darkness(rgb)
        rng = np.random.default_rng([self._seed, 31, it.number])
        return exposed_cloud(self._device, depths, dark, rng)


def run_stream(setup: StreamSetup, world: Connection) -> None:
    """Serve until the world closes its end of the pipe.

    It sends an Exposure when its frame is to arrive, and is told when it is there.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    renderer = FrameRenderer(setup)
    written: list[Path] = []
    with contextlib.suppress(EOFError, OSError):
        world.send("ready")
        while True:
            it: Exposure = world.recv()
            note = {"capture_time": it.unix_s, "device_time": it.device_s}
            written.append(drop(setup.folder, it.number, renderer.cloud(it), note))
            for old in written[:-KEPT]:
                old.unlink(missing_ok=True)
                old.with_suffix(".json").unlink(missing_ok=True)
            del written[:-KEPT]
            world.send("shown")


class Streamer:
    """Exposes frames at the scanner's rate and hands each on when its delay is over."""

    def __init__(self, config: StreamingScanner, seed: int, pipe: Connection, unix_now: Callable[[], float]) -> None:
        self._timing, self._waiter, self._unix_now = config.stream(), Waiter(pipe), unix_now
        self._samples = config.exposure_samples
        self._spacing = max(1, round(self._timing.exposure_s / self._samples / STEP_S))
        self._rng = np.random.default_rng([seed, 32])
        self._instants: list[Array] = []
        self._next_frame, self._number = 1, 0  # the world counts its frames from 1
        self._unix_s = 0.0
        self._underway: deque[tuple[float, Exposure]] = deque()
        self._knock_s = config.knock_s
        self.knocked_at_s: float | None = None

    def knock(self, now: float) -> None:
        """Displace the scanner's stand at `now`, s of the world.

        Raises InputError where the world's scenario has no such stand.
        """
        if self._knock_s is None:
            raise InputError(
                "The scanner's stand cannot be displaced: write scanner.knock_s and knock_mm in the world's scenario."
            )
        self.knocked_at_s = now if self.knocked_at_s is None else self.knocked_at_s

    def step(self, frame: int, positions: Callable[[], Array], busy: bool) -> None:
        """One frame of the world; `busy`: a program runs on the controller."""
        if frame >= self._next_frame + len(self._instants) * self._spacing:
            if len(self._instants) == self._samples // 2:
                self._unix_s = self._unix_now()
            self._instants.append(positions())
            if len(self._instants) == self._samples:
                self._expose(frame, busy)
        while self._underway and frame * STEP_S >= self._underway[0][0]:
            self._waiter.send(self._underway.popleft()[1])  # no frame is late by more than this computer

    def truth(self) -> dict[str, object]:
        """Return the scanner's clock, its reading (s) at the world's time 0, its rate, and when its stand was moved."""
        t = self._timing
        clock = {"at_0_s": t.device_epoch_s, "rate": 1.0 + 1e-6 * t.device_drift_ppm}
        return {"scanner_clock": clock, "knocked_at_s": self.knocked_at_s}

    def _expose(self, frame: int, busy: bool) -> None:
        capture = (frame - 0.5 * (self._samples - 1) * self._spacing) * STEP_S
        self._number += 1
        if self._knock_s is not None and self.knocked_at_s is None and capture >= self._knock_s:
            self.knocked_at_s = self._knock_s
        device = self._timing.device_time(capture, self._rng)
        exposure = Exposure(self._number, tuple(self._instants), self._unix_s, device, self.knocked_at_s is not None)
        arrival = capture + self._timing.delay(self._rng)
        self._underway.append((max(arrival, self._underway[-1][0]) if self._underway else arrival, exposure))
        self._instants = []
        self._next_frame += max(round(max(self._timing.period_s, 0.0 if busy else IDLE_S) / STEP_S), 1)
