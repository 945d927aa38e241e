"""The cell of a mounting: one Diagram of station, procedure, calibrator and a mover for each arm, for all five configurations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from weldcal.calibration.planning.mounting_poses import MountingPlan, MountingPose, plan_mounting_poses
from weldcal.calibration.planning.mounting_scene import FLANGE, MountingScene
from weldcal.models.arms.kinematics import LINKS, ArmModel, load_arm
from weldcal.models.base_circles import base_circle
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, get_flange
from weldcal.systems.cell import JERK_LIMIT, MOVE_ACCELERATION, MOVE_SPEED
from weldcal.systems.drivers.no_device import NoDevice
from weldcal.systems.drivers.simulated.second_arm import SECOND
from weldcal.systems.jobs.mounting.calibrator import MountingCalibrator, MountingFitConfig
from weldcal.systems.jobs.mounting.messages import MountingState, MountingStatus
from weldcal.systems.jobs.mounting.procedure import MountingProcedure
from weldcal.systems.motion.flange_mover import FlangeMover
from weldcal.systems.motion.pose_recorder import PoseRecorder
from weldcal.systems.motion.slew_limiter import SlewLimiter
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station, make_station
from weldcal.welding.servo.guards import SlewLimits

Array = NDArray[np.float64]

RECORDING_FPS = 8.0
LOOK_PERIOD_S = (
    0.1  # how often it is asked whether the procedure has ended: asking at every step costs a tenth of the run
)
LIMITER_PERIOD_S = 0.004  # nothing is touched: half the rate of a weld will do
SPARE = 8  # poses beyond those that are visited: the next best one is named among them
FOOT = ("eye_in_hand", "eye_on_arm_target_on_base")
"""Configurations that look at the circle of the base mounting; the others look at a flange."""


@dataclass(frozen=True, eq=False)
class MountingCell:
    """The Diagram and its named parts; `truth` (X, and Y or Z as far as they are sought) is for reports and tests only."""

    diagram: Diagram
    station: Station
    scenario: Scenario
    scene: MountingScene
    plan: tuple[MountingPose, ...]
    procedure: MountingProcedure
    calibrator: MountingCalibrator
    truth: dict[str, RigidTransform]

    def state(self, root: Context) -> MountingState:
        """Where the procedure stands."""
        state: MountingState = self.procedure.GetOutputPort("state").Eval(self.procedure.GetMyContextFromRoot(root))
        return state

    def status(self, root: Context) -> MountingStatus:
        """What the calibration has come to."""
        status: MountingStatus = self.calibrator.GetOutputPort("status").Eval(
            self.calibrator.GetMyContextFromRoot(root)
        )
        return status


def mounting_scene(scenario: Scenario, arm: ArmModel) -> tuple[MountingScene, FlangeStandard]:
    """What is believed before the first scan, from the drawing and the tape measure; and the circle to look for."""
    job, c = scenario.mounting, scenario.calibration
    if job is None or isinstance(scenario.scanner, NoDevice):
        raise InputError("A mounting job needs a scanner and a mounting part: write mounting: {} in the scenario.")
    carrier = scenario.scanner.mounted_on
    link = {"base": 0, "flange": FLANGE}.get(carrier, 1 + LINKS.index(carrier) if carrier in LINKS else 0)
    circle = base_circle(scenario.arm) if c.configuration in FOOT else None
    standard = get_flange(scenario.flange) if circle is None else circle.standard
    second = job.second_arm
    scene = MountingScene(
        configuration=c.configuration,
        arm=arm,
        link=link,
        X_LC=c.mounting_guess.pose(),
        X_HR=RigidTransform() if circle is None else circle.X_BR,
        radius_m=0.5 * standard.outer_m,
        scanner=scenario.scanner.scanner(),
        q_home=np.deg2rad(scenario.home_deg),
        target_known=job.target_known,
        arm_2=None if second is None else load_arm(second.arm),
        X_BD=None if second is None else second.pose(),
        q_home_2=None if second is None else np.deg2rad(second.home_deg),
    )
    return scene, standard


def plan_mounting(scenario: Scenario, scene: MountingScene, seed: int) -> tuple[MountingPose, ...]:
    """Poses of the calibration, those kept aside, and spare ones; nothing has moved. Raises UnreachableScanner."""
    c, job = scenario.calibration, scenario.mounting
    assert job is not None
    visited = c.maximum_scans + c.verification_scans
    plan = MountingPlan(
        seed=seed,
        theta_max_rad=np.deg2rad(c.theta_max_deg),
        spread_rad=np.deg2rad(job.spread_deg),
        max_travel_rad=np.deg2rad(job.travel_deg),
        table_z_m=c.table_z_m,
        margin_m=c.clearance_m,
        candidates=visited + SPARE,
    )
    return plan_mounting_poses(scene, c.maximum_scans, c.verification_scans, plan)


def make_mounting_cell(scenario: Scenario, seed: int = 0, meshcat: Meshcat | None = None) -> MountingCell:
    """Build the cell; what differs between the drawing and the world comes from `seed`.

    Raises:
        InputError, UnreachableScanner: the scenario cannot be done; nothing has moved.
    """
    c = scenario.calibration
    station = make_station(scenario, seed)
    try:
        scene, standard = mounting_scene(scenario, station.arm)
        plan = plan_mounting(scenario, scene, seed)
    except BaseException:
        station.close()
        raise
    builder = DiagramBuilder()
    builder.AddSystem(station.diagram)
    out, connect = station.diagram.GetOutputPort, builder.Connect
    home = (scene.q_home, scene.q_home_2)
    procedure = builder.AddSystem(MountingProcedure(plan, c.maximum_scans, c.verification_scans, home))
    procedure.set_name("mounting_procedure")
    fit = MountingFitConfig(
        standard,
        c.guess_radius_mm * 1e-3,
        c.configuration in FOOT,
        c.minimum_scans,
        c.required_error_mm * 1e-3,
    )
    calibrator = builder.AddSystem(MountingCalibrator(scene, fit, plan))
    calibrator.set_name("mounting_calibrator")
    connect(out("scanner.scan"), calibrator.GetInputPort("scan"))
    connect(procedure.GetOutputPort("state"), calibrator.GetInputPort("state"))
    connect(calibrator.GetOutputPort("status"), procedure.GetInputPort("status"))
    connect(procedure.GetOutputPort("trigger"), station.diagram.GetInputPort("scanner.trigger"))
    arms = (("ur10e", "", station.arm), (SECOND, "_2", scene.arm_2))
    for prefix, suffix, arm in arms:
        if arm is None:
            continue
        recorder = builder.AddSystem(PoseRecorder())
        factor = scenario.job.speed_factor
        mover = builder.AddSystem(FlangeMover(MOVE_SPEED * factor, MOVE_ACCELERATION * factor))
        limits = SlewLimits(speed=0.6 * arm.velocity_limit, acceleration=0.5 * arm.acceleration_limit, jerk=JERK_LIMIT)
        limiter = builder.AddSystem(SlewLimiter(limits, LIMITER_PERIOD_S))
        for system, name in ((recorder, "pose_recorder"), (mover, "flange_mover"), (limiter, "slew_limiter")):
            system.set_name(name + suffix)
        measured = out(f"{prefix}.position_measured")
        connect(measured, recorder.GetInputPort("position_measured"))
        connect(out(f"{prefix}.sample_time"), recorder.GetInputPort("sample_time"))
        connect(recorder.GetOutputPort("history"), calibrator.GetInputPort(f"history{suffix}"))
        connect(procedure.GetOutputPort(f"job{suffix}"), mover.GetInputPort("job"))
        connect(measured, mover.GetInputPort("position_measured"))
        connect(out(f"{prefix}.velocity_measured"), mover.GetInputPort("velocity_measured"))
        connect(mover.GetOutputPort("settled_goal"), procedure.GetInputPort(f"settled_goal{suffix}"))
        connect(mover.GetOutputPort("velocity"), limiter.get_input_port())
        connect(limiter.get_output_port(), station.diagram.GetInputPort(f"{prefix}.velocity_command"))
        connect(out(f"{prefix}.status"), procedure.GetInputPort(f"robot_status{suffix}"))
    if meshcat is not None:
        MeshcatVisualizer.AddToBuilder(builder, out("query_object"), meshcat)
    diagram = builder.Build()
    diagram.set_name("mounting_cell")
    return MountingCell(diagram, station, scenario, scene, plan, procedure, calibrator, _truth(scene, station))


def _truth(scene: MountingScene, station: Station) -> dict[str, RigidTransform]:
    """The unknowns as they are: in simulation the circle sits exactly where the drawing says."""
    found = {} if station.truth.X_LC is None else {"X": station.truth.X_LC}
    if station.truth.X_BD is not None:
        found["Y"] = station.truth.X_BD
    if not scene.target_known:
        found["Z" if scene.two else "Y"] = scene.X_HR
    return found


@dataclass(frozen=True, eq=False)
class MountingRun:
    """What one run of the procedure left, and its simulated seconds."""

    cell: MountingCell
    root: Context
    state: MountingState
    status: MountingStatus
    seconds: float


def run_mounting_cell(cell: MountingCell, meshcat: Meshcat | None = None) -> MountingRun:
    """Run the procedure to its end (done, or held with a reason); the viewer that the cell was built with records it."""
    simulator = Simulator(cell.diagram)
    simulator.Initialize()
    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=RECORDING_FPS)
    root = simulator.get_mutable_context()
    end = cell.scenario.job.maximum_time_s / cell.scenario.job.speed_factor
    while root.get_time() < end and cell.state(root).phase not in ("done", "held"):
        simulator.AdvanceTo(min(root.get_time() + LOOK_PERIOD_S, end))
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
    return MountingRun(cell, root, cell.state(root), cell.status(root), float(root.get_time()))
