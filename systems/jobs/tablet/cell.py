"""The tablet cell: one Diagram of the station with pen, wrist camera and tablet, and the procedure that calibrates them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, Role
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from weldcal.calibration.planning.clearance import Body, arm_bodies
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.arms.urdf import Capsule
from weldcal.models.errors import InputError
from weldcal.systems.cell import JERK_LIMIT, MOVE_ACCELERATION, MOVE_SPEED, MOVE_TIMEOUT_S, Wiring, panel
from weldcal.systems.drivers.no_device import NoDevice
from weldcal.systems.drivers.simulated.rendered_wrist_camera import RenderedWristCamera
from weldcal.systems.drivers.station_build import PreparedRobot
from weldcal.systems.jobs.tablet.config import TabletConfig
from weldcal.systems.jobs.tablet.messages import TabletTruth, WristPicture
from weldcal.systems.jobs.tablet.procedure import TabletPlan, TabletProcedure, TabletState
from weldcal.systems.motion.clear_moves import check_way_home, clear_move
from weldcal.systems.motion.command_arbiter import CommandArbiter
from weldcal.systems.motion.flange_mover import FlangeMover
from weldcal.systems.motion.pose_recorder import PoseRecorder
from weldcal.systems.motion.slew_limiter import SlewLimiter
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station, make_station
from weldcal.welding.servo.guards import SlewLimits
from weldcal.welding.servo.settings import ServoConfig

Array = NDArray[np.float64]
PEN_BODY_M = 0.006  # radius of the pen where moves are to keep clear of the table
_LOOK_ASLANT_RAD = (0.12, -0.10)  # a view that is a little aslant fixes the tablet's tilt better than one square on
_LEAN_STEP_RAD = 2.4  # between the sides to which the pen leans, touch by touch: the golden angle, so none comes twice


@dataclass(frozen=True, eq=False)
class TabletCell:
    """The Diagram and its named parts; whoever makes one closes its station."""

    diagram: Diagram
    station: Station
    scenario: Scenario
    plan: TabletPlan
    procedure: TabletProcedure

    @property
    def tablet(self) -> TabletConfig:
        """The tablet as it is thought."""
        return _tablet(self.scenario)

    @property
    def camera(self) -> RenderedWristCamera:
        """The wrist camera as drawn."""
        return _camera(self.scenario)

    @property
    def truth(self) -> TabletTruth:
        """What only the simulation knows; for reports and tests."""
        truth = self.station.truth.tablet
        if truth is None:
            raise RuntimeError("a station with a tablet knows where it is")
        return truth

    def state(self, root: Context) -> TabletState:
        """Where the procedure stands in a context of the whole Diagram."""
        return self.procedure.stands(self.procedure.GetMyContextFromRoot(root))

    def picture(self, root: Context) -> WristPicture:
        """The camera's newest picture."""
        station = self.station.diagram
        shown: WristPicture = station.GetOutputPort("wrist_camera.picture").Eval(station.GetMyContextFromRoot(root))
        return shown


def _tablet(scenario: Scenario) -> TabletConfig:
    if scenario.tablet is None:
        raise InputError("This scenario has no tablet: write tablet: {} and tool: pen in it, or run scenario 'tablet'.")
    return scenario.tablet


def _camera(scenario: Scenario) -> RenderedWristCamera:
    if isinstance(scenario.wrist_camera, NoDevice):
        raise InputError(
            "A visit to the tablet needs a camera: write wrist_camera: !RenderedWristCamera {} in the scenario."
        )
    return scenario.wrist_camera


def nearest_joints(arm: ArmModel, X_BF: RigidTransform, q_near: Array) -> Array:
    """The joints (6,) for a flange pose that lie nearest to others, whole turns included; raises InputError: no reach."""
    found = inverse_kinematics(arm, X_BF)
    if len(found) == 0:
        raise InputError("The arm cannot reach the tablet where it is thought to lie; move it nearer in the scenario.")
    turns = found + 2.0 * np.pi * np.round((q_near - found) / (2.0 * np.pi))
    inside = np.all((turns >= arm.position_lower) & (turns <= arm.position_upper), axis=1)
    turns = np.where(np.reshape(inside, (-1, 1)), turns, found)
    return np.asarray(turns[np.abs(turns - q_near).max(axis=1).argmin()])


def plan_tablet(scenario: Scenario, arm: ArmModel) -> TabletPlan:
    """Where to look from and how to come down on each landmark, by the drawing alone.

    Raises:
        InputError: the scenario has no tablet, or a pose is out of reach.
    """
    tablet, X_FC = _tablet(scenario), _camera(scenario).nominal()
    q_home = np.deg2rad(scenario.home_deg)
    X_BT, page, p_FP = tablet.pose(), tablet.landmarks_m(), np.array(tablet.pen.tip_m)
    middle = X_BT.multiply(np.r_[0.5 * page.max(axis=0), 0.0])
    R_BC = X_BT.rotation() @ RotationMatrix(RollPitchYaw(*_LOOK_ASLANT_RAD, 0.0))
    X_BC = RigidTransform(R_BC, middle - R_BC.multiply(np.array([0.0, 0.0, 1e-3 * tablet.look_distance_mm])))
    q_look = nearest_joints(arm, X_BC @ X_FC.inverse(), q_home)
    start = RollPitchYaw(forward_kinematics(arm, q_home).rotation()).yaw_angle()
    above, q = [], q_look
    for k, p in enumerate(page):
        side = _LEAN_STEP_RAD * k
        lean = np.deg2rad(tablet.tilt_deg) * np.array([np.cos(side), np.sin(side)]) * (k > 0)
        turn = start + np.deg2rad(tablet.turn_deg) * (k - 0.5 * (len(page) - 1))
        R = RollPitchYaw(np.pi + lean[0], lean[1], turn).ToRotationMatrix()
        tip = X_BT.multiply(np.r_[p, 0.0]) + np.array([0.0, 0.0, 1e-3 * tablet.clearance_mm])
        q = nearest_joints(arm, RigidTransform(R, tip - R.multiply(p_FP)), q)
        above.append(q)
    slower = 1.0 / scenario.job.speed_factor
    return TabletPlan(
        q_look=q_look,
        q_above=np.array(above),
        q_home=q_home,
        p_FP=p_FP,
        descent_m_s=1e-3 * tablet.descent_mm_s,
        longest_descent_s=(tablet.clearance_mm + tablet.deepest_mm) / tablet.descent_mm_s,
        move_timeout_s=MOVE_TIMEOUT_S * slower,
        maximum_time_s=scenario.job.maximum_time_s * slower,
    )


def check_moves(scenario: Scenario, station: Station, plan: TabletPlan) -> None:
    """Every move straight in joint space must keep arm and pen above the table and off the arm.

    Raises:
        InputError: one would not; nothing has moved.
    """
    pen = Capsule(6, np.zeros(3), plan.p_FP, PEN_BODY_M)
    bodies: list[Body] = arm_bodies(station.arm, (pen,))
    goals = [plan.q_home, plan.q_look, *plan.q_above, plan.q_home]
    names = ["home", "the look", *(f"landmark {k + 1}" for k in range(len(plan.q_above))), "home"]
    for k in range(len(goals) - 1):
        if not clear_move(scenario, station, bodies, goals[k], goals[k + 1]):
            raise InputError(
                f"The move from {names[k]} to {names[k + 1]} would touch the table or the arm itself: choose another home_deg, "
                "a smaller tablet.turn_deg, or another place for the tablet."
            )


def make_tablet_cell(
    scenario: Scenario, seed: int = 0, meshcat: Meshcat | None = None, robot: PreparedRobot | None = None
) -> TabletCell:
    """Build the cell; what differs between the drawing and the world comes from `seed`. `robot`: see make_station.

    Raises:
        InputError: the scenario cannot be done; nothing has moved.
    """
    _tablet(scenario)
    station = make_station(scenario, seed, robot)
    try:
        check_way_home(scenario, station)
        plan = plan_tablet(scenario, station.arm)
        check_moves(scenario, station, plan)
        return _make_tablet_cell(scenario, station, plan, meshcat)
    except BaseException:
        station.close()
        raise


def _make_tablet_cell(scenario: Scenario, station: Station, plan: TabletPlan, meshcat: Meshcat | None) -> TabletCell:
    builder = DiagramBuilder()
    builder.AddSystem(station.diagram)
    wiring = Wiring(builder, station, scenario, ServoConfig())
    out, into, arm, job = station.diagram.GetOutputPort, station.diagram.GetInputPort, station.arm, scenario.job
    q_measured = out("ur10e.position_measured")
    recorder = wiring.add("pose_recorder", PoseRecorder())
    wiring.connect(recorder, position_measured=q_measured, sample_time=out("ur10e.sample_time"))
    procedure = wiring.add("tablet_procedure", TabletProcedure(arm, plan))
    mover = wiring.add("flange_mover", FlangeMover(MOVE_SPEED * job.speed_factor, MOVE_ACCELERATION * job.speed_factor))
    command = procedure.GetOutputPort("job")
    wiring.connect(mover, job=command, position_measured=q_measured, velocity_measured=out("ur10e.velocity_measured"))
    wiring.connect(
        procedure,
        position_measured=q_measured,
        settled_goal=mover.GetOutputPort("settled_goal"),
        robot_status=out("ur10e.status"),
        history=recorder.GetOutputPort("history"),
        picture=out("wrist_camera.picture"),
        touch=out("digitizer.touch"),
        hold=wiring.zeros("nobody_holds", 1) if meshcat is None else panel(wiring, meshcat),
    )
    arbiter = wiring.add("command_arbiter", CommandArbiter())
    wiring.connect(
        arbiter,
        job=command,
        robot_status=out("ur10e.status"),
        mover_velocity=mover.GetOutputPort("velocity"),
        servo_velocity=procedure.GetOutputPort("descent"),
    )
    limits = SlewLimits(speed=0.6 * arm.velocity_limit, acceleration=0.5 * arm.acceleration_limit, jerk=JERK_LIMIT)
    limiter = wiring.add("slew_limiter", SlewLimiter(limits))
    wiring.connect(limiter, velocity_wanted=arbiter.GetOutputPort("velocity_wanted"))
    builder.Connect(limiter.get_output_port(), into("ur10e.velocity_command"))
    builder.Connect(procedure.GetOutputPort("trigger"), into("wrist_camera.trigger"))
    if meshcat is not None:
        period = 1.0 / scenario.visualization.recording_fps
        params = MeshcatVisualizerParams(role=Role.kIllustration, prefix="cell", publish_period=period)
        visualizer = MeshcatVisualizer(meshcat, params)
        visualizer.set_name("meshcat_visualizer")
        builder.AddSystem(visualizer)
        builder.Connect(out("query_object"), visualizer.query_object_input_port())
    diagram = builder.Build()
    diagram.set_name("tablet_cell")
    return TabletCell(diagram, station, scenario, plan, procedure)


@dataclass(frozen=True, eq=False)
class TabletVisit:
    """What one run of the procedure left: its state, the picture, simulated and wall seconds, when each phase began, and why a
    person ended it before its end (empty: nobody did)."""

    state: TabletState
    picture: WristPicture
    seconds: float
    wall_seconds: float = 0.0
    phases: tuple[tuple[str, float], ...] = ()
    interrupted: str = ""

    @property
    def done(self) -> bool:
        """Every landmark was touched and the arm is home."""
        return self.state.phase == "done" and not self.interrupted

    @property
    def reason(self) -> str:
        """Why it is not done."""
        return self.interrupted or self.state.reason
