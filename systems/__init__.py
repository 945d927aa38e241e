"""Drake LeafSystems around calibration and welding, the station and the cell Diagram."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from weldcal.systems.background import Answer, Background, BackgroundSystem
    from weldcal.systems.cell import Cell
    from weldcal.systems.drivers.config import DriverConfig, FingerCameraConfig, NoDevice, ScannerConfig
    from weldcal.systems.drivers.station_build import PreparedRobot, StationBuild
    from weldcal.systems.jobs.job import AddedJob, Job
    from weldcal.systems.jobs.procedure import Procedure, ProcedureState
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
        Message,
        PlannedSeam,
        ProfileScan,
        Scan,
        ScanStream,
        TorchTouch,
        UrStatus,
    )
    from weldcal.systems.motion.buffers import FrameQueue, PoseHistory, PoseRecorder
    from weldcal.systems.motion.drift_monitor import DriftMonitor, DriftStatus, MonitoredCalibration
    from weldcal.systems.motion.flange_mover import FlangeMover
    from weldcal.systems.motion.guarded_path import SingularityGuard
    from weldcal.systems.motion.spine import CommandArbiter, JobPorts, ProcessSwitch, SlewLimiter, Spine, SpineArm
    from weldcal.systems.operator import Operator
    from weldcal.systems.own_diagram import AddCell, AddStation
    from weldcal.systems.runner import Run, run_cell
    from weldcal.systems.scenario.loading import load_scenario
    from weldcal.systems.scenario.schema import Scenario
    from weldcal.systems.station import Station
    from weldcal.systems.wiring import Replacement, Wiring
else:
    from weldcal.models import exported

    __getattr__, __dir__ = exported(__name__)

__all__ = [
    "TELEMETRY",
    "AddCell",
    "AddStation",
    "AddedJob",
    "Answer",
    "ArucoDeformationEstimator",
    "Background",
    "BackgroundSystem",
    "CalibrationPosePlanner",
    "CalibrationStatus",
    "CalibratorConfig",
    "Cell",
    "CommandArbiter",
    "Deformation",
    "DrawnSeamPlanner",
    "DriftMonitor",
    "DriftStatus",
    "DriverConfig",
    "FingerCameraConfig",
    "FlangeEstimate",
    "FlangeEstimator",
    "FlangeMover",
    "FrameQueue",
    "Image",
    "IterativeCalibrator",
    "Job",
    "JobCommand",
    "JobPlan",
    "JobPorts",
    "JobSequencer",
    "JobState",
    "LeafSystem",
    "Message",
    "MonitoredCalibration",
    "NoDevice",
    "Operator",
    "PlannedSeam",
    "PoseHistory",
    "PoseRecorder",
    "PoseRequest",
    "PreparedRobot",
    "Procedure",
    "ProcedureState",
    "ProcessSwitch",
    "ProfileScan",
    "Replacement",
    "Run",
    "Scan",
    "ScanStream",
    "ScannerConfig",
    "Scenario",
    "SeamPlanner",
    "SeamPlanning",
    "ServoReport",
    "SingularityGuard",
    "SlewLimiter",
    "Spine",
    "SpineArm",
    "Station",
    "StationBuild",
    "TorchTouch",
    "UrStatus",
    "WeldingVelocityServo",
    "Wiring",
    "load_scenario",
    "run_cell",
]
