"""Runs a cell: advances its Diagram until the job ends, in real time for a real robot, and stores every scan."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from typing import Generic

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, EventStatus
from pydrake.systems.sensors import RgbdSensor

from weldcal.systems.cell import Cell, JobOf
from weldcal.systems.drivers.simulated.second_arm import FIRST
from weldcal.systems.interrupts import SIGTERM, deferred
from weldcal.systems.messages import JobCommand, Scan
from weldcal.systems.operator import ANSWERS, KEYS
from weldcal.systems.pacing import (
    HostTiming,
    measure_host,
    no_long_garbage_collections,
    real_time_priority,
    require_timely_host,
    short_turns,
)
from weldcal.systems.wall_clock import PictureWait, WallClock

Progress = Callable[[str, float], None]
LOOKS = {"job": 0.008, "progress": 1.0, "panel": 0.1}  # seconds between checks; shorter than the sequencer's period
AT_REST_RAD_S = 1e-3  # as flange_mover.SETTLED_RAD_S
COMMANDED_RAD_S = 1e-6  # above rounding of a zero command, and 1000 times below the slowest motion, AT_REST_RAD_S
OPERATOR_CHECK_S = 0.02  # a choice: 50 looks a second at a button; an operator notices no delay below 0.1 s
STOPPED_BY_OPERATOR = "The operator stopped the run with Ctrl-C"
COMES_TO_REST_S = 1.0  # longest time that a run continues after the end of its job until the arm is at rest
MOST_SHARE = 0.98  # of the job itself; the rest is for measuring and writing
OVERTIME_S = 5.0  # added to the time limit at which the job holds itself


def no_progress(stage: str, fraction: float) -> None:
    """A progress callback that does nothing."""


@dataclass(kw_only=True)
class ProcessTime:
    """When the process was on: simulated s when it came on, wall clock (ISO 8601) of both ends, who held it then."""

    on_s: float
    start: str
    end: str = ""
    held_by: str = ""


@dataclass(kw_only=True)
class Run(Generic[JobOf]):
    """One run of a cell: final root context, scans by label, and (simulated, wall) seconds at each phase's start.

    `interrupted`: the reason where an operator ended the run before its job. `clock`: the clock of a paced run, else
    None. `held_by_person`: how often an operator held the run and let it go on. `host`: the computer's timing before
    the first motion. `share`: the completed share of the job, 0 to 1, which never falls. `arcs`: when the process was
    on.
    """

    cell: Cell[JobOf]
    simulator: Simulator
    wall_seconds: float = 0.0
    phases: list[tuple[str, float, float]] = field(default_factory=list)
    scans: dict[str, tuple[Scan, str]] = field(default_factory=dict)
    interrupted: str | None = None
    clock: WallClock | None = None
    held_by_person: int = 0
    host: HostTiming | None = None
    share: float = 0.0
    arcs: list[ProcessTime] = field(default_factory=list)

    @property
    def root(self) -> Context:
        """The context of the whole Diagram."""
        return self.simulator.get_context()

    @property
    def seconds(self) -> float:
        """Simulated seconds."""
        return float(self.root.get_time())

    @property
    def command(self) -> JobCommand:
        """The job's last command."""
        return self.cell.job.command(self.root)

    @property
    def held(self) -> bool:
        """Whether the job was not completed."""
        return self.interrupted is not None or self.command.held or not self.command.finished

    @property
    def reason(self) -> str | None:
        """Why the job was held; None where it was completed."""
        return self.interrupted or self.command.reason

    @property
    def ended_by_operator(self) -> bool:
        """Whether the operator ended the run: with Ctrl-C, on the dashboard or in the 3D view."""
        return self.held and (self.cell.operator.ends or (self.interrupted or "").startswith(STOPPED_BY_OPERATOR))

    def raise_if_interrupted(self) -> None:
        """For a study of many runs, which an operator ends with any one of them.

        Raises:
            KeyboardInterrupt: an operator ended this run.
        """
        if self.interrupted is not None:
            raise KeyboardInterrupt(self.interrupted)

    def real_time_factor(self, phase: str | None = None) -> float:
        """Simulated seconds per wall second of the whole run, or of one phase."""
        if phase is None:
            return self.seconds / max(self.wall_seconds, 1e-9)
        spans = [(b[1] - a[1], b[2] - a[2]) for a, b in pairwise(self.phases) if a[0] == phase]
        return float(sum(s for s, _ in spans) / max(sum(w for _, w in spans), 1e-9))

    def timing(self) -> dict[str, object]:
        """The timing values at the end of every run's JSON object."""
        found: dict[str, object] = {
            "simulated_seconds": self.seconds,
            "wall_seconds": self.wall_seconds,
            "real_time_factor": self.real_time_factor(),
        }
        if self.clock is not None:
            found |= self.clock.summary()
        if self.host is not None:
            found["host_timing"] = self.host.summary()
        if self.cell.station.robot.transport:
            found["transport"] = self.cell.station.robot.transport
        if self.held_by_person:
            found["held_by_person"] = self.held_by_person
        return found


def _nothing(run: Run[JobOf]) -> None:
    """Do nothing at the end of a run."""


def _no_precedence(_: bool) -> None:
    """Leave the thread's priority as it is: a simulation has none, and a robot that waits needs none."""


def run_cell(
    cell: Cell[JobOf],
    progress: Progress = no_progress,
    meshcat: Meshcat | None = None,
    realtime: bool = False,
    ended: Callable[[Run[JobOf]], None] = _nothing,
    diagram: Diagram | None = None,
    look: Callable[[Run[JobOf]], None] = _nothing,
) -> Run[JobOf]:
    """Advance until the job is done or held (or its time limit holds it) and the arm is at rest.

    Records into `meshcat` where one is given. A station with a pace runs at that pace of the wall clock. The station is
    always closed, also on Ctrl-C, which stops its arm. Before the first motion of a robot the computer's timing is
    measured.

    The cell's `operator` may hold the run in any phase. The path is slowed to rest, and the job's time stands still, so
    that the job goes on along the same path when the operator says so. During a weld the process is turned off first
    and the servo brings the tool to rest; it goes on from a little before that place. `ended` is called before the
    recording is shown. `diagram`: the Diagram that contains the cell's; None: the cell's own. `look` is called every
    8 ms of the run, beside the Diagram: it must not wait. A job's question holds the run until an operator answers it.

    Raises:
        HostTooLate: the computer cannot keep the robot's rate; nothing has moved.
    """
    whole = cell.diagram if diagram is None else diagram
    simulator, station = Simulator(whole), cell.station
    run = Run(cell=cell, simulator=simulator, clock=station.robot.clock)
    if realtime and run.clock is None:
        simulator.set_target_realtime_rate(1.0)
        cell.operator.ask_pace(1.0)
    start = time.perf_counter()
    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=cell.scenario.visualization.recording_fps)
    finished_at, has_panel, operator = np.inf, cell.diagram.HasSubsystemNamed("operator_panel"), cell.operator
    next_at, pictures = dict.fromkeys(LOOKS, 0.0), PictureWait()
    precedence: Callable[[bool], None] = _no_precedence

    def due(what: str, now: float) -> bool:
        if now < next_at[what] - 1e-9:
            return False
        next_at[what] = now + LOOKS[what]
        return True

    def watch(root: Context) -> EventStatus:
        nonlocal finished_at
        if operator.holds and not operator.ends and not _process_on(cell, root) and cell.job.can_stand(root):
            if run.clock is None or run.clock.stands or not _commanded(cell, root):
                _stand(run, progress)
            else:
                run.clock.held = True
        if run.clock is not None:
            moving = _commanded(cell, root)
            # at rest nothing is urgent, and a scan that is drawn here would keep the processor from the robot's peer
            precedence(moving)
            run.clock.waiting_s = 0.0 if station.robot.waits else station.waiting_s(time.monotonic())
            if run.clock.follows:
                pictures.wait(_picture_age(cell, root))
            run.clock.wait_for(root.get_time(), moving)
        if not due("job", root.get_time()):
            return EventStatus.DidNothing()
        command = cell.job.command(root)
        look(run)
        if command.question and command.question not in (operator.question, operator.answered):
            operator.ask(command.question)
        _note_arc(run, root.get_time(), _process_on(cell, root))
        if not run.phases or command.phase != run.phases[-1][0]:
            _keep_scan(run, root)
            run.phases.append((command.phase, root.get_time(), time.perf_counter() - start))
            _tell(run, root, progress)
        elif due("progress", root.get_time()):
            _tell(run, root, progress)
        if run.clock is None and has_panel and due("panel", root.get_time()):
            _keep_pace(run, root)
        if command.finished:
            finished_at = min(finished_at, root.get_time())
            if _at_rest(cell, root) or root.get_time() - finished_at > COMES_TO_REST_S:
                return EventStatus.ReachedTermination(whole, command.phase)
        return EventStatus.DidNothing()

    simulator.set_monitor(watch)
    try:
        with no_long_garbage_collections(), ExitStack() as around:
            if run.clock is not None:
                _first_pictures(cell, run.root)
                station.background.settle()
                run.host = measure_host()
                if not station.robot.waits:
                    require_timely_host(run.host)
                progress(f"this computer: {run.host.words}", 0.0)
                around.enter_context(short_turns())
                if not run.clock.follows:  # a robot that waits needs no precedence, and shares this computer
                    precedence = around.enter_context(real_time_priority())
            simulator.Initialize()
            simulator.AdvanceTo(cell.job.maximum_time_s + OVERTIME_S)
    except KeyboardInterrupt as stop:
        if not run.phases:  # nothing has begun that could be held
            raise
        who = "The operating system ended the run (SIGTERM)" if SIGTERM in stop.args else STOPPED_BY_OPERATOR
        run.interrupted = f"{who}, in the phase '{run.command.phase}'."
    finally:
        simulator.clear_monitor()  # it knows the run, and the run the simulator: C++ would keep both
        with deferred():  # the arm comes to rest first
            station.close()
    run.wall_seconds = time.perf_counter() - start
    _note_arc(run, run.seconds, False)
    ended(run)
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
    return run


def _tell(run: Run[JobOf], root: Context, progress: Progress) -> None:
    """Report the stage and the completed share; a held job keeps the share that it had reached."""
    stage, share = run.cell.job.stage(root, run.phases)
    if not run.cell.job.command(root).held:
        run.share = max(run.share, min(share, MOST_SHARE))
    progress(stage, run.share)


def _stand(run: Run[JobOf], progress: Progress) -> None:
    """Keep the arm at rest and the Diagram's time where it is until the operator lets the job go on, or ends it."""
    operator = run.cell.operator
    phase, share = run.cell.job.stage(run.root, run.phases)[0], run.share
    if operator.question:
        progress(f"held by a question\n{operator.question}\n{ANSWERS}", share)
    else:
        progress(f"held by an operator ({phase})\n{KEYS}", share)
    run.held_by_person += 1
    operator.stands = True
    try:
        while operator.holds and not operator.ends:
            run.cell.station.robot.rest()
            time.sleep(OPERATOR_CHECK_S)
    finally:
        operator.stands = False
    progress(phase, share)
    if run.clock is not None:
        run.clock.go_on()
    run.simulator.ResetStatistics()  # or a simulation in real time would make up for the time that it stood


def _process_on(cell: Cell[JobOf], root: Context) -> bool:
    """Whether the process (the torch) is enabled."""
    context = cell.diagram.GetMyContextFromRoot(root)
    return bool(cell.diagram.GetOutputPort("process_on").Eval(context)[0] > 0.5)


def _commanded(cell: Cell[JobOf], root: Context) -> bool:
    """Whether the arm is commanded to move."""
    station = cell.station.diagram
    command = station.GetInputPort(f"{FIRST}.velocity_command").Eval(station.GetMyContextFromRoot(root))
    return bool(np.max(np.abs(command)) > COMMANDED_RAD_S)


def _picture_age(cell: Cell[JobOf], root: Context) -> float:
    """How old the finger camera's newest picture is, s; 0 where none is asked for."""
    station = cell.station.diagram
    if not station.HasOutputPort("finger_camera.capture_time"):
        return 0.0
    context = station.GetMyContextFromRoot(root)
    if station.GetInputPort("finger_camera.streaming").Eval(context)[0] < 0.5:
        return 0.0
    return float(root.get_time() - station.GetOutputPort("finger_camera.capture_time").Eval(context)[0])


def _at_rest(cell: Cell[JobOf], root: Context) -> bool:
    station = cell.station.diagram
    measured = station.GetOutputPort(f"{FIRST}.velocity_measured").Eval(station.GetMyContextFromRoot(root))
    return bool(np.max(np.abs(measured)) < AT_REST_RAD_S)


def _first_pictures(cell: Cell[JobOf], root: Context) -> None:
    """Take each renderer's first picture, which takes a second, while nothing moves."""
    for system in cell.station.diagram.GetSystems():
        if isinstance(system, RgbdSensor):
            context = system.GetMyContextFromRoot(root)
            for port in (system.color_image_output_port(), system.depth_image_32F_output_port()):
                port.Eval(context)


def _keep_pace(run: Run[JobOf], root: Context) -> None:
    """Set the simulation's real-time rate from the viewer's slider."""
    panel = run.cell.diagram.GetSubsystemByName("operator_panel")
    pace = float(panel.GetOutputPort("pace").Eval(panel.GetMyContextFromRoot(root))[0])
    if pace != run.simulator.get_target_realtime_rate():
        run.simulator.set_target_realtime_rate(pace)
        run.simulator.ResetStatistics()  # the new rate counts from here on


def _note_arc(run: Run[JobOf], time_s: float, on: bool) -> None:
    """Note when the process comes on and goes off."""
    lit, now = bool(run.arcs) and not run.arcs[-1].end, datetime.now(UTC).isoformat(timespec="milliseconds")
    if on and not lit:
        run.arcs.append(ProcessTime(on_s=time_s, start=now))
    elif lit and not on:
        operator = run.cell.operator
        run.arcs[-1].end, run.arcs[-1].held_by = now, operator.held_by if operator.holds else ""


def _keep_scan(run: Run[JobOf], root: Context) -> None:
    """Store a new scan with its purpose; the phase after a scan starts only when the scan has been processed."""
    station = run.cell.station.diagram
    if not run.phases or not run.phases[-1][0].startswith("scan") or not station.HasOutputPort("scanner.scan"):
        return
    scan: Scan = station.GetOutputPort("scanner.scan").Eval(station.GetMyContextFromRoot(root))
    command = run.command
    if scan.sequence and command.scan_label:
        run.scans[command.scan_label] = (scan, command.scan_purpose)
