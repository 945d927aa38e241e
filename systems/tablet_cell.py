"""The tablet cell: one Diagram of arm, wrist camera, pen and tablet, with the procedure that calibrates them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    Meshcat,
    MeshcatVisualizer,
    RenderCameraCore,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus
from pydrake.systems.primitives import Adder
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from weldcal.calibration.tablet.wrist import WristTouches
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, load_arm
from weldcal.models.errors import InputError
from weldcal.systems.cell import JERK_LIMIT, MOVE_ACCELERATION, MOVE_SPEED
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.drivers.tablet_world import TabletTruth, build_tablet_world, draw_truth
from weldcal.systems.drivers.wrist_devices import TabletDigitizer, WristCamera, WristPicture
from weldcal.systems.flange_mover import FlangeMover
from weldcal.systems.slew_limiter import SlewLimiter
from weldcal.systems.station import apply_driver_config
from weldcal.systems.tablet_procedure import TabletPlan, TabletProcedure, TabletState
from weldcal.systems.tablet_scenario import TabletScenario, landmarks_m
from weldcal.welding.guard import SlewLimits

Array = NDArray[np.float64]
RECORDING_FPS = 8.0


@dataclass(frozen=True, eq=False)
class TabletCell:
    """The Diagram and its named parts; `truth` is for reports and tests only."""

    diagram: Diagram
    scenario: TabletScenario
    arm: ArmModel
    procedure: TabletProcedure
    camera: WristCamera
    truth: TabletTruth

    @property
    def camera_matrix(self) -> Array:
        """K (3, 3) of the wrist camera, centre of the first pixel at (0, 0)."""
        r = self.scenario.rig
        return np.array([[r.focal_px, 0, 0.5 * (r.width - 1)], [0, r.focal_px, 0.5 * (r.height - 1)], [0, 0, 1.0]])


def nearest_joints(arm: ArmModel, X_BF: RigidTransform, q_near: Array) -> Array:
    """The joints (6,) for a flange pose that lie nearest to others, whole turns included; raises InputError: no reach."""
    found = inverse_kinematics(arm, X_BF)
    if len(found) == 0:
        raise InputError("The arm cannot reach the tablet where it is thought to lie; move it nearer in the scenario.")
    turns = found + 2.0 * np.pi * np.round((q_near - found) / (2.0 * np.pi))
    inside = np.all((turns >= arm.position_lower) & (turns <= arm.position_upper), axis=1)
    turns = np.where(np.reshape(inside, (-1, 1)), turns, found)
    return np.asarray(turns[np.abs(turns - q_near).max(axis=1).argmin()])


def plan_tablet(scenario: TabletScenario, arm: ArmModel) -> TabletPlan:
    """Where to look from and how to come down on each landmark, by the drawing alone.

    Raises:
        InputError: a pose is out of reach.
    """
    q_home = np.deg2rad(scenario.home_deg)
    X_BT, page = scenario.tablet.pose.pose(), landmarks_m(scenario.tablet)
    X_FC, p_FP = scenario.rig.camera.pose(), np.array(scenario.rig.pen_tip_m)
    middle = X_BT.multiply(np.r_[0.5 * page.max(axis=0), 0.0])
    # a view that is a little aslant fixes the tablet's tilt better than one square on
    R_BC = X_BT.rotation() @ RotationMatrix(RollPitchYaw(0.12, -0.10, 0.0))
    X_BC = RigidTransform(R_BC, middle - R_BC.multiply(np.array([0.0, 0.0, 1e-3 * scenario.look_distance_mm])))
    q_look = nearest_joints(arm, X_BC @ X_FC.inverse(), q_home)
    start = RollPitchYaw(forward_kinematics(arm, q_home).rotation()).yaw_angle()
    above, q = [], q_look
    for k, p in enumerate(page):
        lean = np.deg2rad(scenario.tilt_deg) * np.array([np.cos(2.4 * k), np.sin(2.4 * k)]) * (k > 0)
        turn = start + np.deg2rad(scenario.turn_deg) * (k - 0.5 * (len(page) - 1))
        R = RollPitchYaw(np.pi + lean[0], lean[1], turn).ToRotationMatrix()
        tip = X_BT.multiply(np.r_[p, 0.0]) + np.array([0.0, 0.0, 1e-3 * scenario.clearance_mm])
        q = nearest_joints(arm, RigidTransform(R, tip - R.multiply(p_FP)), q)
        above.append(q)
    longest = (scenario.clearance_mm + scenario.deepest_mm) / scenario.descent_mm_s
    return TabletPlan(q_look, np.array(above), q_home, p_FP, 1e-3 * scenario.descent_mm_s, longest)


def make_tablet_cell(scenario: TabletScenario, seed: int = 0, meshcat: Meshcat | None = None) -> TabletCell:
    """Build the cell; what differs between the drawing and the world comes from `seed`.

    Raises:
        InputError: the scenario cannot be done; nothing has moved.
    """
    rng = np.random.default_rng(seed)
    arm = load_arm(scenario.arm)
    plan = plan_tablet(scenario, arm)
    truth = draw_truth(scenario, rng)
    builder = DiagramBuilder()
    made = build_tablet_world(builder, arm, scenario, truth)
    plant, scene_graph, rig = made.world.plant, made.world.scene_graph, scenario.rig
    build = StationBuild(builder, arm, None, plan.q_home, rng, made.world)
    apply_driver_config(scenario.robot, build)

    cx, cy = 0.5 * (rig.width - 1), 0.5 * (rig.height - 1)
    view = made.world.scanner_view
    core = RenderCameraCore(
        view.renderer,
        # Drake samples pixel (u, v) at (u + 0.5, v + 0.5)
        CameraInfo(rig.width, rig.height, rig.focal_px, rig.focal_px, cx + 0.5, cy + 0.5),
        ClippingRange(0.02, 3.0),
        RigidTransform(),
    )
    flange = view.frames[plant.GetBodyByName("flange", made.world.arm).index()]
    sensor = builder.AddSystem(
        RgbdSensor(flange, truth.X_FC, ColorRenderCamera(core, False), DepthRenderCamera(core, DepthRange(0.05, 2.0)))
    )
    camera = builder.AddSystem(WristCamera(rig, int(rng.integers(2**31))))
    digitizer = builder.AddSystem(TabletDigitizer(scenario.tablet, made, truth.X_BT, int(rng.integers(2**31))))
    procedure = builder.AddSystem(TabletProcedure(arm, plan))
    mover = builder.AddSystem(FlangeMover(MOVE_SPEED, MOVE_ACCELERATION))
    both = builder.AddSystem(Adder(2, 6))
    limits = SlewLimits(speed=0.6 * arm.velocity_limit, acceleration=0.5 * arm.acceleration_limit, jerk=JERK_LIMIT)
    limiter = builder.AddSystem(SlewLimiter(limits))
    for system, name in (
        (sensor, "wrist_rgbd"), (camera, "wrist_camera"), (digitizer, "tablet"), (procedure, "tablet_procedure"),
        (mover, "flange_mover"), (limiter, "slew_limiter"),
    ):  # fmt: skip
        system.set_name(name)

    connect = builder.Connect
    connect(view.scene_graph.get_query_output_port(), sensor.query_object_input_port())
    connect(sensor.color_image_output_port(), camera.GetInputPort("color_image"))
    connect(sensor.depth_image_32F_output_port(), camera.GetInputPort("depth_image"))
    connect(plant.get_contact_results_output_port(), digitizer.GetInputPort("contact_results"))
    connect(procedure.GetOutputPort("trigger"), camera.GetInputPort("trigger"))
    connect(camera.GetOutputPort("picture"), procedure.GetInputPort("picture"))
    connect(digitizer.GetOutputPort("touch"), procedure.GetInputPort("touch"))
    connect(build.outputs["ur10e.position_measured"], procedure.GetInputPort("position_measured"))
    connect(build.outputs["ur10e.status"], procedure.GetInputPort("robot_status"))
    connect(procedure.GetOutputPort("job"), mover.GetInputPort("job"))
    connect(build.outputs["ur10e.position_measured"], mover.GetInputPort("position_measured"))
    connect(build.outputs["ur10e.velocity_measured"], mover.GetInputPort("velocity_measured"))
    connect(mover.GetOutputPort("settled_goal"), procedure.GetInputPort("settled_goal"))
    connect(mover.GetOutputPort("velocity"), both.get_input_port(0))
    connect(procedure.GetOutputPort("descent"), both.get_input_port(1))
    connect(both.get_output_port(), limiter.get_input_port())
    connect(limiter.get_output_port(), build.inputs["ur10e.velocity_command"])
    if meshcat is not None:
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    diagram = builder.Build()
    diagram.set_name("tablet_cell")
    return TabletCell(diagram, scenario, arm, procedure, camera, truth)


@dataclass(frozen=True, eq=False)
class TabletVisit:
    """What one run of the procedure left: its state, the picture, and simulated seconds."""

    state: TabletState
    picture: WristPicture
    seconds: float


def run_tablet_cell(cell: TabletCell, meshcat: Meshcat | None = None) -> TabletVisit:
    """Run the procedure to its end (done, or held with a reason); the viewer that the cell was built with records it."""
    simulator = Simulator(cell.diagram)

    def watch(root: Context) -> EventStatus:
        if _state(cell, root).phase in ("done", "held"):
            return EventStatus.ReachedTermination(cell.procedure, "the procedure ended")
        return EventStatus.DidNothing()

    simulator.set_monitor(watch)
    simulator.Initialize()
    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=RECORDING_FPS)
    simulator.AdvanceTo(cell.scenario.maximum_time_s)
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
    root = simulator.get_context()
    picture: WristPicture = cell.camera.GetOutputPort("picture").Eval(cell.camera.GetMyContextFromRoot(root))
    return TabletVisit(_state(cell, root), picture, float(root.get_time()))


def _state(cell: TabletCell, root: Context) -> TabletState:
    state: TabletState = cell.procedure.GetOutputPort("state").Eval(cell.procedure.GetMyContextFromRoot(root))
    return state


def wrist_touches(cell: TabletCell, visit: TabletVisit, uv_px: Array) -> WristTouches:
    """The visit in the form that fit_wrist takes, with the landmarks (n, 2) px found in its picture."""
    K, tablet = cell.camera_matrix, cell.scenario.tablet
    touched = 1e-3 * np.array([t.position_px for t in visit.state.touches]) / tablet.px_per_mm
    rays = (uv_px - K[:2, 2]) / K[0, 0]
    return WristTouches(
        X_BF=tuple(forward_kinematics(cell.arm, t.q) for t in visit.state.touches),
        touched_m=touched,
        landmark_m=landmarks_m(tablet),
        views=((forward_kinematics(cell.arm, visit.state.q_look), rays),),
        focal_px=float(K[0, 0]),
        tip_radius_m=1e-3 * cell.scenario.rig.pen_radius_mm,
    )
