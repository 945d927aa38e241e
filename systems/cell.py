"""The cell: ONE Diagram of station, estimators, calibrator, planner, servo, guards and sequencer."""

from __future__ import annotations

import dataclasses as dc
from typing import TypeVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem, OutputPort
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource, LogVectorOutput, VectorLogSink

from weldcal.calibration.planning.calibration_poses import PlannedPose, PlannerConfig, plan_calibration_poses
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, get_flange
from weldcal.systems.drivers.no_device import NoDevice
from weldcal.systems.drivers.station_build import PreparedRobot
from weldcal.systems.jobs.weld.aruco_deformation_estimator import ArucoDeformationEstimator
from weldcal.systems.jobs.weld.calibration_pose_planner import CalibrationPosePlanner
from weldcal.systems.jobs.weld.flange_estimator import FlangeEstimator
from weldcal.systems.jobs.weld.iterative_calibrator import CalibratorConfig, IterativeCalibrator
from weldcal.systems.jobs.weld.seam_planner import DrawnSeamPlanner, SeamPlanner
from weldcal.systems.jobs.weld.sequencer import JobPlan, JobSequencer
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport, WeldingVelocityServo
from weldcal.systems.messages import PlannedSeam
from weldcal.systems.motion.clear_moves import check_way_home, clear_poses, station_bodies
from weldcal.systems.motion.command_arbiter import CommandArbiter
from weldcal.systems.motion.flange_mover import FlangeMover
from weldcal.systems.motion.operator_panel import OperatorPanel
from weldcal.systems.motion.pose_recorder import PoseRecorder
from weldcal.systems.motion.process_switch import ProcessSwitch
from weldcal.systems.motion.singularity_guard import SingularityGuard
from weldcal.systems.motion.slew_limiter import SlewLimiter
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station, make_station
from weldcal.systems.viewer.cell_visualizer import add_visualizer
from weldcal.welding.servo.guards import SlewLimits
from weldcal.welding.servo.settings import DeflectionControl, ServoConfig, ToolGeometry, TouchConfig

AnySystem = TypeVar("AnySystem", bound=LeafSystem)
LOG_PERIOD_S = 0.008  # a row per servo tick
SPARE_POSES = 3  # one for Algorithm 1's verification cloud, two against refused scans
MOVE_TIMEOUT_S = 20.0  # at speed_factor 1
MOVE_SPEED, MOVE_ACCELERATION = 1.0, 2.5  # rad/s and rad/s^2 of the fastest joint, at speed_factor 1
JERK_LIMIT = 150.0  # rad/s^3: 100 ms to the acceleration limit of the large joints
ZERO_FRAMES = 10  # of the tag while the tip hangs free: a third of a second before it comes down
TORCH_ABOVE_ROOT_M = 0.002  # where the wire point runs: this far above the root of the groove


@dc.dataclass(frozen=True, eq=False)
class WeldingPorts:
    """Where the rest of the cell finds the welding half; `logged` holds vector ports by their name in the log."""

    seam: OutputPort
    report: OutputPort
    velocity: OutputPort
    arm_stopped: OutputPort
    logged: dict[str, OutputPort] = dc.field(default_factory=dict)


@dc.dataclass(frozen=True, eq=False)
class Wiring:
    """The builder with what every part of the cell needs."""

    builder: DiagramBuilder
    station: Station
    scenario: Scenario
    servo_config: ServoConfig

    def add(self, name: str, system: AnySystem) -> AnySystem:
        """Add a system under its name."""
        system.set_name(name)
        self.builder.AddSystem(system)
        return system

    def connect(self, system: LeafSystem, **sources: OutputPort) -> None:
        """Connect each source to the system's input port of that name."""
        for port, source in sources.items():
            self.builder.Connect(source, system.GetInputPort(port))

    def constant(self, name: str, value: object) -> OutputPort:
        """A port that always shows this message."""
        return self.add(name, ConstantValueSource(AbstractValue.Make(value))).get_output_port()

    def zeros(self, name: str, size: int) -> OutputPort:
        """A vector port of zeros."""
        return self.add(name, ConstantVectorSource(np.zeros(size))).get_output_port()


@dc.dataclass(frozen=True, eq=False)
class Cell:
    """The Diagram and its named parts, for whoever simulates, records or tests it."""

    diagram: Diagram
    station: Station
    scenario: Scenario
    poses: tuple[PlannedPose, ...]
    X_FR: RigidTransform
    servo_config: ServoConfig
    sequencer: JobSequencer
    calibrator: IterativeCalibrator
    logs: dict[str, VectorLogSink]


def feature_on_flange(scenario: Scenario, station: Station) -> RigidTransform:
    """X_FR of the feature that the scanner looks at."""
    if scenario.calibration.feature == "flange" or station.tool is None:
        return RigidTransform()
    return station.tool.X_FR


def feature_standard(scenario: Scenario) -> FlangeStandard:
    """Dimensions of that feature."""
    return get_flange("tool-ring-63" if scenario.calibration.feature == "tool_ring" else scenario.flange)


def servo_config(scenario: Scenario, station: Station) -> ServoConfig:
    """The servo's numbers from scenario and tool."""
    tool, welding = station.tool, scenario.welding
    if tool is None or station.cad is None:
        return ServoConfig()
    seat = station.cad.tip_height(tool.tip_radius_m) - tool.seat_sink_m
    geometry = ToolGeometry(
        torch_offset_m=tool.chord_m,
        torch_height_m=tool.torch_height_m,
        tip_drop_m=station.cad.depth_m + tool.tip_radius_m - seat,
        torch_clearance_m=TORCH_ABOVE_ROOT_M - seat,
        side_offset_m=-tool.seat_side_m,
    )
    return ServoConfig(
        tool=geometry,
        touch=TouchConfig(zero_frames=ZERO_FRAMES),
        weld_speed_m_s=welding.speed_mm_s * 1e-3,
        deflection=DeflectionControl(
            delta_d_m=welding.deflection_mm * 1e-3, axial_d_m=welding.axial_deflection_mm * 1e-3
        ),
        law=welding.law,
    )


def plan_poses(scenario: Scenario, station: Station, seed: int) -> tuple[PlannedPose, ...]:
    """Every calibration and verification pose, best first, checked for reach, sight and clearance before anything moves.

    Raises:
        UnreachableScanner: no such set of poses exists for the scanner where the scenario says it stands.
    """
    c, tool = scenario.calibration, station.tool
    scanner = scenario.scanner
    if isinstance(scanner, NoDevice):
        raise InputError("A calibration needs a scanner: write scanner: !RenderedScanner {} in the scenario.")
    preset = scanner.scanner()
    config = PlannerConfig(
        seed=seed,
        theta_max_rad=np.deg2rad(c.theta_max_deg),
        table_z_m=c.table_z_m,
        margin_m=c.clearance_m,
        feature_radius_m=0.5 * feature_standard(scenario).outer_m,
        work_point_B=tuple(work_point(scenario)),
    )
    poses = plan_calibration_poses(
        station.arm,
        feature_on_flange(scenario, station),
        c.mounting_guess.pose(),
        preset,
        c.maximum_scans + c.verification_scans + SPARE_POSES,
        q_start=np.deg2rad(scenario.home_deg),
        config=config,
        tool=() if tool is None else tool.capsules(),
    )
    return clear_poses(scenario, station, poses, station_bodies(station))


def work_point(scenario: Scenario) -> np.ndarray:
    """p_BWork (3,) m: where the calibration's error counts."""
    if scenario.workpiece is not None:
        return np.array(scenario.workpiece.pose_guess.pose().translation())
    return np.array(scenario.calibration.work_point_m)


def make_cell(
    scenario: Scenario, seed: int = 0, meshcat: Meshcat | None = None, robot: PreparedRobot | None = None
) -> Cell:
    """Build the whole cell for a scenario; whoever makes one closes its station.

    The same systems run against simulated plants and against hardware: only the drivers inside `make_station` differ.
    `robot`: see make_station.

    Raises:
        InputError, UnreachableScanner: the scenario cannot be done; nothing has been written or moved.
    """
    if scenario.tablet is not None:
        raise InputError("This scenario is a visit to a tablet: run it with weldcal tablet demo or weldcal demo.")
    if scenario.mounting is not None:
        raise InputError("This scenario is a mounting job: run it with weldcal hand-eye live or weldcal demo.")
    station = make_station(scenario, seed, robot)
    try:
        check_way_home(scenario, station)
        return _make_cell(scenario, station, seed, meshcat)
    except BaseException:
        station.close()
        raise


def _make_cell(scenario: Scenario, station: Station, seed: int, meshcat: Meshcat | None) -> Cell:
    builder = DiagramBuilder()
    builder.AddSystem(station.diagram)
    config = servo_config(scenario, station)
    wiring = Wiring(builder, station, scenario, config)
    out, arm, c, job = station.diagram.GetOutputPort, station.arm, scenario.calibration, scenario.job
    X_FR, standard, X_BC_guess = (
        feature_on_flange(scenario, station),
        feature_standard(scenario),
        c.mounting_guess.pose(),
    )
    poses = plan_poses(scenario, station, seed) if job.calibrate else ()
    q_measured, v_measured = out("ur10e.position_measured"), out("ur10e.velocity_measured")

    recorder = wiring.add("pose_recorder", PoseRecorder())
    wiring.connect(recorder, position_measured=q_measured, sample_time=out("ur10e.sample_time"))
    history = recorder.GetOutputPort("history")
    sequencer = wiring.add("job_sequencer", JobSequencer(job_plan(scenario)))
    command = sequencer.GetOutputPort("job")

    estimator = wiring.add(
        "flange_estimator", FlangeEstimator(arm, X_FR, standard, X_BC_guess, c.guess_radius_mm * 1e-3)
    )
    calibrator = wiring.add(
        "iterative_calibrator", IterativeCalibrator(arm, X_FR, standard, calibrator_config(scenario))
    )
    status = calibrator.GetOutputPort("calibration_status")
    wiring.connect(estimator, scan=out("scanner.scan"), job=command, history=history, calibration_status=status)
    wiring.connect(calibrator, flange_estimate=estimator.GetOutputPort("flange_estimate"), history=history)
    chooser = wiring.add("calibration_pose_planner", CalibrationPosePlanner(poses))
    wiring.connect(chooser, calibration_status=status)

    hold = wiring.zeros("nobody_holds", 1) if meshcat is None else panel(wiring, meshcat)
    welding = _add_welding(wiring, sequencer, status, history, hold)
    mover = wiring.add("flange_mover", FlangeMover(MOVE_SPEED * job.speed_factor, MOVE_ACCELERATION * job.speed_factor))
    wiring.connect(mover, job=command, position_measured=q_measured, velocity_measured=v_measured)
    arbiter = wiring.add("command_arbiter", CommandArbiter())
    wiring.connect(
        arbiter,
        job=command,
        robot_status=out("ur10e.status"),
        mover_velocity=mover.GetOutputPort("velocity"),
        servo_velocity=welding.velocity,
    )
    limits = SlewLimits(speed=0.6 * arm.velocity_limit, acceleration=0.5 * arm.acceleration_limit, jerk=JERK_LIMIT)
    limiter = wiring.add("slew_limiter", SlewLimiter(limits))
    wiring.connect(limiter, velocity_wanted=arbiter.GetOutputPort("velocity_wanted"))
    builder.Connect(limiter.get_output_port(), station.diagram.GetInputPort("ur10e.velocity_command"))
    builder.Connect(sequencer.GetOutputPort("scan_trigger"), station.diagram.GetInputPort("scanner.trigger"))
    wiring.connect(
        sequencer,
        robot_status=out("ur10e.status"),
        settled_goal=mover.GetOutputPort("settled_goal"),
        position_measured=q_measured,
        next_pose=chooser.GetOutputPort("next_pose"),
        calibration_status=status,
        planned_seam=welding.seam,
        servo_report=welding.report,
        hold=hold,
        arm_stopped=welding.arm_stopped,
    )
    if meshcat is not None:
        ports = {
            "job_state": sequencer.GetOutputPort("job_state"),
            "calibration_status": status,
            "flange_estimate": estimator.GetOutputPort("flange_estimate"),
            "scan": out("scanner.scan"),
            "planned_seam": welding.seam,
            "servo_report": welding.report,
        }
        view, radius = scenario.visualization, 0.5 * standard.outer_m
        add_visualizer(builder, meshcat, station, radius, X_BC_guess, view, config.weld_speed_m_s, ports)
    logs = {name: LogVectorOutput(port, builder, LOG_PERIOD_S) for name, port in welding.logged.items()}
    diagram = builder.Build()
    diagram.set_name("cell")
    return Cell(diagram, station, scenario, poses, X_FR, config, sequencer, calibrator, logs)


def panel(wiring: Wiring, meshcat: Meshcat) -> OutputPort:
    """The operator's controls in the viewer."""
    return wiring.add("operator_panel", OperatorPanel(meshcat)).GetOutputPort("hold")


def job_plan(scenario: Scenario) -> JobPlan:
    """The job's numbers in SI units; slower moves may take longer."""
    c, job = scenario.calibration, scenario.job
    slower = 1.0 / job.speed_factor
    return JobPlan(
        calibrate=job.calibrate,
        weld=job.weld,
        q_home=np.deg2rad(scenario.home_deg),
        maximum_scans=c.maximum_scans,
        verification_scans=c.verification_scans,
        verification_limit_m=c.verification_limit_mm * 1e-3,
        required_error_m=c.required_error_mm * 1e-3,
        move_timeout_s=MOVE_TIMEOUT_S * slower,
        maximum_time_s=job.maximum_time_s * slower,
    )


def calibrator_config(scenario: Scenario) -> CalibratorConfig:
    """When the calibration may stop."""
    c = scenario.calibration
    return CalibratorConfig(
        required_error_m=c.required_error_mm * 1e-3,
        minimum_scans=c.minimum_scans,
        maximum_scans=c.maximum_scans,
        p_BWork=work_point(scenario),
        cost=c.cost,
        work_radius_m=c.work_radius_mm * 1e-3,
        cost_axes=tuple(c.cost_axes),
    )


def _add_welding(
    wiring: Wiring, sequencer: JobSequencer, status: OutputPort, history: OutputPort, hold: OutputPort
) -> WeldingPorts:
    """Seam planner, deformation estimator, servo, guard and process switch; constants stand in for them in a cell without a tool."""
    station, scenario, config = wiring.station, wiring.scenario, wiring.servo_config
    tool, spec = station.tool, scenario.workpiece
    if tool is None or spec is None or station.cad is None or isinstance(scenario.finger_camera, NoDevice):
        return WeldingPorts(
            seam=wiring.constant("no_seam", PlannedSeam()),
            report=wiring.constant("no_servo", ServoReport()),
            velocity=wiring.zeros("no_servo_velocity", 6),
            arm_stopped=wiring.zeros("no_arm_stopped", 1),
        )
    out, command, job = station.diagram.GetOutputPort, sequencer.GetOutputPort("job"), scenario.job
    welding = scenario.welding
    kind = SeamPlanner if spec.located_by == "scan" else DrawnSeamPlanner
    planner = wiring.add(
        "seam_planner",
        kind(
            station.arm,
            tool,
            station.cad,
            spec.pose_guess.pose(),
            config,
            np.deg2rad(scenario.home_deg),
            welding.clearance_mm * 1e-3,
            None if welding.seam_length_mm is None else welding.seam_length_mm * 1e-3,
            None if job.calibrate or job.X_BC is None else job.X_BC.pose(),
            scenario.planning.planning_method(),
        ),
    )
    wiring.connect(planner, scan=out("scanner.scan"), job=command, calibration_status=status)
    finger = wiring.add(
        "deformation_estimator", ArucoDeformationEstimator(station.arm, tool, scenario.finger_camera.camera())
    )
    wiring.connect(finger, image=out("finger_camera.image"), history=history)
    wiring.builder.Connect(
        sequencer.GetOutputPort("streaming"), station.diagram.GetInputPort("finger_camera.streaming")
    )
    servo = wiring.add("welding_servo", WeldingVelocityServo(station.arm, tool, config))
    wiring.connect(
        servo,
        planned_seam=planner.GetOutputPort("planned_seam"),
        deformation=finger.GetOutputPort("deformation"),
        position_measured=out("ur10e.position_measured"),
        sample_time=out("ur10e.sample_time"),
        job=command,
    )
    guard = wiring.add("singularity_guard", SingularityGuard(station.arm, tool.X_FT))
    wiring.connect(guard, V_BT=servo.GetOutputPort("V_BT"), position_measured=out("ur10e.position_measured"))
    switch = wiring.add("process_switch", ProcessSwitch())
    wiring.connect(
        switch,
        torch_wanted=servo.GetOutputPort("torch_on"),
        job=command,
        robot_status=out("ur10e.status"),
        margin=guard.GetOutputPort("margin"),
        hold=hold,
    )
    wiring.builder.ExportOutput(switch.GetOutputPort("process_on"), "process_on")
    if station.diagram.HasInputPort("ur10e.process_on"):
        wiring.builder.Connect(switch.GetOutputPort("process_on"), station.diagram.GetInputPort("ur10e.process_on"))
    return WeldingPorts(
        seam=planner.GetOutputPort("planned_seam"),
        report=servo.GetOutputPort("servo_report"),
        velocity=guard.GetOutputPort("velocity"),
        arm_stopped=switch.GetOutputPort("arm_stopped"),
        logged={
            "telemetry": servo.GetOutputPort("telemetry"),
            "torch_on": switch.GetOutputPort("process_on"),
            "margin": guard.GetOutputPort("margin"),
            "deflection": finger.GetOutputPort("deflection"),
            "tip_and_deflection": out("cheat.contact"),
            "torch": out("cheat.torch"),
            "position": out("ur10e.position_measured"),
        },
    )
