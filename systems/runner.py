"""Running a cell: advance the Diagram until its job ends, keep to the wall clock where the robot is real, keep every scan."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus
from pydrake.systems.sensors import RgbdSensor

from weldcal.systems.cell import Cell, job_plan
from weldcal.systems.drivers.simulated.rendered_finger_camera import StreamingColourCamera
from weldcal.systems.jobs.weld.sequencer import JobState
from weldcal.systems.messages import Scan
from weldcal.systems.motion.operator_panel import PACE_SLIDER
from weldcal.systems.pacing import WallClock, no_long_garbage_collections, real_time_priority

Progress = Callable[[str, float], None]
# How much of a run lies behind when a phase begins, for a progress bar: calibration, planning, weld.
SHARES = {
    "start": 0.0,
    "move_home": 0.0,
    "move_to_pose": 0.05,
    "move_to_verify": 0.28,
    "scan_verify": 0.30,
    "park": 0.31,
    "scan_workpiece": 0.33,
    "approach_above": 0.34,
    "approach": 0.36,
    "weld": 0.38,
    "retract": 0.96,
    "home": 0.97,
    "done": 0.98,
    "held": 0.98,
}


LOOKS = {
    "job": 0.008,
    "progress": 1.0,
    "panel": 0.1,
}  # seconds between looks; the sequencer's own period is longer than a look's
AT_REST_RAD_S = 1e-3
COMMANDED_RAD_S = 1e-6
COMES_TO_REST_S = 1.0  # how long a run goes on after its job has ended, at most, until the arm is at rest


def no_progress(stage: str, fraction: float) -> None:
    """For callers who do not watch."""


@dataclass
class Run:
    """One run of a cell: its final root context, scans by label, and (simulated, wall) seconds at which each phase began.

    `interrupted`: why a person ended it before its job had. `clock`: what kept it to the wall clock, where something did.
    """

    cell: Cell
    simulator: Simulator
    wall_seconds: float = 0.0
    phases: list[tuple[str, float, float]] = field(default_factory=list)
    scans: dict[str, tuple[Scan, str]] = field(default_factory=dict)
    interrupted: str | None = None
    clock: WallClock | None = None

    @property
    def held(self) -> bool:
        """The job did not come to its end."""
        return self.interrupted is not None or self.job.command.held

    @property
    def reason(self) -> str | None:
        """Why it did not."""
        return self.interrupted or self.job.command.reason

    @property
    def root(self) -> Context:
        """The context of the whole Diagram."""
        return self.simulator.get_context()

    @property
    def job(self) -> JobState:
        """Where the job stands."""
        return self.cell.sequencer.job_state(self.cell.sequencer.GetMyContextFromRoot(self.root))

    def real_time_factor(self, phase: str | None = None) -> float:
        """Simulated seconds per wall second of the whole run, or of one phase."""
        if phase is None:
            return float(self.root.get_time()) / max(self.wall_seconds, 1e-9)
        spans = [(b[1] - a[1], b[2] - a[2]) for a, b in pairwise(self.phases) if a[0] == phase]
        return float(sum(s for s, _ in spans) / max(sum(w for _, w in spans), 1e-9))


def run_cell(
    cell: Cell, progress: Progress = no_progress, meshcat: Meshcat | None = None, realtime: bool = False
) -> Run:
    """Advance until the job is done or held (or its own time limit holds it) and the arm is at rest.

    Records into `meshcat` where one is given. A station with a pace is kept to the wall clock. Whatever happens, Ctrl-C
    included, the station is closed: its arm stops.
    """
    simulator, station = Simulator(cell.diagram), cell.station
    run = Run(cell, simulator, clock=None if station.pace is None else WallClock(station.pace))
    if realtime and run.clock is None:
        simulator.set_target_realtime_rate(1.0)
        if meshcat is not None:
            meshcat.SetSliderValue(PACE_SLIDER, 1.0)
    start = time.perf_counter()
    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=cell.scenario.visualization.recording_fps)
    finished_at, has_panel = np.inf, cell.diagram.HasSubsystemNamed("operator_panel")
    next_at = dict.fromkeys(LOOKS, 0.0)

    def due(what: str, now: float) -> bool:
        if now < next_at[what] - 1e-9:
            return False
        next_at[what] = now + LOOKS[what]
        return True

    def watch(root: Context) -> EventStatus:
        nonlocal finished_at
        if run.clock is not None:
            run.clock.wait_for(root.get_time(), _commanded(cell, root))
        if not due("job", root.get_time()):
            return EventStatus.DidNothing()
        command = cell.sequencer.job_state(cell.sequencer.GetMyContextFromRoot(root)).command
        if not run.phases or command.phase != run.phases[-1][0]:
            _keep_scan(run, root)
            run.phases.append((command.phase, root.get_time(), time.perf_counter() - start))
            progress(command.phase.replace("_", " "), _share(run, root, command.phase))
        elif command.phase == "weld" and due("progress", root.get_time()):
            progress("weld", _share(run, root, "weld"))
        if run.clock is None and has_panel and due("panel", root.get_time()):
            _keep_pace(run, root)
        if command.finished:
            finished_at = min(finished_at, root.get_time())
            if _at_rest(cell, root) or root.get_time() - finished_at > COMES_TO_REST_S:
                return EventStatus.ReachedTermination(cell.sequencer, command.phase)
        return EventStatus.DidNothing()

    simulator.set_monitor(watch)
    try:
        with ExitStack() as around:
            if run.clock is not None:
                around.enter_context(no_long_garbage_collections())
                _first_pictures(cell, run.root)
                around.enter_context(real_time_priority())
            simulator.Initialize()
            simulator.AdvanceTo(job_plan(cell.scenario).maximum_time_s + 5.0)
    except KeyboardInterrupt:
        run.interrupted = f"A person stopped the run with Ctrl-C, in the phase '{run.job.command.phase}'."
    finally:
        station.close()
    run.wall_seconds = time.perf_counter() - start
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
    return run


def _commanded(cell: Cell, root: Context) -> bool:
    """Whether the arm is told to move."""
    station = cell.station.diagram
    command = station.GetInputPort("ur10e.velocity_command").Eval(station.GetMyContextFromRoot(root))
    return bool(np.max(np.abs(command)) > COMMANDED_RAD_S)


def _at_rest(cell: Cell, root: Context) -> bool:
    station = cell.station.diagram
    measured = station.GetOutputPort("ur10e.velocity_measured").Eval(station.GetMyContextFromRoot(root))
    return bool(np.max(np.abs(measured)) < AT_REST_RAD_S)


def _first_pictures(cell: Cell, root: Context) -> None:
    """A renderer's first picture takes a second: let it be taken while nothing moves."""
    for system in cell.station.diagram.GetSystems():
        if isinstance(system, RgbdSensor):
            context = system.GetMyContextFromRoot(root)
            for port in (system.color_image_output_port(), system.depth_image_32F_output_port()):
                port.Eval(context)
        elif isinstance(system, StreamingColourCamera):
            system.first_picture(system.GetMyContextFromRoot(root))


def _keep_pace(run: Run, root: Context) -> None:
    """The viewer's slider sets how fast the simulation may go."""
    panel = run.cell.diagram.GetSubsystemByName("operator_panel")
    pace = float(panel.GetOutputPort("pace").Eval(panel.GetMyContextFromRoot(root))[0])
    if pace != run.simulator.get_target_realtime_rate():
        run.simulator.set_target_realtime_rate(pace)


def _share(run: Run, root: Context, phase: str) -> float:
    share = SHARES.get(phase, 0.05)
    if phase in ("move_to_pose", "scan_pose", "scan_verification_cloud", "move_to_verification_cloud"):
        scans = sum(1 for name, _, _ in run.phases if name == "scan_pose")
        return min(0.02 + 0.03 * scans, 0.27)
    if phase == "weld":
        begun = next((t for name, t, _ in run.phases if name == "weld"), root.get_time())
        length = (
            0.3 if run.cell.scenario.welding.seam_length_mm is None else run.cell.scenario.welding.seam_length_mm * 1e-3
        )
        expected = (length + 0.06) / run.cell.servo_config.weld_speed_m_s + 5.0
        return share + 0.58 * min(float(root.get_time() - begun) / expected, 1.0)
    return share


def _keep_scan(run: Run, root: Context) -> None:
    """A phase that follows a scan begins after the scan was digested: keep it, with its purpose."""
    if not run.phases or not run.phases[-1][0].startswith("scan_"):
        return
    station = run.cell.station.diagram
    scan: Scan = station.GetOutputPort("scanner.scan").Eval(station.GetMyContextFromRoot(root))
    command = run.job.command
    if scan.sequence:
        run.scans[command.scan_label] = (scan, command.scan_purpose)
