"""Drake LeafSystems around calibration and welding, the station and the cell Diagram."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from weldcal.systems.background import (
        Answer as Answer,
        Background as Background,
        BackgroundSystem as BackgroundSystem,
    )
    from weldcal.systems.cell import Cell as Cell
    from weldcal.systems.drivers.config import (
        DriverConfig as DriverConfig,
        FingerCameraConfig as FingerCameraConfig,
        NoDevice as NoDevice,
        ScannerConfig as ScannerConfig,
    )
    from weldcal.systems.drivers.station_build import PreparedRobot as PreparedRobot, StationBuild as StationBuild
    from weldcal.systems.jobs.job import AddedJob as AddedJob, Job as Job
    from weldcal.systems.jobs.motion.procedure import (
        MotionCalibration as MotionCalibration,
        MotionRecord as MotionRecord,
        MotionState as MotionState,
    )
    from weldcal.systems.jobs.mounting.procedure import MountingState as MountingState, MountingStatus as MountingStatus
    from weldcal.systems.jobs.procedure import Procedure as Procedure, ProcedureState as ProcedureState
    from weldcal.systems.jobs.profiler.procedure import ProfilerState as ProfilerState
    from weldcal.systems.jobs.tablet.config import TabletTouch as TabletTouch, WristPicture as WristPicture
    from weldcal.systems.jobs.tablet.procedure import TabletState as TabletState
    from weldcal.systems.jobs.weld.aruco_deformation_estimator import (
        ArucoDeformationEstimator as ArucoDeformationEstimator,
        Deformation as Deformation,
    )
    from weldcal.systems.jobs.weld.flange_estimator import FlangeEstimator as FlangeEstimator
    from weldcal.systems.jobs.weld.iterative_calibrator import (
        CalibrationPosePlanner as CalibrationPosePlanner,
        CalibratorConfig as CalibratorConfig,
        IterativeCalibrator as IterativeCalibrator,
        PoseRequest as PoseRequest,
    )
    from weldcal.systems.jobs.weld.seam_planner import DrawnSeamPlanner as DrawnSeamPlanner, SeamPlanner as SeamPlanner
    from weldcal.systems.jobs.weld.seam_planning import SeamPlanning as SeamPlanning
    from weldcal.systems.jobs.weld.sequencer import (
        JobPlan as JobPlan,
        JobSequencer as JobSequencer,
        JobState as JobState,
    )
    from weldcal.systems.jobs.weld.welding_velocity_servo import (
        TELEMETRY as TELEMETRY,
        ServoReport as ServoReport,
        WeldingVelocityServo as WeldingVelocityServo,
    )
    from weldcal.systems.leaf_system import LeafSystem as LeafSystem
    from weldcal.systems.messages import (
        CalibrationStatus as CalibrationStatus,
        FlangeEstimate as FlangeEstimate,
        Image as Image,
        JobCommand as JobCommand,
        Message as Message,
        PlannedSeam as PlannedSeam,
        ProfileScan as ProfileScan,
        Refinement as Refinement,
        Scan as Scan,
        ScanStream as ScanStream,
        ScanView as ScanView,
        SeamRecord as SeamRecord,
        StreamedScan as StreamedScan,
        TorchTouch as TorchTouch,
        UrStatus as UrStatus,
        VerificationResult as VerificationResult,
    )
    from weldcal.systems.motion.buffers import (
        FrameQueue as FrameQueue,
        PoseHistory as PoseHistory,
        PoseRecorder as PoseRecorder,
    )
    from weldcal.systems.motion.drift_monitor import (
        DriftMonitor as DriftMonitor,
        DriftStatus as DriftStatus,
        MonitoredCalibration as MonitoredCalibration,
    )
    from weldcal.systems.motion.flange_mover import FlangeMover as FlangeMover
    from weldcal.systems.motion.guarded_path import SingularityGuard as SingularityGuard
    from weldcal.systems.motion.spine import (
        CommandArbiter as CommandArbiter,
        JobPorts as JobPorts,
        ProcessSwitch as ProcessSwitch,
        SlewLimiter as SlewLimiter,
        Spine as Spine,
        SpineArm as SpineArm,
    )
    from weldcal.systems.operator import Operator as Operator
    from weldcal.systems.own_diagram import AddCell as AddCell, AddStation as AddStation
    from weldcal.systems.runner import Run as Run, run_cell as run_cell
    from weldcal.systems.scenario.loading import load_scenario as load_scenario
    from weldcal.systems.scenario.schema import Scenario as Scenario
    from weldcal.systems.station import Station as Station
    from weldcal.systems.wiring import Replacement as Replacement, Wiring as Wiring
else:
    from weldcal.models import exported

    __getattr__, __dir__ = exported(__name__)
