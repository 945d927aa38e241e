"""Process of the world's streaming scanner: renders each exposure and drops a cloud with the time of the scanner's own
clock."""

import contextlib
import signal
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.rendered_scanner import TrueScanner, darkness
from weldcal.systems.drivers.simulated.streaming.scanner import StreamingScanner, exposed_cloud
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.emulators.cell.physics import still, true_station
from weldcal.tools.emulators.cell.scanner_process import drop

KEPT = 40  # files; the program of a scanner that nobody reads does not fill the disk


@dataclass(frozen=True)
class StreamSetup:
    """What the process is started with. It writes into `folder`."""

    scenario: str  # of the world, by name or path
    arm: ArmModel
    seed: int
    folder: Path


@dataclass(frozen=True, eq=False)
class Exposure:
    """Frame `number`: the plant's positions at the instants of its exposure, its times (s), and whether the stand was
    knocked before."""

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
        """The organised cloud (H, W, 3) m, float32."""
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
    """Serve until the world closes its end of the pipe; it sends an Exposure when its frame is to arrive, and is told
    when it is there."""
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
