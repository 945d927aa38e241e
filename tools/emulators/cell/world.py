"""The world process: the controller, its arm's surroundings, and the processes of scanner and finger camera."""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.addresses import loopback_address
from weldcal.systems.drivers.config import NoDevice
from weldcal.systems.drivers.sensors.folder_profiler import FolderProfiler
from weldcal.systems.drivers.sensors.folder_scanner import FolderScanner
from weldcal.systems.drivers.sensors.stamps import unix_now
from weldcal.systems.drivers.sensors.video_finger_camera import VideoFingerCamera
from weldcal.systems.drivers.simulated.rendered_finger_camera import RenderedFingerCamera
from weldcal.systems.drivers.simulated.streaming_scanner import StreamingScanner
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.drivers.ur.set_points import AnalogSetPoint
from weldcal.systems.drivers.ur.touch_probe import UrTouchProbe
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.parts import nominal_arm
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.emulators.cell.finger_process import FingerSetup, run_finger_camera
from weldcal.tools.emulators.cell.physics import STEP_S, Physics, score
from weldcal.tools.emulators.cell.scanner_process import PROFILER, SCANNER, ScannerSetup, Scans, run_scanner
from weldcal.tools.emulators.cell.streamer import Streamer, StreamSetup, Waiter, run_stream
from weldcal.tools.emulators.cell.wires import Arc, InputWire, TouchProbe
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.main import FASTEST, SLOWEST, Emulation
from weldcal.tools.emulators.ur.process import CONTROL_PORT, take_address
from weldcal.tools.emulators.ur.versions import parse_version

START_LIMIT_S = 120.0
WAITS_S = 30.0  # for a cell that is late, of the host
REST_RAD_S = 1e-3
RESTS_S = 0.2
SET_POINTS = ("wire_feed", "arc_voltage")  # keys of the cell's robot
Truth = dict[str, object]


@dataclass(frozen=True, kw_only=True)
class Wires:
    """Where the devices are, as the cell's scenario names them."""

    host: str
    pace: float
    payload_kg: float
    payload_cog_m: tuple[float, float, float]
    process_output: int | None
    arc_input: int | None
    fault_input: int | None
    folder: Path
    trigger: tuple[str, int] | None  # None: the scanner streams
    stream: tuple[str, int] | None  # None: there is no finger camera
    set_points: Mapping[str, AnalogSetPoint]
    touch_probe: UrTouchProbe | None


def wires_of(cell: Scenario) -> Wires:
    """Return the wires of a cell's scenario, all on loopback.

    Raises:
        InputError: a device of the scenario is not by wire, or not on loopback.
    """
    robot, camera = cell.robot, cell.finger_camera
    scanner = cell.profiler if isinstance(cell.scanner, NoDevice) else cell.scanner
    if not (isinstance(robot, UrRtde) and isinstance(scanner, FolderScanner | FolderProfiler)) or not isinstance(
        camera, VideoFingerCamera | NoDevice
    ):
        raise InputError(
            "The cell's scenario must have a robot !UrRtde, a scanner !FolderScanner or a profiler !FolderProfiler, and"
            " a finger_camera !VideoFingerCamera or !NoDevice, such as wired_s_groove, wired_motion or"
            " wired_profiler_edge."
        )
    streams = isinstance(scanner, FolderScanner) and scanner.streams
    trigger, stream = urlsplit(scanner.trigger), urlsplit("" if isinstance(camera, NoDevice) else camera.source)
    if (
        trigger.scheme != ("" if streams else "tcp")
        or (isinstance(camera, VideoFingerCamera) and stream.scheme != "http")
        or not scanner.folder
    ):
        raise InputError(
            "The world needs folder and trigger: tcp://HOST:PORT of scanner or profiler (or streams: true without a"
            " trigger) and finger_camera.source: http://HOST:PORT/PATH in the cell's scenario."
        )
    probe = cell.touch_probe if isinstance(cell.touch_probe, UrTouchProbe) else None
    if probe is not None:
        probe.check()
        if probe.host != robot.host:
            raise InputError(f"The world has one controller: write touch_probe.host: {robot.host}, as robot.host.")
    x, y, z = robot.payload_cog_m
    return Wires(
        host=loopback_address(robot.host),
        pace=robot.pace,
        payload_kg=robot.payload_kg,
        payload_cog_m=(x, y, z),
        process_output=robot.process_output,
        arc_input=robot.arc_input,
        fault_input=robot.arc_fault_input,
        folder=Path(scanner.folder),
        trigger=None if streams else (loopback_address(trigger.hostname or ""), trigger.port or 0),
        stream=(loopback_address(stream.hostname or ""), stream.port or 0) if stream.scheme else None,
        set_points={name: point for name in SET_POINTS if (point := getattr(robot, name)) is not None},
        touch_probe=probe,
    )


class _World:
    """What happens in each frame of the controller."""

    def __init__(
        self,
        controller: Controller,
        physics: Physics,
        wires: Wires,
        scanner: Connection,
        finger: tuple[RenderedFingerCamera, Connection] | None,
        streamer: Streamer | None,
        wanted_m: float | None,
        write: Callable[[Truth], None],
    ) -> None:
        self._controller, self._physics, self._wires = controller, physics, wires
        self._streamer, self._wanted_m, self._write = streamer, wanted_m, write
        self._scans = None if streamer is not None else Scans(scanner, lambda: (unix_now(), physics.positions()))
        self._arc, self._wire = Arc(), InputWire()
        self._probe = _probe_of(physics, wires.touch_probe)
        self._every, self._latency_s = (
            (np.inf, 0.0) if finger is None else (1.0 / finger[0].rate_hz, finger[0].latency_s)
        )
        self._next_picture = 0.0
        self._waiter = None if finger is None else Waiter(finger[1])
        self._pictures: deque[tuple[float, tuple[float, Array]]] = deque()
        self._programs = controller.script_count
        self._rests_s, self._dirty = 0.0, True
        self._given: dict[str, float] = {}
        self._given_each: list[tuple[float, ...]] = []  # at the torch's samples

    def step(self, now: float) -> None:
        """One frame of the world, after the controller's."""
        c, physics, wires = self._controller, self._physics, self._wires
        enabled = wires.process_output is not None and bool(c.terminals.digital_outputs >> wires.process_output & 1)
        burned = self._arc.burns
        shares = {name: c.terminals.analog_outputs[point.output] for name, point in wires.set_points.items()}
        self._arc.step(enabled, STEP_S, all(share > 0.0 for share in shares.values()))
        burns, fault = self._wire.step(physics.time_s, self._arc.burns, self._arc.fault)
        self._set_input(wires.arc_input, burns)
        self._set_input(wires.fault_input, fault)
        if c.script_count != self._programs:
            if not c.terminals.digital_outputs and c.program is not None and c.program.kind != "sec":
                physics.forget()
                self._given, self._given_each = {}, []
            self._programs = c.script_count
        physics.step(c.arm.q, c.arm.qd, self._arc)
        if self._probe is not None and wires.touch_probe is not None:
            self._set_input(wires.touch_probe.input, self._probe.step(physics.true_q))
        if self._arc.burns and shares:
            points = wires.set_points
            self._given = {n: p.at_zero + shares[n] * (p.at_full - p.at_zero) for n, p in points.items()}
            if physics.samples:
                self._given_each.append(tuple(round(value, 3) for value in self._given.values()))
        self._expose()
        if self._scans is not None:
            self._scans.step(physics.time_s)
        if self._streamer is not None:
            self._streamer.step(c.frame, physics.positions, c.program is not None)
        rests = float(np.abs(c.arm.qd).max()) < REST_RAD_S
        self._rests_s = self._rests_s + STEP_S if rests else 0.0
        self._dirty |= burned != self._arc.burns or not rests
        if self._dirty and ((burned and not self._arc.burns) or self._rests_s > RESTS_S):
            self.write()

    def faults(self) -> dict[str, Callable[[Mapping[str, Any], float], None]]:
        """Faults of the power source and its wires, for the control channel."""
        return {
            "arc_inputs": lambda r, now: setattr(self._wire, "how", str(r.get("how", ""))),
            "arc_fails": lambda r, now: setattr(self._arc, "fails", bool(r.get("on", True))),
            "knock": lambda r, now: self._knock(),
            "touch_probe": lambda r, now: self._break_probe(str(r.get("how", ""))),
        }

    def _break_probe(self, how: str) -> None:
        if self._probe is None:
            raise InputError("Only a cell with touch_probe: !UrTouchProbe has a probe that can fail.")
        self._probe.set_how(how)

    def _knock(self) -> None:
        if self._streamer is None:
            raise InputError("Only the stand of a scanner that streams can be displaced: use a scenario with one.")
        self._streamer.knock(self._physics.time_s)
        self.write()

    def write(self) -> None:
        """Write the truth as it is now."""
        self._dirty = False
        rests = float(np.abs(self._controller.arm.qd).max()) < REST_RAD_S
        found = score(self._physics, self._wanted_m, arc_burns=self._arc.burns, at_rest=rests)
        if self._wires.set_points:
            found |= {"set_points": self._given, "set_points_each": self._given_each}
        found |= {} if self._streamer is None else self._streamer.truth()
        if self._probe is not None:
            found["touch_probe"] = {"touches": self._probe.touches, "deepest_mm": 1e3 * self._probe.deepest_m}
        found["robot_time_at_0_s"] = self._controller.timestamp - self._physics.time_s
        self._write(found)

    def _set_input(self, n: int | None, on: bool) -> None:
        if n is not None:
            t = self._controller.terminals
            t.digital_inputs = t.digital_inputs & ~(1 << n) | int(on) << n

    def _expose(self) -> None:
        """Take a picture where one is due, and send those whose latency is over."""
        t = self._physics.time_s
        if self._waiter is None:
            return
        if t >= self._next_picture - 1e-9:
            self._next_picture += self._every
            self._pictures.append((t + self._latency_s, (unix_now(), self._physics.tag())))
        while self._pictures and t >= self._pictures[0][0]:
            # the world waits for its camera: no picture is late by more than this computer
            self._waiter.send(self._pictures.popleft()[1])

    def answer_scanner(self) -> None:
        """Send the scanner the state of the world, where it has asked."""
        if self._scans is not None:
            self._scans.answer(self._physics.time_s)


def _probe_of(physics: Physics, config: UrTouchProbe | None) -> TouchProbe | None:
    """Return the world's touch probe; raises InputError where the world has no sphere that it could touch."""
    if config is None:
        return None
    truth = physics.station.truth.profiler
    if truth is None:
        raise InputError("A cell with a touch_probe needs a world with a sphere, such as profiler_sphere.")
    return TouchProbe(arm=physics.station.arm, truth=truth, normally_closed=config.normally_closed)


def run_world(
    world_name: str,
    cell_name: str,
    seed: int,
    *,
    write: Callable[[Truth], None],
    ready: Callable[[str], None],
    pace: float | None = None,
    control_port: int = CONTROL_PORT,
    parent: int | None = None,
) -> None:
    """Play the world behind a cell's wires until SIGTERM, SIGINT, or the end of process ``parent``.

    Args:
        world_name: what is true: a scenario, by name or path, with simulated devices; its deviations follow from
            `seed`.
        cell_name: the scenario with what the cell knows, and on which addresses it looks for its devices.
        seed: of everything random.
        write: called with the contents of the truth file whenever they have changed.
        ready: called once with a sentence when every device answers.
        pace: fastest controller seconds per host second; None: the cell's. The controller waits for the physics.
        control_port: port that takes the controller's injected faults.
        parent: process whose end ends the world; None: no such process.

    Raises:
        InputError: the scenarios cannot be played, or an address is taken.
    """
    world, cell = load_scenario(world_name), load_scenario(cell_name)
    wires = wires_of(cell)
    fastest = wires.pace if pace is None else pace
    if not SLOWEST <= fastest <= FASTEST:
        raise InputError(f"The pace must be from {SLOWEST} to {FASTEST:.0f}, not {fastest:g}.")
    camera, nominal = world.finger_camera, world.robot
    if wires.stream is not None and not isinstance(camera, RenderedFingerCamera):
        raise InputError("The world's finger camera is !RenderedFingerCamera.")
    if wires.trigger is None and not isinstance(world.scanner, StreamingScanner):
        raise InputError("A cell whose scanner streams needs a world with scanner: !StreamingScanner {}.")
    wires.folder.mkdir(parents=True, exist_ok=True)
    arm = nominal_arm(world)
    q_home = np.deg2rad(world.home_deg)
    millimetres = nominal.repeatability_mm if isinstance(nominal, SimulatedUr) else 0.0
    context = get_context("spawn")
    with take_address(wires.host, 10.0), contextlib.ExitStack() as stack:
        devices = [f"robot {wires.host}", f"scans in {wires.folder}"]
        if wires.trigger is None:
            scanner = _start(context, stack, run_stream, StreamSetup(world_name, arm, seed, wires.folder))
            devices.append(f"as they stream (process {scanner.pid})")
        else:
            device = SCANNER if isinstance(cell.scanner, FolderScanner) else PROFILER
            setup = ScannerSetup(
                scenario=world_name,
                arm=arm,
                seed=seed,
                host=wires.trigger[0],
                port=wires.trigger[1],
                folder=wires.folder,
                device=device,
            )
            scanner = _start(context, stack, run_scanner, setup)
            devices.append(f"trigger {setup.host}:{setup.port} (process {scanner.pid})")
        physics = Physics(world, arm, seed, millimetres)
        streamer = None
        if isinstance(world.scanner, StreamingScanner) and wires.trigger is None:
            streamer = Streamer(world.scanner, seed, scanner.pipe, unix_now)
        finger = None
        if wires.stream is not None and isinstance(camera, RenderedFingerCamera):
            tool = physics.station.tool
            assert tool is not None
            finger = _start(context, stack, run_finger_camera, FingerSetup(tool, camera.camera(), seed, *wires.stream))
            devices.append(f"pictures http://{wires.stream[0]}:{wires.stream[1]}/ (process {finger.pid})")
        controller = Controller(arm, q_home, parse_version("5.21"))
        controller.payload.mass, controller.payload.center = wires.payload_kg, list(wires.payload_cog_m)
        length = cell.welding.seam_length_mm
        inside = _World(
            controller=controller,
            physics=physics,
            wires=wires,
            scanner=scanner.pipe,
            finger=(camera, finger.pipe) if finger is not None and isinstance(camera, RenderedFingerCamera) else None,
            streamer=streamer,
            wanted_m=None if length is None else 1e-3 * length,
            write=write,
        )
        emulation = Emulation(
            controller,
            wires.host,
            control_port,
            fastest,
            WAITS_S,
            seed,
            after_step=inside.step,
            while_waiting=inside.answer_scanner,
            more_faults=inside.faults(),
        )
        stack.callback(inside.write)
        for child in (scanner, finger):
            if child is not None:
                child.wait_until_ready()
        sentence = f"The cell's world answers: {', '.join(devices)}, faults at port {control_port}."
        inside.write()
        emulation.run(parent, lambda _: ready(sentence))


class _Child:
    """A device's process and the world's end of its pipe."""

    def __init__(self, process: Any, pipe: Connection) -> None:
        self._process, self.pipe = process, pipe

    @property
    def pid(self) -> int:
        """The process's id."""
        return int(self._process.pid)

    def wait_until_ready(self) -> None:
        """Wait for its first message. Raises InputError where it ends instead."""
        until = time.monotonic() + START_LIMIT_S
        while time.monotonic() < until and self._process.is_alive():
            if self.pipe.poll(0.1):
                with contextlib.suppress(EOFError):
                    self.pipe.recv()
                    return
                break
        raise InputError("A device of the world did not start; is its port taken by another program?")

    def close(self) -> None:
        """Close the pipe and end the process."""
        self.pipe.close()
        self._process.join(0.2)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join(3.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _start(context: Any, stack: contextlib.ExitStack, target: Callable[..., None], setup: object) -> _Child:
    ours, its = context.Pipe()
    process = context.Process(target=target, args=(setup, its), daemon=True)
    process.start()
    its.close()
    child = _Child(process, ours)
    stack.callback(child.close)
    return child
