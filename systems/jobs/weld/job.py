"""The weld job: calibrate, verify, scan the workpiece, plan the seam, weld it; or the calibration only."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, OutputPort

from weldcal.calibration.motion.drift.sequential import DriftConfig
from weldcal.calibration.planning.calibration_poses import PlannedPose
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.workpieces.part import is_felt, numbered, seam_count
from weldcal.systems.drivers.config import FingerCameraConfig
from weldcal.systems.drivers.simulated.streaming_scanner import StreamingScanner
from weldcal.systems.jobs.job import AddedJob, Job, Phases
from weldcal.systems.jobs.weld.arc_schedule import ArcSchedule
from weldcal.systems.jobs.weld.aruco_deformation_estimator import ArucoDeformationEstimator
from weldcal.systems.jobs.weld.flange_estimator import FlangeEstimator
from weldcal.systems.jobs.weld.iterative_calibrator import CalibrationPosePlanner, IterativeCalibrator
from weldcal.systems.jobs.weld.seam_planner import DrawnSeamPlanner, SeamPlanner
from weldcal.systems.jobs.weld.seam_planning import SeamPlanning
from weldcal.systems.jobs.weld.sequencer import JobSequencer
from weldcal.systems.jobs.weld.settings import (
    calibrator_config,
    check_scan_moves,
    feature_on_flange,
    feature_standard,
    job_plan,
    pieces_of,
    plan_poses,
    seam_tool,
    servo_config,
    travel_of,
    work_point,
)
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport, WeldingVelocityServo
from weldcal.systems.messages import CalibrationStatus, JobCommand, PlannedSeam, Scan
from weldcal.systems.motion.buffers import FrameQueue
from weldcal.systems.motion.drift_monitor import DriftMonitor, DriftStatus, MonitoredCalibration
from weldcal.systems.motion.guarded_path import SingularityGuard
from weldcal.systems.motion.spine import JobPorts, Spine
from weldcal.systems.phase_words import phase_words
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.viewer.cell_visualizer import add_visualizer
from weldcal.systems.viewer.drift_view import DriftView
from weldcal.systems.wiring import Wiring
from weldcal.welding.locate.part.fit_up import read_limits
from weldcal.welding.passes.travel import SeamTravel
from weldcal.welding.record.schedule import WeldSchedule
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase

POLL_S = 0.004  # of the frame queue, the estimator of its frames and the monitor: a twelfth of a frame
# between two stops a UR10e comes back to 0.05 mm (its data sheet), and a stop is no move of the scanner
WELD_DRIFT = DriftConfig(floor_m=5e-5, floor_rad=5e-5)
# a pose that the scenario states without its accuracy: only changes since the first frame are told
UNKNOWN = np.diag([0.02**2] * 3 + [0.01**2] * 3)


def add_stream(
    wiring: Wiring,
    spine: Spine,
    name: str,
    X_FR: RigidTransform,
    X_BC: RigidTransform,
    delay_s: float,
    queue: FrameQueue,
    status: OutputPort,
) -> tuple[OutputPort, OutputPort]:
    """Add a queue of the streaming scanner's frames and an estimator called `name`.

    Returns its estimates, and the queue's frames.
    """
    scenario, station = wiring.scenario, wiring.station
    wiring.add("frame_queue", queue)
    estimator = wiring.add(
        name,
        FlangeEstimator(
            arm=station.arm,
            X_FR=X_FR,
            standard=feature_standard(scenario),
            X_BC_guess=X_BC,
            guess_radius_m=scenario.calibration.guess_radius_mm * 1e-3,
            background=station.background,
            period_s=POLL_S,
            delay_s=delay_s,
        ),
    )
    estimate, scan = estimator.GetOutputPort("flange_estimate"), queue.GetOutputPort("scan")
    job = wiring.constant("no_ordered_scan", JobCommand())
    wiring.connect(queue, stream=wiring.out("scanner.stream"), flange_estimate=estimate)
    wiring.connect(estimator, scan=scan, job=job, history=spine.arm.history, calibration_status=status)
    return estimate, scan


def add_drift_view(wiring: Wiring, monitor: DriftMonitor, estimate: OutputPort) -> None:
    """Show what the monitor finds in the 3D view, where there is one."""
    if wiring.meshcat is not None:
        radius_m = 0.5 * feature_standard(wiring.scenario).outer_m
        view = wiring.add("drift_view", DriftView(wiring.meshcat, radius_m, wiring.scenario.visualization))
        wiring.connect(view, drift=monitor.GetOutputPort("drift"), flange_estimate=estimate)


def add_watch(
    wiring: Wiring, spine: Spine, sequencer: JobSequencer, status: OutputPort, X_FR: RigidTransform
) -> DriftMonitor | None:
    """Add the watch and connect it to the sequencer; None where the scanner does not stream, and nothing is added.

    The calibration that the job makes is watched from when it is done, one that the scenario states from the start.
    """
    scenario, station, c = wiring.scenario, wiring.station, wiring.scenario.calibration
    scanner, job = scenario.scanner, scenario.job
    if not isinstance(scanner, StreamingScanner) or scanner.mounted_on != "base":
        return None
    delay_s = scanner.stream().delay_s
    stated = None if job.calibrate or job.X_BC is None else job.X_BC.pose()
    watched = None if stated is None else MonitoredCalibration(stated, UNKNOWN, delay_s=delay_s, config=WELD_DRIFT)
    X_BC, queue = stated or c.mounting_guess.pose(), FrameQueue()
    estimate, _ = add_stream(wiring, spine, "streamed_flange_estimator", X_FR, X_BC, delay_s, queue, status)
    monitor = wiring.add(
        "drift_monitor", DriftMonitor(station.arm, X_FR, watched, WELD_DRIFT, period_s=POLL_S, delay_s=delay_s)
    )
    wiring.connect(monitor, flange_estimate=estimate, history=spine.arm.history, calibration_status=status)
    wiring.connect(sequencer, drift=monitor.GetOutputPort("drift"))
    wiring.feed("scanner.streaming", sequencer.GetOutputPort("scanner_streaming"))
    add_drift_view(wiring, monitor, estimate)
    return monitor


# Completed share of a run at the start of a phase, for the progress bar: calibration, planning, weld.
SHARES = {
    "start": 0.0,
    "move_home": 0.0,
    "move_to_pose": 0.05,
    "move_to_verify": 0.28,
    "scan_verify": 0.30,
    "park": 0.31,
    "move_to_scan": 0.32,
    "scan_workpiece": 0.33,
    "leave_scan": 0.335,
    "confirm": 0.338,
    "approach_above": 0.34,
    "approach": 0.36,
    "weld": 0.38,
    "retract": 0.96,
    "interpass": 0.97,
    "plan_pass": 0.97,
    "plan_seam": 0.97,
    "home": 0.97,
    "done": 0.98,
    "held": 0.98,
}
BETWEEN_WELDS = ("interpass", "plan_pass", "plan_seam")


@dataclass(eq=False, kw_only=True)
class WeldJob(AddedJob):
    """The systems of the job and the data that they were built from."""

    scenario: Scenario
    poses: tuple[PlannedPose, ...]
    X_FR: RigidTransform
    servo_config: ServoConfig
    sequencer: JobSequencer
    calibrator: IterativeCalibrator
    monitor: DriftMonitor | None
    seam: OutputPort
    report: OutputPort
    travel: SeamTravel
    passes: int = 1

    def calibration_status(self, root: Context) -> CalibrationStatus:
        """The calibrator's status in a context of the whole Diagram."""
        status: CalibrationStatus = self.value(self.calibrator.GetOutputPort("calibration_status"), root)
        return status

    def drift(self, root: Context) -> DriftStatus | None:
        """What the drift watch has found; None where the scanner does not stream."""
        if self.monitor is None:
            return None
        status: DriftStatus = self.value(self.monitor.GetOutputPort("drift"), root)
        return status

    def planned_seam(self, root: Context) -> PlannedSeam:
        """The seam planner's newest plan; empty in a job that does not weld."""
        plan: PlannedSeam = self.value(self.seam, root)
        return plan

    def servo_report(self, root: Context) -> ServoReport:
        """The servo's newest report."""
        report: ServoReport = self.value(self.report, root)
        return report

    def view(self) -> tuple[Array, Array]:
        """See AddedJob: from the scanner down to the workpiece."""
        return np.array([1.36, -0.62, 0.84]), np.array([0.46, 0.0, 0.52])

    def can_stand(self, root: Context) -> bool:
        """See AddedJob: the servo turns the torch off and brings the tool to rest."""
        if self.command(root).mode != "weld":
            return True
        report = self.servo_report(root)
        over = report.phase in ("IDLE", Phase.DONE, Phase.FAULT)
        return not over and report.interruption.at_rest(self.servo_config)

    def stage(self, root: Context, phases: Phases) -> tuple[str, float]:
        """See AddedJob."""
        command = self.command(root)
        phase, order = command.phase, self.travel.order
        seams, seam = len(order), order.index(command.seam)
        share = SHARES.get(phase, 0.05)
        if phase in ("move_to_pose", "scan_pose"):
            scans = sum(1 for name, _, _ in phases if name == "scan_pose")
            share = min(0.02 + 0.03 * scans, 0.27)
        welds, weld = seams * self.passes, seam * self.passes + command.weld_pass
        counted = [("seam", seam, seams), ("pass", command.weld_pass, self.passes)]
        detail = ", ".join(f"{name} {k + 1} of {n}" for name, k, n in counted if n > 1)
        if share < SHARES["approach_above"]:
            detail = ""
        report, planned = self.servo_report(root), self.planned_seam(root).seam
        if phase == "weld" and report.command is not None and planned is not None:
            at = report.command.diagnostics.s_torch
            along = min(max(at, 0.0), planned.length) if np.isfinite(at) else 0.0
            share += 0.58 * along / planned.length
            detail = ", ".join(filter(None, (detail, f"{1e3 * along:.0f} of {1e3 * planned.length:.0f} mm")))
        if welds > 1 and share > SHARES["park"]:
            part = SHARES["approach_above"] if phase in BETWEEN_WELDS else share  # that counts the next weld already
            share = SHARES["park"] + (1.0 - SHARES["park"]) * (weld + part) / welds
        return phase_words(phase, detail), share


class Weld(Job[tuple[PlannedPose, ...]]):
    """The default job: that of a scenario without another job's part."""

    def plan(self, scenario: Scenario, station: Station, seed: int) -> tuple[PlannedPose, ...]:
        """See Job: every calibration and verification pose."""
        check_scan_moves(scenario, station)
        return plan_poses(scenario, station, seed) if scenario.job.calibrate else ()

    def add(self, wiring: Wiring, spine: Spine, plan: tuple[PlannedPose, ...]) -> WeldJob:
        """See Job."""
        station, scenario, c = wiring.station, wiring.scenario, wiring.scenario.calibration
        config = servo_config(scenario, station)
        X_FR, standard = feature_on_flange(scenario, station), feature_standard(scenario)
        X_BC_guess = c.mounting_guess.pose()
        travel = travel_of(scenario, station)
        times = replace(job_plan(scenario, station.cad), order=travel.order, unfelt=unfelt_seams(station))
        sequencer = wiring.add("job_sequencer", JobSequencer(times))
        command, history = sequencer.GetOutputPort("job"), spine.arm.history
        estimator = wiring.add(
            "flange_estimator",
            FlangeEstimator(station.arm, X_FR, standard, X_BC_guess, c.guess_radius_mm * 1e-3, station.background),
        )
        calibrator = wiring.add(
            "iterative_calibrator",
            IterativeCalibrator(station.arm, X_FR, calibrator_config(scenario), station.background),
        )
        status = calibrator.GetOutputPort("calibration_status")
        chooser = wiring.add("calibration_pose_planner", CalibrationPosePlanner(plan))
        wiring.connect(
            estimator, scan=wiring.out("scanner.scan"), job=command, history=history, calibration_status=status
        )
        wiring.connect(calibrator, flange_estimate=estimator.GetOutputPort("flange_estimate"), history=history)
        wiring.connect(chooser, calibration_status=status)
        seam, report, welding = _add_welding(wiring, spine, config, sequencer, status)
        monitor = add_watch(wiring, spine, sequencer, status, X_FR)
        wiring.feed("scanner.trigger", sequencer.GetOutputPort("scan_trigger"))
        spine.serve(
            sequencer,
            next_pose=chooser.GetOutputPort("next_pose"),
            calibration_status=status,
            planned_seam=seam,
            servo_report=report,
            arm_stopped=spine.switch.GetOutputPort("arm_stopped"),
        )
        state = sequencer.GetOutputPort("job_state")
        results = {
            "flange_estimate": estimator.GetOutputPort("flange_estimate"),
            "calibration_status": status,
            "planned_seam": seam,
        }
        shown = {**results, "scan": wiring.out("scanner.scan"), "servo_report": report}
        if wiring.meshcat is not None:
            drawn = {**shown, "job_state": state}
            if scenario.carried_scanner() is not None:
                drawn["scan"] = wiring.constant("no_scan", Scan())  # the viewer's scanner is at rest
            add_visualizer(wiring, 0.5 * standard.outer_m, X_BC_guess, work_point(scenario), drawn)
        ports = JobPorts(
            commands=(command,),
            state=state,
            **welding,
            results={"job": command, **results},
            shown={**shown, "next_pose": chooser.GetOutputPort("next_pose")},
        )
        return WeldJob(
            scenario=scenario,
            poses=plan,
            X_FR=X_FR,
            servo_config=config,
            sequencer=sequencer,
            calibrator=calibrator,
            monitor=monitor,
            seam=seam,
            report=report,
            ports=ports,
            maximum_time_s=times.maximum_time_s,
            travel=travel,
            passes=1 + len(times.interpass_s),
        )


def seam_planning(scenario: Scenario, station: Station, config: ServoConfig) -> SeamPlanning:
    """What the seams are planned from; a station with a tool and a workpiece."""
    spec, welding = scenario.workpiece, scenario.welding
    assert spec is not None
    assert station.tool is not None
    assert station.cad is not None
    # a live calibration states its own
    speeds = () if welding.schedule is None else welding.schedule.speeds_m_s()
    sigma_mm = scenario.calibration.required_error_mm if scenario.job.calibrate else scenario.job.X_BC_sigma_mm
    tools = [seam_tool(scenario, station, k) for k in range(seam_count(station.cad))]
    return SeamPlanning(
        arm=station.arm,
        tool=tools[0],
        tools=tuple(tools),
        workpiece=station.cad,
        X_BP_guess=spec.pose_guess.pose(),
        config=replace(config, weld_speed_m_s=max(speeds)) if speeds else config,  # the arm must follow the fastest
        q_near=np.deg2rad(scenario.home_deg),
        clearance_m=welding.clearance_mm * 1e-3,
        seam_length_m=None if welding.seam_length_mm is None else welding.seam_length_mm * 1e-3,
        method=scenario.planning,
        surroundings=station.surroundings,
        table_z_m=scenario.table_height_m(),
        lean_rad=np.deg2rad(welding.lean_deg),
        any_posture=welding.posture == "any",
        X_BC_sigma_m=None if sigma_mm is None else 1e-3 * sigma_mm,
        tolerance_m=1e-3 * welding.tolerance_mm,
        pass_obstacles=welding.pass_obstacles,
        passes=welding.later_passes(),
        limits={} if welding.fit_up is None else read_limits(Path(welding.fit_up)),
        schedule=welding.schedule,
        keeps_scan=welding.between_seams == "direct",
        stitches=pieces_of(welding),
        order_words=travel_of(scenario, station).words,
    )


def unfelt_seams(station: Station) -> tuple[int, ...]:
    """The numbers, from 0, of the seams that the station's tip does not feel."""
    part, tool = station.cad, station.tool
    if part is None or tool is None:
        return ()
    return tuple(k for k in range(seam_count(part)) if not is_felt(numbered(part, k), tool))


def _add_welding(
    wiring: Wiring, spine: Spine, config: ServoConfig, sequencer: JobSequencer, status: OutputPort
) -> tuple[OutputPort, OutputPort, dict[str, Any]]:
    """Add seam planner, deformation estimator, servo and guard.

    Constant sources replace them in a cell without a tool. Returns the ports of the planned seam and of the servo's
    report, and further ones by their names in JobPorts.
    """
    station, scenario = wiring.station, wiring.scenario
    tool, spec = station.tool, scenario.workpiece
    if (
        tool is None
        or spec is None
        or station.cad is None
        or not isinstance(scenario.finger_camera, FingerCameraConfig)
    ):
        return wiring.constant("no_seam", PlannedSeam()), wiring.constant("no_servo", ServoReport()), {}
    out, command, job = wiring.out, sequencer.GetOutputPort("job"), scenario.job
    position = spine.arm.position
    kind = SeamPlanner if spec.located_by == "scan" else DrawnSeamPlanner
    carried = scenario.carried_scanner()
    if kind is DrawnSeamPlanner and unfelt_seams(station):
        raise InputError(
            "A seam that the tip does not feel is located by the scan, for a drawing states no sigma: write"
            " workpiece.located_by: scan."
        )
    more = [servo_config(scenario, station, k) for k in range(1, seam_count(station.cad))]
    planner = wiring.add(
        "seam_planner",
        kind(
            replace(seam_planning(scenario, station, config), configs=(config, *more)),
            None if job.calibrate or job.X_BC is None else job.X_BC.pose(),
            station.background,
            X_FC_known=None if carried is None else carried.pose(),
        ),
    )
    wiring.connect(planner, scan=out("scanner.scan"), job=command, calibration_status=status, history=spine.arm.history)
    finger = wiring.add(
        "deformation_estimator",
        ArucoDeformationEstimator(station.arm, tool, scenario.finger_camera.camera(), station.background),
    )
    wiring.connect(finger, image=out("finger_camera.image"), history=spine.arm.history, calibration_status=status)
    wiring.feed("finger_camera.streaming", sequencer.GetOutputPort("streaming"))
    more = [servo_config(scenario, station, k) for k in range(1, seam_count(station.cad))]
    passes, schedule_order = scenario.welding.later_passes(), scenario.welding.schedule
    servo = wiring.add("welding_servo", WeldingVelocityServo(station.arm, tool, config, more, passes, schedule_order))
    wiring.connect(
        servo,
        planned_seam=planner.GetOutputPort("planned_seam"),
        deformation=finger.GetOutputPort("deformation"),
        position_measured=position,
        sample_time=out("arm.sample_time"),
        job=command,
        hold=spine.hold,
        calibration_status=status,
    )
    reported = next((p for p in ("power_source.arc_established", "arm.arc_established") if station.has(p)), None)
    if reported is not None:
        wiring.connect(servo, arc_established=out(reported))
    schedule = wiring.add("arc_schedule", ArcSchedule(scenario.welding.schedule or WeldSchedule()))
    wiring.connect(
        schedule,
        servo_report=servo.GetOutputPort("servo_report"),
        planned_seam=planner.GetOutputPort("planned_seam"),
        process_on=spine.switch.GetOutputPort("process_on"),
    )
    if reported is not None:
        wiring.connect(schedule, arc_established=out(reported))
    for port in ("power_source.set_values", "arm.set_values"):
        if station.diagram.HasInputPort(port):
            wiring.feed(port, schedule.GetOutputPort("set_values"))
    wiring.connect(planner, servo_report=servo.GetOutputPort("servo_report"))
    guard = wiring.add("singularity_guard", SingularityGuard(station.arm, tool.X_FT))
    wiring.connect(guard, V_BT=servo.GetOutputPort("V_BT"), position_measured=position)
    logged = {
        "telemetry": servo.GetOutputPort("telemetry"),
        "margin": guard.GetOutputPort("margin"),
        "deflection": finger.GetOutputPort("deflection"),
        "position": position,
    }
    others = {"tip_and_deflection": "cheat.contact", "torch": "cheat.torch"}
    others |= {"arc": reported or "", "arc_values": "power_source.arc_values"}  # where the power source gives them
    logged |= {name: out(port) for name, port in others.items() if station.has(port)}
    logged |= {"set_values": schedule.GetOutputPort("set_values"), "gap": schedule.GetOutputPort("gap")}
    logged["torch_on"] = spine.switch.GetOutputPort("process_on")
    ports = {"velocity": guard.GetOutputPort("velocity"), "margin": guard.GetOutputPort("margin"), "logged": logged}
    ports["torch_wanted"] = servo.GetOutputPort("torch_on")
    return planner.GetOutputPort("planned_seam"), servo.GetOutputPort("servo_report"), ports


JOB = Weld()
