"""Running a visit to the tablet: advance the Diagram until the procedure ends, by the wall clock where the robot is real."""

from __future__ import annotations

import time
from contextlib import ExitStack

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus
from pydrake.systems.sensors import RgbdSensor

from weldcal.systems.jobs.tablet.cell import TabletCell, TabletVisit
from weldcal.systems.jobs.tablet.procedure import TabletState
from weldcal.systems.motion.operator_panel import PACE_SLIDER
from weldcal.systems.pacing import WallClock, no_long_garbage_collections, real_time_priority
from weldcal.tools.console import Progress

LOOK_PERIOD_S = 0.02  # between looks at the procedure
PANEL_PERIOD_S = 0.1
AT_REST_RAD_S = 1e-3
COMES_TO_REST_S = 1.0  # how long a run goes on after its procedure has ended, at most, until the arm is at rest
SAYS = {
    "start": "get ready",
    "to_start": "go home",
    "to_look": "to the look",
    "look": "look",
    "to_above": "touch landmark {0}",
    "descend": "touch landmark {0}",
    "lift": "touch landmark {0}",
    "to_home": "go home",
    "done": "done",
    "held": "held",
}


def run_visit(
    cell: TabletCell, progress: Progress, meshcat: Meshcat | None = None, realtime: bool = False
) -> TabletVisit:
    """Run the procedure to its end (done, or held with a reason); records into `meshcat` where one is given.

    Whatever happens, Ctrl-C included, the station is closed: its arm stops.
    """
    simulator, station = Simulator(cell.diagram), cell.station
    clock = None if station.pace is None else WallClock(station.pace)
    if realtime and clock is None:
        simulator.set_target_realtime_rate(1.0)
        if meshcat is not None:
            meshcat.SetSliderValue(PACE_SLIDER, 1.0)
    start = time.perf_counter()
    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=cell.scenario.visualization.recording_fps)
    phases: list[tuple[str, float]] = []
    next_look, next_panel, finished_at, interrupted = 0.0, 0.0, np.inf, ""

    def watch(root: Context) -> EventStatus:
        nonlocal next_look, next_panel, finished_at
        now = root.get_time()
        if clock is not None:
            clock.wait_for(now, _speed(cell, root, "velocity_measured") > AT_REST_RAD_S)
        if now < next_look - 1e-9:
            return EventStatus.DidNothing()
        next_look = now + LOOK_PERIOD_S
        state = cell.state(root)
        if not phases or state.phase != phases[-1][0]:
            phases.append((state.phase, now))
            progress(SAYS[state.phase].format(state.landmark + 1), _share(cell, state))
        if meshcat is not None and clock is None and now >= next_panel - 1e-9:
            next_panel = now + PANEL_PERIOD_S
            _keep_pace(cell, simulator)
        if state.finished:
            finished_at = min(finished_at, now)
            if _speed(cell, root, "velocity_measured") < AT_REST_RAD_S or now - finished_at > COMES_TO_REST_S:
                return EventStatus.ReachedTermination(cell.procedure, state.phase)
        return EventStatus.DidNothing()

    simulator.set_monitor(watch)
    try:
        with ExitStack() as around:
            if clock is not None:
                around.enter_context(no_long_garbage_collections())
                _first_pictures(cell, simulator.get_context())
                around.enter_context(real_time_priority())
            simulator.Initialize()
            simulator.AdvanceTo(cell.plan.maximum_time_s + 2.0 * COMES_TO_REST_S)
    except KeyboardInterrupt:
        interrupted = f"A person stopped the visit with Ctrl-C, in the phase '{phases[-1][0] if phases else 'start'}'."
    finally:
        station.close()
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
    root = simulator.get_context()
    return TabletVisit(
        cell.state(root),
        cell.picture(root),
        float(root.get_time()),
        time.perf_counter() - start,
        tuple(phases),
        interrupted,
    )


def _speed(cell: TabletCell, root: Context, port: str) -> float:
    """Fastest joint, rad/s."""
    station = cell.station.diagram
    return float(np.abs(station.GetOutputPort(f"ur10e.{port}").Eval(station.GetMyContextFromRoot(root))).max())


def _share(cell: TabletCell, state: TabletState) -> float:
    """How much of the run lies behind: the look is a tenth, the touches nearly all of the rest."""
    n = len(cell.plan.q_above)
    return 0.95 if state.finished else 0.05 + 0.05 * (state.trigger > 0) + 0.80 * len(state.touches) / n


def _keep_pace(cell: TabletCell, simulator: Simulator) -> None:
    """The viewer's slider sets how fast the simulation may go."""
    panel = cell.diagram.GetSubsystemByName("operator_panel")
    pace = float(panel.GetOutputPort("pace").Eval(panel.GetMyContextFromRoot(simulator.get_context()))[0])
    if pace != simulator.get_target_realtime_rate():
        simulator.set_target_realtime_rate(pace)


def _first_pictures(cell: TabletCell, root: Context) -> None:
    """A renderer's first picture takes a second: let it be taken while nothing moves."""
    for system in cell.station.diagram.GetSystems():
        if isinstance(system, RgbdSensor):
            context = system.GetMyContextFromRoot(root)
            for port in (system.color_image_output_port(), system.depth_image_32F_output_port()):
                port.Eval(context)
