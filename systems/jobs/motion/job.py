"""The motion job: calibrate a streaming scanner and its clock, or watch it, while the flange moves in a cube."""

import dataclasses as dc
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context

from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.results import CalibrationResult, load_result
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import check_range
from weldcal.systems.drivers.simulated.second_arm import FIRST
from weldcal.systems.jobs.job import AddedJob, Job, Phases
from weldcal.systems.jobs.motion.procedure import (
    MotionCalibration,
    MotionCalibrator,
    MotionCollector,
    MotionProcedure,
    MotionRecord,
    MotionRecorder,
)
from weldcal.systems.jobs.weld.job import POLL_S, add_drift_view, add_stream
from weldcal.systems.jobs.weld.settings import feature_on_flange
from weldcal.systems.messages import CalibrationStatus
from weldcal.systems.motion.buffers import FrameQueue
from weldcal.systems.motion.clear_moves import clear_move, station_bodies
from weldcal.systems.motion.drift_monitor import DriftMonitor, DriftStatus, MonitoredCalibration
from weldcal.systems.motion.spine import Spine
from weldcal.systems.phase_words import phase_words
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Wiring

LEAST_FRAMES, MOST_FRAMES = 40, 5000


@dc.dataclass(kw_only=True)
class MotionJob:
    """The flange moves between corners of a cube while the scanner streams."""

    centre_m: list[float] = dc.field(default_factory=lambda: [0.65, 0.0, 0.30])  # of the cube, in the base
    edge_mm: float = 200.0
    # largest lean of the flange from the scanner's direction, drawn from the seed for each corner
    lean_deg: float = 15.0
    frames: int = 400  # frames with the flange that are wanted
    speed_m_s: float = 0.25  # largest speed of the flange
    queue: int = 2  # frames that wait for the fit
    record: bool = False  # write what streams as a recording in motion, to `recording` in the result folder
    recording_folder: str = ""  # set by the command
    watch: str = ""  # a calibration that is watched for drift instead of calibrating; set by `weldcal monitor`
    false_alarms_per_hour: float = 1e-3  # that are accepted of the drift test


def check_motion(job: MotionJob) -> None:
    """Check the part's numbers. Raises InputError: one sentence that says what to change."""
    if len(job.centre_m) != 3 or not np.isfinite(job.centre_m).all():
        raise InputError("motion.centre_m must be three numbers, in metres.")
    check_range("motion.edge_mm", job.edge_mm, 20.0, 1000.0)
    check_range("motion.lean_deg", job.lean_deg, 0.0, 30.0)
    check_range("motion.frames", job.frames, LEAST_FRAMES, MOST_FRAMES)
    check_range("motion.speed_m_s", job.speed_m_s, 0.01, 1.0)
    check_range("motion.queue", job.queue, 1, 8)


CORNERS = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]], dtype=np.float64) - 0.5  # no four in a plane
_TRIES = 40  # leans drawn for a corner


@dc.dataclass(frozen=True, eq=False)
class MotionPlanned:
    """Joints (6,) rad of the corners, the scanner's delay (s) by its data sheet, and what is watched, if anything."""

    corners: tuple[Array, ...]
    q_home: Array
    delay_s: float
    watched: CalibrationResult | None = None


@dc.dataclass(eq=False, kw_only=True)
class AddedMotion(AddedJob):
    """The systems of the job; it has a `calibrator` or, where it watches a calibration, a `monitor`."""

    plan: MotionPlanned
    X_FR: RigidTransform
    procedure: MotionProcedure
    collector: MotionCollector
    calibrator: MotionCalibrator | None
    monitor: DriftMonitor | None
    queue: FrameQueue
    recorder: MotionRecorder | None
    header: DatasetHeader
    frames: int

    def record(self, root: Context) -> MotionRecord:
        """What was collected so far."""
        found: MotionRecord = self.value(self.collector.GetOutputPort("record"), root)
        return found

    def calibration(self, root: Context) -> MotionCalibration:
        """Return the result, where it is there."""
        if self.calibrator is None:
            return MotionCalibration()
        found: MotionCalibration = self.value(self.calibrator.GetOutputPort("calibration"), root)
        return found

    def drift(self, root: Context) -> DriftStatus:
        """What the monitor has found so far."""
        if self.monitor is None:
            return DriftStatus()
        status: DriftStatus = self.value(self.monitor.GetOutputPort("drift"), root)
        return status

    def counts(self, root: Context) -> tuple[int, int]:
        """Frames that were taken from the queue, and frames that were dropped."""
        taken, dropped, _ = self.value(self.queue.GetOutputPort("counts"), root)
        return int(taken), int(dropped)

    def stage(self, root: Context, phases: Phases) -> tuple[str, float]:
        """See AddedJob."""
        share = len(self.record(root).seen) / self.frames
        return self.drift(root).summary or phase_words(phases[-1][0]), 0.05 + 0.85 * min(share, 1.0)


def _stream_delay_s(scenario: Scenario) -> float | None:
    """Nominal delay (s) of the scenario's scanner; None where it does not stream."""
    scanner = scenario.scanner_config()
    return None if scanner is None else scanner.stream_delay_s()


class MotionCalibrationJob(Job[MotionPlanned]):
    """The job of a scenario with a `motion` part."""

    key = "motion"
    config = MotionJob

    def check(self, scenario: Scenario) -> None:
        """See Job."""
        job, streams = scenario.part(MotionJob), _stream_delay_s(scenario) is not None
        assert job is not None
        check_motion(job)
        if not streams:
            raise InputError(
                "A motion job needs a scanner that streams: write scanner: !StreamingScanner {} in the scenario."
            )
        if scenario.job.weld or (scenario.calibration.feature != "flange" and not job.watch):
            raise InputError("A motion job calibrates by the bare flange: write tool: none and job: {weld: false}.")

    def plan(self, scenario: Scenario, station: Station, seed: int) -> MotionPlanned:
        """See Job."""
        job, delay_s = scenario.part(MotionJob), _stream_delay_s(scenario)
        assert job is not None
        assert delay_s is not None
        home = np.deg2rad(scenario.home_deg)
        watched = load_result(Path(job.watch)) if job.watch else None
        corners = plan_corners(scenario, station, job, home, np.random.default_rng([seed, 16]))
        return MotionPlanned(corners, home, delay_s, watched)

    def add(self, wiring: Wiring, spine: Spine, plan: MotionPlanned) -> AddedMotion:
        """See Job."""
        scenario, station, c = wiring.scenario, wiring.station, wiring.scenario.calibration
        job, X_FR = scenario.part(MotionJob), feature_on_flange(scenario, station)
        assert job is not None
        watched = plan.watched
        factor = scenario.job.speed_factor
        maximum_time_s = scenario.job.maximum_time_s / factor
        # legs between corners are slower than the other moves: what moves the flange at the wanted speed on the fastest
        # leg
        share = min(joint_speed(station.arm, plan.corners, job.speed_m_s) / self.move_speed, 1.0)
        procedure = wiring.add(
            "motion_procedure",
            MotionProcedure(
                plan.corners,
                plan.q_home,
                job.frames,
                speed_share=share,
                maximum_time_s=maximum_time_s,
                calibrates=watched is None,
            ),
        )
        queue = FrameQueue(job.queue, POLL_S)
        X_BC = c.mounting_guess.pose() if watched is None else watched.X_BC
        nominal = wiring.constant("nominal_scanner", CalibrationStatus())
        estimate, scan = add_stream(wiring, spine, "flange_estimator", X_FR, X_BC, plan.delay_s, queue, nominal)
        collector = wiring.add("motion_collector", MotionCollector())
        state, record = procedure.GetOutputPort("state"), collector.GetOutputPort("record")
        wiring.connect(
            collector,
            flange_estimate=estimate,
            state=state,
            position_measured=spine.arm.position,
            sample_time=wiring.out(f"{FIRST}.sample_time"),
        )
        spine.serve(procedure, record=record)
        calibrator, monitor, scanner = None, None, scenario.scanner_config()
        assert scanner is not None
        header = DatasetHeader(
            robot=scenario.arm,
            flange=scenario.flange_name(),
            scanner=scanner.scanner().name,
            configuration="eye_on_base",
            note="a run of the motion job",
        )
        if watched is None:
            calibrator = wiring.add(
                "motion_calibrator", MotionCalibrator(station.arm, station.background, header=header)
            )
            wiring.connect(calibrator, record=record, state=state)
            wiring.connect(procedure, calibration=calibrator.GetOutputPort("calibration"))
        else:
            monitored = MonitoredCalibration.of(watched, plan.delay_s, false_alarms_per_hour=job.false_alarms_per_hour)
            monitor = wiring.add("drift_monitor", DriftMonitor(station.arm, X_FR, monitored, period_s=POLL_S))
            wiring.connect(monitor, flange_estimate=estimate, history=spine.arm.history)
            add_drift_view(wiring, monitor, estimate)
        wiring.feed("scanner.streaming", procedure.GetOutputPort("streaming"))
        recorder = None
        if job.record and job.recording_folder:
            recorder = wiring.add("motion_recorder", MotionRecorder(Path(job.recording_folder)))
            wiring.connect(recorder, stream=wiring.out("scanner.stream"))
        logged = {"frame_counts": queue.GetOutputPort("counts")}
        for name in ("scanner_capture", "joints"):  # for reports only
            if station.diagram.HasOutputPort(f"cheat.{name}"):
                logged[name] = wiring.out(f"cheat.{name}")
        shown = {"record": record, "scan": scan, "flange_estimate": estimate}
        if calibrator is not None:
            shown["calibration"] = calibrator.GetOutputPort("calibration")
        if monitor is not None:
            shown["drift"] = monitor.GetOutputPort("drift")
        return AddedMotion(
            plan=plan,
            X_FR=X_FR,
            procedure=procedure,
            collector=collector,
            calibrator=calibrator,
            monitor=monitor,
            queue=queue,
            recorder=recorder,
            header=header,
            frames=job.frames,
            ports=procedure.ports(logged=logged, shown=shown),
            maximum_time_s=maximum_time_s,
        )


def plan_corners(
    scenario: Scenario, station: Station, job: MotionJob, q_home: Array, rng: np.random.Generator
) -> tuple[Array, ...]:
    """Joints (6,) rad that bring the feature to the cube's corners, with free moves between all of them.

    The feature leans another way at each corner.

    Raises:
        InputError: a corner is out of reach, or the arm would touch the table or itself on the way.
    """
    X_BC = scenario.calibration.mounting_guess.pose()
    centre, bodies = np.array(job.centre_m), station_bodies(station)
    X_RF = feature_on_flange(scenario, station).inverse()
    found: list[Array] = []
    for corner in CORNERS:
        p = centre + 1e-3 * job.edge_mm * corner
        for _ in range(_TRIES):
            off = RollPitchYaw(*np.radians(rng.uniform(-job.lean_deg, job.lean_deg, 3))).ToRotationMatrix()
            near = found[-1] if found else q_home
            X_BR = RigidTransform(facing(p, X_BC, q_home, station.arm, X_RF.inverse()) @ off, p)
            q = nearest_solution(station.arm, X_BR @ X_RF, near)
            if q is not None and all(clear_move(scenario, station, bodies, other, q) for other in (q_home, *found)):
                found.append(q)
                break
        else:
            raise InputError(
                f"The flange cannot be moved to the corner at {np.round(p, 3).tolist()} m without touching the table or"
                " the arm itself: move motion.centre_m, or make motion.edge_mm smaller."
            )
    return tuple(found)


def facing(
    p: Array, X_BC: RigidTransform, q_home: Array, arm: ArmModel, X_FR: RigidTransform | None = None
) -> RotationMatrix:
    """Return the rotation R_BR of a feature at X_FR (the flange) that faces the scanner from ``p`` (3,) m.

    It is turned about its axis as near to that at home as can be.
    """
    z = X_BC.translation() - p
    z = z / np.linalg.norm(z)
    x_home = (forward_kinematics(arm, q_home) @ (X_FR or RigidTransform())).rotation().matrix()[:, 0]
    x = x_home - (x_home @ z) * z
    x = x / np.linalg.norm(x)
    return RotationMatrix(np.column_stack([x, np.cross(z, x), z]))


def joint_speed(arm: ArmModel, corners: tuple[Array, ...], speed_m_s: float) -> float:
    """Speed (rad/s) of the fastest joint at which no leg between corners moves the flange faster than ``speed_m_s``."""
    slowest = np.inf
    for k, a in enumerate(corners):
        b = corners[(k + 1) % len(corners)]
        p = np.array([forward_kinematics(arm, a + s * (b - a)).translation() for s in np.linspace(0.0, 1.0, 17)])
        metres = float(np.linalg.norm(np.diff(p, axis=0), axis=1).max()) * 16.0
        slowest = min(slowest, speed_m_s * float(np.abs(b - a).max()) / metres)
    return float(slowest)


JOB = MotionCalibrationJob()
