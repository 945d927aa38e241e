"""Run the job of a scenario for all commands: robot, cell, viewer, recording and the loop."""

from __future__ import annotations

import dataclasses as dc
import json
import platform
import time
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform

from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.writing import save_dataset
from weldcal.models.arrays import Array
from weldcal.models.documents import nearest
from weldcal.models.errors import InputError
from weldcal.systems.addresses import controller_address, is_loopback, loopback_address
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.jobs.job import job_of
from weldcal.systems.operator import Operator, operator_at
from weldcal.systems.pacing import draw_in_this_thread
from weldcal.systems.recording.port_recorder import ENTERED, LEFT
from weldcal.systems.recording.scenario_files import packed
from weldcal.systems.recording.tap import OpenSink, PortLayout
from weldcal.systems.recording.values import encode
from weldcal.systems.recording.writer import RecordingWriter
from weldcal.systems.runner import Progress, Run, run_cell
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.parts import nominal_arm
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.viewer.kept import free_unused
from weldcal.systems.viewer.live import LiveView
from weldcal.systems.viewer.scene import set_the_scene
from weldcal.tools import console
from weldcal.tools.cli.options import LIVE, Call
from weldcal.tools.cli.result_folder import RECORDING
from weldcal.tools.connections import guard
from weldcal.tools.dashboard.facts import facts_of
from weldcal.tools.dashboard.recording import with_overlay
from weldcal.tools.dashboard.source import DashboardSource
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.run import RunOptions

if TYPE_CHECKING:
    from weldcal.systems.drivers.station_build import PreparedRobot
    from weldcal.systems.drivers.ur.rtde import UrRtde

SIMULATED, EMULATED = "simulated", "emulated"
EMULATED_PACE = 0.7  # two cores almost keep up at 1; at this pace they do with other load
SLOWEST_PACE = 0.05
ALMOST = 0.8  # likeness to "emulated" from which on a word is a slip and not the name of a host
_NO_CONTROLLER = "--dry-run and --pace need a controller: give --robot emulated or the address of a controller."
GRAVITY = 9.82  # m/s^2, as a controller has it
_PACKAGES = ("drake", "numpy", "scipy", "open3d", "opencv-python-headless", "numba")

RECORDED = (*LIVE, "record")


def run_options(call: Call, command: str, scenario: str, **more: Any) -> RunOptions:
    """Return the options of a run; its folder is named after the command and the scenario."""
    return RunOptions(
        scenario=scenario,
        out=call.folder(command, scenario),
        seed=call.seed,
        keep_page=call.keep_page,
        **{**call.live, **more},
    )


def named_once(name: str | None, scenario: str, preset: str) -> str:
    """Return the scenario, given as an argument or with --scenario.

    Raises:
        typer.BadParameter: both are given, and differ.
    """
    if name is not None and scenario not in (preset, name):
        raise typer.BadParameter("give the scenario once, as an argument or with --scenario")
    return name or scenario


@dataclass(frozen=True, eq=False)
class JobRun:
    """A completed run, done or held; its recording viewer or None; its robot's name; what was shown or None."""

    run: Run[Any]
    meshcat: Meshcat | None
    robot: str
    live: LiveView | None = None

    def share(self, done: float) -> float:
        """Return the completed share while results are written: ``done`` if completed, else what it had reached."""
        return self.run.share if self.run.held else max(self.run.share, done)

    @property
    def cell(self) -> Cell[Any]:
        """The cell that ran."""
        return self.run.cell

    def write_recording(self, folder: Path) -> None:
        """Write recording.html where the run was recorded."""
        if self.meshcat is not None:
            page = self.meshcat.StaticHtml()
            if self.live is not None:
                page = with_overlay(page, self.run, self.live, self.cell.scenario.description or "weldcal")
            write_atomic(folder / "recording.html", page)


def run_job(
    scenario: Scenario,
    options: RunOptions,
    progress: Progress,
    key: str | None = None,
    look: Callable[[Run[Any]], None] | None = None,
) -> JobRun:
    """Build the cell and run its job to the end; `key` is the key of the required job, None: any job.

    `look`: see run_cell.

    Raises:
        InputError: the scenario has another job. UnreachableScanner, RobotRefused: see chosen_robot and build_cell;
            nothing has been written or moved.
    """
    found = job_of(scenario).key
    if key and found != key:
        raise InputError(f"This scenario has no {key} part: write {key}: {{}} in it, or run it with weldcal demo.")
    if key is not None and found != key:
        raise InputError(f"This scenario has a {found} part, so there is no weld in it: run it with weldcal demo.")
    if options.speed_factor is not None:
        scenario.job.speed_factor = options.speed_factor
        check_scenario(scenario)
    meshcat = None
    with (
        one_thread(),
        chosen_robot(options.robot, scenario, dry_run=options.dry_run, pace=options.pace) as robot,
        operator_at() as operator,
    ):
        free_unused()
        if options.recording or options.browser:
            meshcat = Meshcat(
                MeshcatParams(host="localhost", web_url_pattern="http://{host}:{port}", show_stats_plot=False)
            )
            guard(meshcat)
        recorder = RunRecorder(scenario, options, robot.title) if options.record else None
        open_sink = None if recorder is None else recorder.open_sink
        with _dashboard(operator, meshcat, options) as source:

            def told(stage: str, share: float) -> None:
                progress(stage, share)
                if source is not None:
                    source.stage(stage, share)

            def ended(finished: Run[Any]) -> None:
                if source is not None:
                    source.end(finished.held, finished.reason, replays=True)

            told("build the cell", 0.0)
            live = None if meshcat is None else LiveView() if source is None else source.live
            cell = build_cell(
                scenario,
                options.seed,
                meshcat,
                robot.prepared,
                open_sink=open_sink,
                operator=operator,
                live=live,
                replace=options.replace,
            )
            with closing(cell.station):
                if meshcat is not None:
                    camera, target = cell.job.view()
                    set_the_scene(meshcat, camera, target, scenario.base.pose())
                if source is not None:
                    source.facts = facts_of(cell, options.scenario, robot.title)
                run = run_cell(cell, told, meshcat, options.realtime, ended, *(() if look is None else (None, look)))
                if recorder is not None:
                    recorder.close(run)
    return JobRun(run, meshcat, robot.title, live)


def save_scans(
    run: Run[Any], folder: Path, header: DatasetHeader, poses: Mapping[str, RigidTransform], joints: Mapping[str, Array]
) -> Path | None:
    """Write the scans of a live calibration as a dataset for `weldcal calibrate`; None where there are none.

    ``poses`` are X_BF by the scan's label, ``joints`` (n,) rad likewise.
    """
    scanner, kept = run.cell.scenario.scanner_config(), run.scans
    ids = [id for id in poses if id in kept]
    if not ids or scanner is None:
        return None
    preset = scanner.scanner()
    save_dataset(
        folder,
        header,
        {id: poses[id] for id in ids},
        {id: kept[id][0].points_C.astype(float) for id in ids},
        times={id: kept[id][0].capture_time for id in ids},
        joints=joints,
        intrinsics=(preset.fx, preset.fy, preset.cx, preset.cy),
    )
    return folder


@contextmanager
def one_thread() -> Iterator[None]:
    """Let NumPy and OpenCV use one thread for the duration of the block.

    The products of a tick and the finger camera's pictures are small: a second thread waits busily for the next one and
    takes a core from the robot's peer.
    """
    import cv2
    from threadpoolctl import threadpool_limits

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before)


@contextmanager
def _dashboard(operator: Operator, meshcat: Meshcat | None, options: RunOptions) -> Iterator[DashboardSource | None]:
    """Serve the run's page during the block and open it in the browser; None where no viewer is wanted."""
    if meshcat is None or not options.browser:
        yield None
        return
    from weldcal.tools.dashboard.server import Dashboard  # Flask takes a moment to load

    source = DashboardSource(LiveView(), operator)
    with ExitStack() as stack:
        dashboard = stack.enter_context(closing(Dashboard(source, meshcat.web_url(), options.share)))
        console.emit_address("dashboard", dashboard.url)
        if dashboard.shared_url is not None:
            console.emit_address("read-only for the network", dashboard.shared_url)
        webbrowser.open(dashboard.url)
        time.sleep(2.0 if options.realtime else 0.5)  # the page needs a moment to load
        try:
            yield source
        finally:
            if not source.ended:
                source.end(held=True, reason="The run has failed: the reason is in the terminal.", replays=False)
        if options.keep_page is not None:
            options.keep_page(source.conclude, stack.pop_all().close)


@dc.dataclass(frozen=True, eq=False)
class ChosenRobot:
    """The robot of a run. `title` is its name for display; `prepared` is set where the driver need not prepare it."""

    title: str
    prepared: PreparedRobot | None = None


@contextmanager
def chosen_robot(
    word: str | None, scenario: Scenario, *, dry_run: bool = False, pace: float | None = None
) -> Iterator[ChosenRobot]:
    """Set `scenario.robot` by the option's value for the duration of the block.

    Args:
        word: `simulated`; `emulated`, on a loopback address of its own, or `emulated@ADDRESS`; the address of a
            controller; None: the scenario's own.
        scenario: its `robot` is replaced.
        dry_run: read the robot's state, then run with a simulated arm that has its kinematics and configuration.
        pace: controller seconds per second of the wall clock; other than 1 only for an emulated controller.

    Raises:
        InputError: the options cannot be combined, or the address is none.
        RobotRefused: the controller does not answer, or does not allow the job; nothing has moved.
    """
    if word in (None, SIMULATED) and scenario.robot.SIMULATED:
        if dry_run or pace is not None:
            raise InputError(_NO_CONTROLLER)
        yield ChosenRobot("simulated")
        return
    from weldcal.systems.drivers.simulated.ur import SimulatedUr  # only here: a simulation needs none of these
    from weldcal.systems.drivers.ur.rtde import UrRtde
    from weldcal.tools.emulators.ur.process import LOCKSTEP_S, emulator_process

    if word is None and not isinstance(scenario.robot, UrRtde):
        if dry_run or pace is not None:
            raise InputError("--dry-run and --pace need a controller: give --robot with its address.")
        yield ChosenRobot(type(scenario.robot).__name__)
        return
    if word is None:
        assert isinstance(scenario.robot, UrRtde)
        word = scenario.robot.host
        if pace is None and scenario.robot.pace != 1.0:
            pace = scenario.robot.pace
    if word == SIMULATED:
        if dry_run or pace is not None:
            raise InputError(_NO_CONTROLLER)
        if isinstance(scenario.robot, UrRtde):
            scenario.robot = SimulatedUr()
        yield ChosenRobot("simulated")
        return
    kind, _, address = word.partition("@")
    if kind != EMULATED:
        near = nearest(word, (SIMULATED, EMULATED), ALMOST)
        if near is not None:
            raise InputError(f"There is no robot '{word}': did you mean '{near}'? Or give the address of a controller.")
        host = controller_address(word)
        if pace is not None and not is_loopback(host):
            raise InputError(
                "A real controller runs in real time: --pace is for an emulated one, at a loopback address."
            )
        pace = 1.0 if pace is None else pace
        _check_pace(pace)
        yield _at(host, f"the controller at {host}", scenario, dry_run=dry_run, pace=pace)
        return
    wanted = loopback_address(address) if address else None
    pace = EMULATED_PACE if pace is None else pace
    _check_pace(pace)
    kinematics = None if scenario.kinematics is None else Path(scenario.kinematics)
    q_home = np.deg2rad(scenario.home_deg)
    with emulator_process(
        host=wanted, robot=scenario.arm, q=q_home.tolist(), kinematics=kinematics, pace=pace, lockstep=LOCKSTEP_S
    ) as emulator:
        load = (scenario.robot if isinstance(scenario.robot, UrRtde) else robot_at(emulator.host, scenario)).load()
        emulator.do("set_payload", mass=load.mass_kg, cog=list(load.cog_m))
        emulator.do("set_gravity", gravity=(GRAVITY * nominal_arm(scenario).up).tolist())
        yield _at(emulator.host, "an emulated controller", scenario, dry_run=dry_run, pace=pace, lockstep=True)


def _check_pace(pace: float) -> None:
    if not SLOWEST_PACE <= pace <= 1.0:
        raise InputError(f"--pace must be from {SLOWEST_PACE:g} to 1, and it is {pace:g}.")


def _at(host: str, name: str, scenario: Scenario, *, dry_run: bool, pace: float, lockstep: bool = False) -> ChosenRobot:
    from weldcal.systems.drivers.simulated.ur import SimulatedUr
    from weldcal.systems.drivers.ur.rtde import UrRtde

    config = scenario.robot if isinstance(scenario.robot, UrRtde) else robot_at(host, scenario)
    config = dc.replace(config, host=host, pace=pace, lockstep=lockstep or config.lockstep)
    if not dry_run:
        scenario.robot = config
        draw_in_this_thread()
        return ChosenRobot(name)
    scenario.robot = SimulatedUr()
    return ChosenRobot(
        f"dry run: a simulated arm with the kinematics and configuration of {name}; nothing was sent to it",
        look_at(config, scenario),
    )


def robot_at(host: str, scenario: Scenario) -> UrRtde:
    """Return the robot at an address, with the scenario's tool as its payload."""
    from weldcal.systems.drivers.ur.rtde import UrRtde

    if scenario.tool == "none":
        return UrRtde(host=host, payload_kg=0.0, payload_cog_m=[0.0, 0.0, 0.0])
    if scenario.tool == "pen":
        return UrRtde(host=host, payload_kg=0.42, payload_cog_m=[0.03, 0.0, 0.02])
    loaded = scenario.loaded_tool()
    assert loaded is not None
    return UrRtde(host=host, payload_kg=loaded.tool.mass_kg, payload_cog_m=list(loaded.tool.centre_of_mass_m))


def look_at(config: UrRtde, scenario: Scenario) -> PreparedRobot:
    """Read the kinematics and configuration of a controller's arm; nothing is written, sent or moved.

    Raises:
        RobotRefused: the controller does not answer, or a check of the pre-flight failed; the message gives the
            operator action.
    """
    from weldcal.systems.drivers.station_build import PreparedRobot
    from weldcal.systems.drivers.ur.readiness.preflight import preflight, require_ready

    report = preflight(
        config.host,
        upper_registers=config.upper_registers,
        nominal=nominal_arm(scenario),
        load=config.load(),
        set_points=config.set_points,
    )
    require_ready(report)
    assert report.arm is not None
    assert report.arm_q is not None
    return PreparedRobot(report.arm, report.arm_q)


class RunRecorder:
    """Records one run, from the building of its cell to its end."""

    def __init__(self, scenario: Scenario, options: RunOptions, robot: str) -> None:
        self._scenario, self._options, self._robot = scenario, options, robot
        self._writer: RecordingWriter | None = None

    @property
    def open_sink(self) -> OpenSink:
        """See build_cell."""
        return self._open

    def _open(self, station: Station, layout: PortLayout) -> RecordingWriter:
        sizes = {ENTERED: layout.entered, LEFT: layout.left}
        about = {
            "sizes": json.dumps(sizes),
            "version": version("weldcal"),
            "packages": json.dumps({name: version(name) for name in _PACKAGES}),
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.machine()}",
            "scenario": self._options.scenario,
            "seed": str(self._options.seed),
            "robot": self._robot,
            "drives": json.dumps(layout.drives),
            "arm": json.dumps(encode(station.arm)),
            "q_start": json.dumps(encode(station.q_start)),
        }
        self._options.out.mkdir(parents=True, exist_ok=True)
        self._writer = RecordingWriter(self.path, about, packed(self._scenario), station.arm, sizes)
        return self._writer

    @property
    def path(self) -> Path:
        """The file."""
        return self._options.out / RECORDING

    def close(self, run: Run | None) -> None:  # type: ignore[type-arg]  # of any job
        """End the file; without a run (it has failed) it stays as one that was cut off.

        Raises:
            RecordingFailed: see RecordingWriter.close.
        """
        if self._writer is not None and run is not None:
            self._writer.close({"time": run.seconds, "phase": run.command.phase, "interrupted": run.interrupted})
