"""The profiler's cell: one Diagram of the station, the existing mover, arbiter and limiter, and the procedure that uses the profiler."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink

from weldcal.models.errors import InputError
from weldcal.systems.cell import JERK_LIMIT
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler, drawn_pose
from weldcal.systems.drivers.station_build import PreparedRobot
from weldcal.systems.jobs.profiler.planning_context import Room
from weldcal.systems.jobs.profiler.procedure import ProfilerProcedure, ProfilerState
from weldcal.systems.jobs.profiler.robot_error import RobotError
from weldcal.systems.motion.command_arbiter import CommandArbiter
from weldcal.systems.motion.flange_mover import FlangeMover
from weldcal.systems.motion.pose_recorder import PoseRecorder
from weldcal.systems.motion.slew_limiter import SlewLimiter
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station, make_station
from weldcal.welding.servo.guards import SlewLimits

Array = NDArray[np.float64]
CONTROL_PERIOD_S = 0.004
MOVE_SPEED, MOVE_ACCELERATION = 1.2, 5.0  # rad/s and rad/s^2 of the fastest joint: most moves are short
LOG_PERIOD_S = 0.02
RECORDING_FPS = 8.0


@dataclass(frozen=True, eq=False)
class ProfilerCell:
    """The Diagram and its named parts."""

    diagram: Diagram
    station: Station
    scenario: Scenario
    procedure: ProfilerProcedure
    torch_log: VectorLogSink  # cheat: where the tip truly was


@dataclass(frozen=True, eq=False)
class ProfilerRun:
    """What one run left: the state, simulated seconds, and (truth) where the torch was while it followed the seam (n, 3) m."""

    state: ProfilerState
    seconds: float
    torch_B: Array


def make_room(scenario: Scenario, station: Station) -> Room:
    """What the procedure is told before it begins: drawings only."""
    job, profiler, spec = scenario.profiler_job, scenario.profiler, scenario.workpiece
    if job is None or not isinstance(profiler, RenderedProfiler):
        raise InputError("This scenario has no profiler: write profiler: !RenderedProfiler {} and profiler_job: {}.")
    return Room(
        arm=station.arm,
        job=job,
        q_home=np.deg2rad(scenario.home_deg),
        X_FS=drawn_pose(profiler),
        p_FTip=np.array(job.torch.tip_m),
        center=np.array(job.ball.xyz_m),
        cad=station.cad,
        X_BP=None if spec is None else spec.pose_guess.pose(),
        table_z_m=scenario.calibration.table_z_m,
    )


def make_profiler_cell(
    scenario: Scenario, seed: int = 0, meshcat: Meshcat | None = None, robot: PreparedRobot | None = None
) -> ProfilerCell:
    """Build the cell; what differs between drawing and world comes from `seed`. Whoever makes one closes its station.

    Raises:
        InputError: the scenario has no profiler, or cannot be done; nothing has moved.
    """
    station = make_station(scenario, seed, robot)
    try:
        return _make(scenario, station, seed, meshcat)
    except BaseException:
        station.close()
        raise


def _make(scenario: Scenario, station: Station, seed: int, meshcat: Meshcat | None) -> ProfilerCell:
    room, profiler = make_room(scenario, station), scenario.profiler
    assert isinstance(profiler, RenderedProfiler)
    builder = DiagramBuilder()
    builder.AddSystem(station.diagram)
    out, arm = station.diagram.GetOutputPort, station.arm
    procedure = builder.AddSystem(ProfilerProcedure(room, profiler, seed))
    procedure.set_name("profiler_procedure")
    error = builder.AddSystem(RobotError(arm, 1e-3 * room.job.robot_sigma_mm, seed))
    error.set_name("robot_error")
    recorder = builder.AddSystem(PoseRecorder())
    recorder.set_name("pose_recorder")
    factor = scenario.job.speed_factor
    mover = builder.AddSystem(FlangeMover(MOVE_SPEED * factor, MOVE_ACCELERATION * factor))
    mover.set_name("flange_mover")
    arbiter = builder.AddSystem(CommandArbiter())
    arbiter.set_name("command_arbiter")
    limits = SlewLimits(speed=0.6 * arm.velocity_limit, acceleration=0.5 * arm.acceleration_limit, jerk=JERK_LIMIT)
    limiter = builder.AddSystem(SlewLimiter(limits, CONTROL_PERIOD_S))
    limiter.set_name("slew_limiter")
    job, position = procedure.GetOutputPort("job"), error.GetOutputPort("position")
    for source, system, port in (
        (out("ur10e.position_measured"), error, "position_measured"),
        (job, error, "job"),
        (position, recorder, "position_measured"),
        (out("ur10e.sample_time"), recorder, "sample_time"),
        (position, procedure, "position"),
        (recorder.GetOutputPort("history"), procedure, "history"),
        (mover.GetOutputPort("settled_goal"), procedure, "settled_goal"),
        (out("ur10e.status"), procedure, "robot_status"),
        (out("profiler.profile"), procedure, "profile"),
        (out("torch.touch"), procedure, "touch"),
        (job, mover, "job"),
        (position, mover, "position_measured"),
        (out("ur10e.velocity_measured"), mover, "velocity_measured"),
        (job, arbiter, "job"),
        (out("ur10e.status"), arbiter, "robot_status"),
        (mover.GetOutputPort("velocity"), arbiter, "mover_velocity"),
        (procedure.GetOutputPort("creep"), arbiter, "servo_velocity"),
        (arbiter.GetOutputPort("velocity_wanted"), limiter, "velocity_wanted"),
        (limiter.get_output_port(), station.diagram, "ur10e.velocity_command"),
        (procedure.GetOutputPort("trigger"), station.diagram, "profiler.trigger"),
    ):
        builder.Connect(source, system.GetInputPort(port))
    torch_log = LogVectorOutput(out("cheat.torch"), builder, LOG_PERIOD_S)
    if meshcat is not None:
        MeshcatVisualizer.AddToBuilder(builder, out("query_object"), meshcat)
    diagram = builder.Build()
    diagram.set_name("profiler_cell")
    return ProfilerCell(diagram, station, scenario, procedure, torch_log)


def run_profiler_cell(cell: ProfilerCell, meshcat: Meshcat | None = None) -> ProfilerRun:
    """Run the procedure to its end (done, or held with a reason)."""
    simulator = Simulator(cell.diagram)

    def watch(root: Context) -> EventStatus:
        if _state(cell, root).phase in ("done", "held"):
            return EventStatus.ReachedTermination(cell.procedure, "the procedure ended")
        return EventStatus.DidNothing()

    simulator.set_monitor(watch)
    simulator.Initialize()
    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=RECORDING_FPS)
    job = cell.scenario.profiler_job
    assert job is not None
    simulator.AdvanceTo(job.maximum_time_s)
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
    root = simulator.get_context()
    state = _state(cell, root)
    log = cell.torch_log.FindLog(root)
    t = log.sample_times()
    followed = (t >= state.torch_from_s) & (t <= state.torch_until_s)
    return ProfilerRun(state, float(root.get_time()), np.array(log.data().T[followed]))


def _state(cell: ProfilerCell, root: Context) -> ProfilerState:
    state: ProfilerState = cell.procedure.GetOutputPort("state").Eval(cell.procedure.GetMyContextFromRoot(root))
    return state
