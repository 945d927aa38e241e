"""Every system has exactly the ports that its docstring shows, of the size and kind that the rest of the cell counts
on."""

from __future__ import annotations

import gc
import importlib
import inspect
import pkgutil
import textwrap
import weakref
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from pydrake.common.yaml import yaml_load
from pydrake.geometry import FramePoseVector, GeometryId, Meshcat, MeshcatParams
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import InputPort, OutputPort, PortDataType
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

import weldcal.systems
from tests.systems.cells import Q_HOME, TOOL, plain_station, the_arm
from tests.systems.drivers.sensors.scripted import Scripted
from tests.systems.drivers.still_link import StillLink
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.planning.mounting_estimate import Circle
from weldcal.models.flanges import get_flange
from weldcal.models.scanner_streams import ScannerStream
from weldcal.models.scanners import get_scanner
from weldcal.models.tools.elastomers import MATERIALS
from weldcal.models.workpieces.plate import make_workpiece
from weldcal.systems.background import BackgroundSystem
from weldcal.systems.bodies.relaxing_tip import RelaxingTip
from weldcal.systems.drivers.power.modbus import ModbusPowerSourcePorts, PowerLink
from weldcal.systems.drivers.sensors.acquisition import Acquisition, Rules
from weldcal.systems.drivers.sensors.watch import DeviceWatch, OnTrigger
from weldcal.systems.drivers.sensors.wired_camera import WiredPictures
from weldcal.systems.drivers.sensors.wired_scanner import WiredScanStream
from weldcal.systems.drivers.simulated.picture_scene import DisplacedStand, PicturePoses
from weldcal.systems.drivers.simulated.power_source import SimulatedArc, SimulatedPowerSource
from weldcal.systems.drivers.simulated.profiler_world import ProfilerFixture
from weldcal.systems.drivers.simulated.rendered_finger_camera import RenderedFingerCamera, StreamingCamera
from weldcal.systems.drivers.simulated.rendered_profiler import (
    CheatTorch,
    ProfilerSensor,
    RenderedProfiler,
    TouchSensor,
)
from weldcal.systems.drivers.simulated.rendered_scanner import DepthSensor
from weldcal.systems.drivers.simulated.rendered_wrist_camera import RenderedWristCamera, WristCamera
from weldcal.systems.drivers.simulated.streaming_scanner import DepthStream, StreamingScanner
from weldcal.systems.drivers.simulated.tablet_world import SimulatedTablet, TabletDigitizer
from weldcal.systems.drivers.simulated.ur import SimulatedUr, SpeedJointServo
from weldcal.systems.drivers.ur.rtde import UrRtdeArm
from weldcal.systems.drivers.ur.touch_probe import ProbeInput, Touches, UrTouchProbeInput
from weldcal.systems.jobs.motion.procedure import (
    MotionCalibration,
    MotionCalibrator,
    MotionCollector,
    MotionProcedure,
    MotionRecord,
    MotionRecorder,
    MotionState,
)
from weldcal.systems.jobs.mounting.job import MountingCalibrator, MountingFitConfig, mounting_scene
from weldcal.systems.jobs.mounting.procedure import MountingProcedure, MountingState, MountingStatus
from weldcal.systems.jobs.procedure import Procedure
from weldcal.systems.jobs.profiler.config import ProfilerJob
from weldcal.systems.jobs.profiler.job import RobotError, draw_fixture
from weldcal.systems.jobs.profiler.plan import PlanningContext
from weldcal.systems.jobs.profiler.procedure import ProfilerProcedure, ProfilerState
from weldcal.systems.jobs.tablet.config import TabletTouch, WristPicture
from weldcal.systems.jobs.tablet.job import plan_tablet
from weldcal.systems.jobs.tablet.procedure import TabletProcedure, TabletState
from weldcal.systems.jobs.tool_scan.job import ToolScanProcedure, ToolScanState
from weldcal.systems.jobs.touch.planner import PlannedTouches, TouchConfig, TouchPlanner, TouchPlanning
from weldcal.systems.jobs.touch.procedure import TouchMotion, TouchProcedure, TouchState
from weldcal.systems.jobs.weld.arc_schedule import ArcSchedule
from weldcal.systems.jobs.weld.aruco_deformation_estimator import ArucoDeformationEstimator, Deformation
from weldcal.systems.jobs.weld.flange_estimator import FlangeEstimator
from weldcal.systems.jobs.weld.iterative_calibrator import (
    CalibrationPosePlanner,
    CalibratorConfig,
    IterativeCalibrator,
    PoseRequest,
)
from weldcal.systems.jobs.weld.seam_planner import DrawnSeamPlanner, SeamPlanner
from weldcal.systems.jobs.weld.seam_planning import SeamPlanning
from weldcal.systems.jobs.weld.sequencer import JobPlan, JobSequencer, JobState
from weldcal.systems.jobs.weld.welding_velocity_servo import TELEMETRY, ServoReport, WeldingVelocityServo
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import (
    CalibrationStatus,
    FlangeEstimate,
    Image,
    JobCommand,
    PlannedSeam,
    ProfileScan,
    Scan,
    ScanStream,
    StreamedScan,
    TorchTouch,
    UrStatus,
)
from weldcal.systems.motion.buffers import FrameQueue, PoseHistory, PoseRecorder
from weldcal.systems.motion.drift_monitor import DriftMonitor, DriftStatus, MonitoredCalibration
from weldcal.systems.motion.flange_mover import FlangeMover
from weldcal.systems.motion.guarded_path import SingularityGuard
from weldcal.systems.motion.spine import CommandArbiter, OperatorPanel, ProcessSwitch, SlewLimiter
from weldcal.systems.operator import Operator
from weldcal.systems.recording.player import PortPlayer
from weldcal.systems.recording.port_recorder import PortRecorder, PortSink
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import VisualizationConfig
from weldcal.systems.station import CheatPoses
from weldcal.systems.viewer.cameras import CameraDirector, Views
from weldcal.systems.viewer.cell_visualizer import CellVisualizer
from weldcal.systems.viewer.drift_view import DriftView
from weldcal.systems.viewer.live import LiveView, LiveWriter
from weldcal.systems.wall_clock import WallClock
from weldcal.welding.record.schedule import WeldSchedule
from weldcal.welding.servo.guards import SlewLimits
from weldcal.welding.servo.settings import ServoConfig

X = RigidTransform()
IDEAL = get_scanner("ideal", width=206, height=154)
CALIBRATOR = CalibratorConfig(required_error_m=1e-4, minimum_scans=6, maximum_scans=10, p_BWork=np.zeros(3))
JOB = JobPlan(
    calibrate=True,
    weld=True,
    q_home=Q_HOME,
    maximum_scans=10,
    verification_scans=1,
    verification_limit_m=5e-4,
    required_error_m=1e-4,
)
TOUCH = TouchMotion(
    q_home=Q_HOME, descent_m_s=3e-3, press_m=1e-3, deepest_m=6e-3, move_timeout_s=20.0, maximum_time_s=240.0
)


def profiler_fixture() -> ProfilerFixture:
    """A fixture with nothing off its drawing."""
    return draw_fixture(X, 0.0, 0.0, ProfilerJob(), np.random.default_rng(0), 0.0, None, None)


def profiler_planning() -> PlanningContext:
    """What a procedure without a seam is told."""
    job = ProfilerJob(stages=["edge"])
    return PlanningContext(
        arm=the_arm(), job=job, q_home=Q_HOME, X_FS=X, p_FTip=np.array(job.torch.tip_m), center=np.array(job.ball.xyz_m)
    )


def seam_planning() -> SeamPlanning:
    return SeamPlanning(
        arm=the_arm(),
        tool=TOOL,
        workpiece=make_workpiece("straight"),
        X_BP_guess=X,
        config=ServoConfig(),
        q_near=Q_HOME,
        clearance_m=0.025,
        seam_length_m=None,
    )


def acquisition() -> Acquisition[Any]:
    """Of a device that sends nothing."""
    return Acquisition(Scripted(), Rules())


MAKERS: dict[type[LeafSystem], Callable[[], LeafSystem]] = {
    SpeedJointServo: lambda: SpeedJointServo(the_arm(), SimulatedUr(), Q_HOME),
    UrRtdeArm: lambda: UrRtdeArm(the_arm(), StillLink(Q_HOME), WallClock(1.0)),
    DepthSensor: lambda: DepthSensor(IDEAL, 0, 0.1),
    StreamingCamera: lambda: StreamingCamera(
        RenderedFingerCamera(), 0, 0.002, lambda poses: np.zeros((300, 400), np.uint8)
    ),
    DepthStream: lambda: DepthStream(IDEAL, ScannerStream(), StreamingScanner(), 0, 0.002),
    UrTouchProbeInput: lambda: UrTouchProbeInput(cast("ProbeInput", SimpleNamespace(touches=Touches()))),
    SimulatedArc: lambda: SimulatedArc(SimulatedPowerSource()),
    RelaxingTip: lambda: RelaxingTip(MATERIALS["tpu_95a"], 0.002),
    ModbusPowerSourcePorts: lambda: ModbusPowerSourcePorts(
        cast("PowerLink", SimpleNamespace(shown={"arc_established": 0.0}, command=lambda on, values: None))
    ),
    ArcSchedule: lambda: ArcSchedule(WeldSchedule()),
    DeviceWatch: lambda: DeviceWatch(acquisition()),
    OnTrigger: lambda: OnTrigger(acquisition(), "scan", Scan, 0.02),
    WiredScanStream: lambda: WiredScanStream(acquisition()),
    WiredPictures: lambda: WiredPictures(acquisition()),
    FrameQueue: FrameQueue,
    MotionProcedure: lambda: MotionProcedure((Q_HOME, Q_HOME), Q_HOME, 40),
    MotionCollector: MotionCollector,
    MotionCalibrator: lambda: MotionCalibrator(the_arm()),
    MotionRecorder: lambda: MotionRecorder(Path("unused")),
    PoseRecorder: PoseRecorder,
    FlangeEstimator: lambda: FlangeEstimator(the_arm(), X, get_flange("tool-ring-63"), X, 0.06),
    IterativeCalibrator: lambda: IterativeCalibrator(the_arm(), X, CALIBRATOR),
    CalibrationPosePlanner: lambda: CalibrationPosePlanner(()),
    SeamPlanner: lambda: SeamPlanner(seam_planning()),
    DrawnSeamPlanner: lambda: DrawnSeamPlanner(seam_planning()),
    PicturePoses: lambda: PicturePoses(plain_station().world.plant, plain_station().world.scanner_view.frames),
    DisplacedStand: lambda: DisplacedStand(plain_station().world.scanner_view.scene_graph.world_frame_id(), 1.0, X),
    ArucoDeformationEstimator: lambda: ArucoDeformationEstimator(the_arm(), TOOL, RenderedFingerCamera().camera()),
    WeldingVelocityServo: lambda: WeldingVelocityServo(the_arm(), TOOL, ServoConfig()),
    SingularityGuard: lambda: SingularityGuard(the_arm(), TOOL.X_FT),
    DriftMonitor: lambda: DriftMonitor(the_arm(), X, MonitoredCalibration(X, np.eye(6))),
    ProcessSwitch: ProcessSwitch,
    CommandArbiter: CommandArbiter,
    FlangeMover: FlangeMover,
    SlewLimiter: lambda: SlewLimiter(SlewLimits()),
    JobSequencer: lambda: JobSequencer(JOB),
    DriftView: lambda: DriftView(Meshcat(MeshcatParams(host="localhost", port=0)), 0.03, VisualizationConfig()),
    CellVisualizer: lambda: CellVisualizer(
        Meshcat(MeshcatParams(host="localhost", port=0)), TOOL, X, 0.03, VisualizationConfig()
    ),
    PortRecorder: lambda: PortRecorder((6, 2), {}, {}, cast("PortSink", None)),
    PortPlayer: lambda: PortPlayer({}, {}),
    OperatorPanel: lambda: OperatorPanel(Operator(), Meshcat(MeshcatParams(host="localhost", port=0))),
    CameraDirector: lambda: CameraDirector(
        Meshcat(MeshcatParams(host="localhost", port=0)), Views(), (np.ones(3), np.zeros(3)), {}, X
    ),
    LiveWriter: lambda: LiveWriter(LiveView(), {}, None),
    CheatPoses: lambda: CheatPoses(plain_station().world, TOOL),
    TabletProcedure: lambda: TabletProcedure(the_arm(), plan_tablet(load_scenario("tablet"), the_arm())),
    TouchPlanner: lambda: TouchPlanner(
        TouchPlanning(cast("SeamPlanning", None), X, ScannerCorrection(), TouchConfig())
    ),
    TouchProcedure: lambda: TouchProcedure(the_arm(), TOOL, TOUCH),
    ToolScanProcedure: lambda: ToolScanProcedure((), Q_HOME),
    WristCamera: lambda: WristCamera(RenderedWristCamera(), 0),
    MountingProcedure: lambda: MountingProcedure((), 0, 0, (Q_HOME, None)),
    MountingCalibrator: lambda: MountingCalibrator(
        mounting_scene(load_scenario("eye_on_arm"), the_arm())[0],
        MountingFitConfig(Circle(get_flange("tool-ring-63"), 0.06, False), 6, 1e-4),
        (),
    ),
    ProfilerSensor: lambda: ProfilerSensor(RenderedProfiler(), profiler_fixture(), BodyIndex(7), 0, 0.004),
    TouchSensor: lambda: TouchSensor(frozenset(), 0.004),
    CheatTorch: lambda: CheatTorch(profiler_fixture(), BodyIndex(7)),
    RobotError: lambda: RobotError(the_arm(), 6e-5, 0),
    ProfilerProcedure: lambda: ProfilerProcedure(profiler_planning(), RenderedProfiler(), 0),
    TabletDigitizer: lambda: TabletDigitizer(
        SimulatedTablet(), 5256.0, {GeometryId.get_new_id(), GeometryId.get_new_id()}, X, 0
    ),
}

# What travels on each port: a vector of that many numbers, or a message of that type.
KINDS: dict[type[LeafSystem], dict[str, int | type]] = {
    ProfilerSensor: {"trigger": 1, "body_poses": list, "profile": ProfileScan},
    TouchSensor: {"contact_results": ContactResults, "touch": TorchTouch},
    CheatTorch: {"body_poses": list, "torch": 3},
    RobotError: {"position_measured": 6, "job": JobCommand, "position": 6},
    ProfilerProcedure: {
        "position": 6,
        "history": PoseHistory,
        "settled_goal": 1,
        "robot_status": UrStatus,
        "profile": ProfileScan,
        "touch": TorchTouch,
        "hold": 1,
        "job": JobCommand,
        "creep": 6,
        "trigger": 1,
        "state": ProfilerState,
    },
    TabletProcedure: {
        "position_measured": 6,
        "settled_goal": 1,
        "robot_status": UrStatus,
        "history": PoseHistory,
        "picture": WristPicture,
        "touch": TabletTouch,
        "hold": 1,
        "job": JobCommand,
        "descent": 6,
        "trigger": 1,
        "state": TabletState,
    },
    TouchPlanner: {"scan": Scan, "job": JobCommand, "planned_touches": PlannedTouches},
    ToolScanProcedure: {
        "position_measured": 6,
        "settled_goal": 1,
        "robot_status": UrStatus,
        "scan": Scan,
        "hold": 1,
        "job": JobCommand,
        "trigger": 1,
        "state": ToolScanState,
    },
    TouchProcedure: {
        "position_measured": 6,
        "settled_goal": 1,
        "robot_status": UrStatus,
        "planned_touches": PlannedTouches,
        "deformation": Deformation,
        "hold": 1,
        "job": JobCommand,
        "descent": 6,
        "trigger": 1,
        "streaming": 1,
        "state": TouchState,
    },
    MountingProcedure: {
        "settled_goal": 1,
        "settled_goal_2": 1,
        "robot_status": UrStatus,
        "robot_status_2": UrStatus,
        "status": MountingStatus,
        "hold": 1,
        "position_measured": 6,
        "job": JobCommand,
        "job_2": JobCommand,
        "trigger": 1,
        "state": MountingState,
    },
    MountingCalibrator: {
        "scan": Scan,
        "state": MountingState,
        "history": PoseHistory,
        "history_2": PoseHistory,
        "status": MountingStatus,
    },
    WristCamera: {"trigger": 1, "color_image": ImageRgba8U, "depth_image": ImageDepth32F, "picture": WristPicture},
    TabletDigitizer: {"contact_results": ContactResults, "touch": TabletTouch},
    SpeedJointServo: {
        "velocity_command": 6,
        "arm_state": 12,
        "arm_acceleration": 6,
        "desired_state": 12,
        "position_measured": 6,
        "velocity_measured": 6,
        "X_BF": RigidTransform,
        "sample_time": 1,
        "status": UrStatus,
    },
    UrRtdeArm: {
        "velocity_command": 6,
        "process_on": 1,
        "set_values": 4,
        "desired_state": 12,
        "position_measured": 6,
        "velocity_measured": 6,
        "X_BF": RigidTransform,
        "sample_time": 1,
        "status": UrStatus,
        "arc_established": 1,
    },
    DepthSensor: {"trigger": 1, "depth_image": ImageDepth32F, "color_image": ImageRgba8U, "scan": Scan},
    StreamingCamera: {"streaming": 1, "body_poses": list, "image": Image, "capture_time": 1},
    DepthStream: {
        "streaming": 1,
        "depth_image": ImageDepth32F,
        "color_image": ImageRgba8U,
        "stream": ScanStream,
        "newest_capture": 2,
    },
    UrTouchProbeInput: {"touch": TorchTouch},
    RelaxingTip: {"tip_state": 6, "desired_state": 6},
    SimulatedArc: {"process_on": 1, "set_values": 4, "arc_established": 1, "arc_values": 2},
    ModbusPowerSourcePorts: {"process_on": 1, "set_values": 4, "arc_established": 1, "arc_values": 2},
    ArcSchedule: {
        "servo_report": ServoReport,
        "planned_seam": PlannedSeam,
        "process_on": 1,
        "arc_established": 1,
        "set_values": 4,
        "gap": 1,
    },
    DeviceWatch: {"robot_status": UrStatus, "status": UrStatus},
    OnTrigger: {"trigger": 1, "scan": Scan},
    WiredScanStream: {"streaming": 1, "stream": ScanStream},
    WiredPictures: {"streaming": 1, "image": Image, "capture_time": 1},
    FrameQueue: {"stream": ScanStream, "flange_estimate": FlangeEstimate, "scan": StreamedScan, "counts": 3},
    MotionProcedure: {
        "settled_goal": 1,
        "robot_status": UrStatus,
        "record": MotionRecord,
        "calibration": MotionCalibration,
        "hold": 1,
        "job": JobCommand,
        "streaming": 1,
        "state": MotionState,
    },
    MotionCollector: {
        "flange_estimate": FlangeEstimate,
        "position_measured": 6,
        "sample_time": 1,
        "state": MotionState,
        "record": MotionRecord,
    },
    MotionCalibrator: {"record": MotionRecord, "state": MotionState, "calibration": MotionCalibration},
    MotionRecorder: {"stream": ScanStream},
    PoseRecorder: {"position_measured": 6, "sample_time": 1, "history": PoseHistory},
    FlangeEstimator: {
        "scan": Scan,
        "job": JobCommand,
        "history": PoseHistory,
        "calibration_status": CalibrationStatus,
        "flange_estimate": FlangeEstimate,
    },
    IterativeCalibrator: {
        "flange_estimate": FlangeEstimate,
        "history": PoseHistory,
        "calibration_status": CalibrationStatus,
    },
    CalibrationPosePlanner: {"calibration_status": CalibrationStatus, "next_pose": PoseRequest},
    SeamPlanner: {
        "scan": Scan,
        "job": JobCommand,
        "calibration_status": CalibrationStatus,
        "servo_report": ServoReport,
        "history": PoseHistory,
        "planned_seam": PlannedSeam,
    },
    DrawnSeamPlanner: {
        "scan": Scan,
        "job": JobCommand,
        "calibration_status": CalibrationStatus,
        "servo_report": ServoReport,
        "history": PoseHistory,
        "planned_seam": PlannedSeam,
    },
    PicturePoses: {"body_poses": list, "frame_poses": FramePoseVector},
    DisplacedStand: {"frame_poses": FramePoseVector},
    ArucoDeformationEstimator: {
        "image": Image,
        "history": PoseHistory,
        "calibration_status": CalibrationStatus,
        "deformation": Deformation,
        "deflection": 5,
    },
    WeldingVelocityServo: {
        "planned_seam": PlannedSeam,
        "deformation": Deformation,
        "position_measured": 6,
        "sample_time": 1,
        "job": JobCommand,
        "arc_established": 1,
        "hold": 1,
        "calibration_status": CalibrationStatus,
        "V_BT": 6,
        "servo_report": ServoReport,
        "telemetry": len(TELEMETRY),
        "torch_on": 1,
    },
    SingularityGuard: {"V_BT": 6, "position_measured": 6, "velocity": 6, "margin": 2, "guarded": 8},
    ProcessSwitch: {
        "torch_wanted": 1,
        "job": JobCommand,
        "robot_status": UrStatus,
        "margin": 2,
        "hold": 1,
        "process_on": 1,
        "arm_stopped": 1,
    },
    CommandArbiter: {
        "job": JobCommand,
        "robot_status": UrStatus,
        "mover_velocity": 6,
        "servo_velocity": 6,
        "velocity_wanted": 6,
    },
    FlangeMover: {"job": JobCommand, "position_measured": 6, "velocity_measured": 6, "velocity": 6, "settled_goal": 1},
    DriftView: {"drift": DriftStatus, "flange_estimate": FlangeEstimate},
    DriftMonitor: {
        "flange_estimate": FlangeEstimate,
        "history": PoseHistory,
        "recalibrate": 1,
        "calibration_status": CalibrationStatus,
        "drift": DriftStatus,
        "moved": 1,
    },
    SlewLimiter: {"velocity_wanted": 6, "velocity_command": 6},
    JobSequencer: {
        "robot_status": UrStatus,
        "settled_goal": 1,
        "position_measured": 6,
        "next_pose": PoseRequest,
        "calibration_status": CalibrationStatus,
        "planned_seam": PlannedSeam,
        "servo_report": ServoReport,
        "hold": 1,
        "answered": 1,
        "arm_stopped": 1,
        "drift": DriftStatus,
        "job": JobCommand,
        "job_state": JobState,
        "scan_trigger": 1,
        "streaming": 1,
        "scanner_streaming": 1,
    },
    CellVisualizer: {
        "job_state": JobState,
        "calibration_status": CalibrationStatus,
        "flange_estimate": FlangeEstimate,
        "scan": Scan,
        "planned_seam": PlannedSeam,
        "servo_report": ServoReport,
    },
    PortRecorder: {"entered": 6, "both": 8},
    PortPlayer: {},
    CameraDirector: {"job": JobCommand},
    LiveWriter: {"job": JobCommand, "margin": 2},
    OperatorPanel: {"hold": 1, "end": 1, "pace": 1, "answered": 1},
    CheatPoses: {"body_poses": list, "contact": 6, "torch": 3},
}

# The only ways through which an output follows an input at once; everything else has at least a tick between.
FEEDTHROUGH: dict[type[LeafSystem], set[tuple[str, str]]] = {
    SingularityGuard: {(i, o) for i in ("V_BT", "position_measured") for o in ("velocity", "margin", "guarded")},
    DeviceWatch: {("robot_status", "status")},
    CommandArbiter: {(i, "velocity_wanted") for i in ("job", "robot_status", "mover_velocity", "servo_velocity")},
    # process and motion end in the very tick in which the job says so
    WeldingVelocityServo: {("job", "torch_on"), ("job", "V_BT")},
    # whoever stops the arm turns the process off in the same tick
    ProcessSwitch: {(i, "process_on") for i in ("torch_wanted", "job", "robot_status", "margin", "hold")},
    PicturePoses: {("body_poses", "frame_poses")},
    CheatPoses: {("body_poses", "contact"), ("body_poses", "torch")},
    CheatTorch: {("body_poses", "torch")},
    RobotError: {("position_measured", "position"), ("job", "position")},
}

# A port that only carries one calculation to two others, and is nobody's to connect.
SHARED_CALCULATIONS = {SingularityGuard: {"guarded"}}

every_system = pytest.mark.parametrize("kind", list(MAKERS), ids=lambda kind: kind.__name__)


def inputs(system: LeafSystem) -> list[InputPort]:
    return [system.get_input_port(k) for k in range(system.num_input_ports())]


def outputs(system: LeafSystem) -> list[OutputPort]:
    return [system.get_output_port(k) for k in range(system.num_output_ports())]


def documented(kind: type[LeafSystem]) -> dict[str, list[str] | str]:
    """The `.. pydrake_system::` block of a class's docstring."""
    lines = inspect.cleandoc(kind.__doc__ or "").splitlines()
    start = lines.index(".. pydrake_system::") + 1
    block = []
    for line in lines[start:]:
        if line and not line.startswith(" "):
            break
        block.append(line)
    return dict(yaml_load(data=textwrap.dedent("\n".join(block))))


def test_every_system_of_this_room_is_tested_here() -> None:
    found = set()
    for module in pkgutil.walk_packages(weldcal.systems.__path__, "weldcal.systems."):
        members = inspect.getmembers(importlib.import_module(module.name), inspect.isclass)
        found |= {c for _, c in members if issubclass(c, LeafSystem) and c.__module__.startswith("weldcal.")}
    found -= {LeafSystem, BackgroundSystem, Procedure}  # the base classes have no ports of their own
    assert found == set(MAKERS) == set(KINDS)


@every_system
def test_the_docstring_shows_the_ports_in_their_order(kind: type[LeafSystem]) -> None:
    block, system = documented(kind), MAKERS[kind]()
    private = SHARED_CALCULATIONS.get(kind, set())
    assert block["name"] == kind.__name__
    assert block.get("input_ports", []) == [port.get_name() for port in inputs(system)]
    shown = [name for name in block.get("output_ports", []) if name not in private]
    assert shown == [port.get_name() for port in outputs(system) if port.get_name() not in private]


def test_no_system_keeps_itself_in_memory() -> None:
    made = [weakref.ref(make()) for make in MAKERS.values()]
    gc.collect()
    assert [type(found).__name__ for one in made if (found := one()) is not None] == []


@every_system
def test_each_port_carries_what_the_cell_counts_on(kind: type[LeafSystem]) -> None:
    system = MAKERS[kind]()
    carried: dict[str, int | type] = {}
    for port in [*inputs(system), *outputs(system)]:
        if port.get_data_type() == PortDataType.kVectorValued:
            carried[port.get_name()] = port.size()
        else:
            value = port.Allocate() if isinstance(port, OutputPort) else system.AllocateInputAbstract(port)
            carried[port.get_name()] = type(value.get_value())
    assert carried == KINDS[kind]


@every_system
def test_no_output_follows_an_input_at_once_but_those_that_must(kind: type[LeafSystem]) -> None:
    system = MAKERS[kind]()
    found = {
        (i.get_name(), o.get_name())
        for i in inputs(system)
        for o in outputs(system)
        if system.HasDirectFeedthrough(i.get_index(), o.get_index())
    }
    assert found == FEEDTHROUGH.get(kind, set())
