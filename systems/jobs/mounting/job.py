"""The mounting job: calibrates a scanner in any mounting by the robot's flange or base circle, with one arm or two."""

import dataclasses as dc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from weldcal.calibration.data.header import DatasetHeader, ScannerGuess, SecondRobot, placed
from weldcal.calibration.flange.warm_up import warm_up
from weldcal.calibration.planning.mounting_estimate import Circle
from weldcal.calibration.planning.mounting_poses import MountingPlan, MountingPose, plan_mounting_poses
from weldcal.calibration.planning.mounting_scene import MountingScene
from weldcal.calibration.recorded_carried import described_scene
from weldcal.models.arms.kinematics import LINKS, ArmModel
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.robots import base_circle
from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.background import Answer, Background, BackgroundSystem
from weldcal.systems.drivers.simulated.rendered_scanner import random_pose_error
from weldcal.systems.drivers.simulated.second_arm import place_second_arm
from weldcal.systems.drivers.simulated.world import WorldSetup
from weldcal.systems.jobs.job import AddedJob, Job, Phases
from weldcal.systems.jobs.mounting.config import MountingJob
from weldcal.systems.jobs.mounting.procedure import MountingProcedure, MountingState, MountingStatus
from weldcal.systems.messages import Scan
from weldcal.systems.motion.buffers import PoseHistory
from weldcal.systems.motion.spine import Spine
from weldcal.systems.phase_words import phase_words
from weldcal.systems.scenario.checks import check_home
from weldcal.systems.scenario.parts import surroundings_of
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Wiring

SPARE = 8  # additional poses, from which the next best one is selected


@dc.dataclass(frozen=True)
class MountingFitConfig:
    """The circle, and the stop criterion (m)."""

    circle: Circle
    minimum_scans: int
    required_error_m: float


class MountingCalibrator(BackgroundSystem):
    """Fits the circle in each scan near its prediction, and solves the mounting's equation with all observations.

    .. pydrake_system::

        name: MountingCalibrator
        input_ports:
        - scan
        - state
        - history
        - history_2
        output_ports:
        - status

    `history_2` is read only where the scene has a second arm.
    """

    def __init__(
        self,
        scene: MountingScene,
        config: MountingFitConfig,
        plan: Sequence[MountingPose],
        background: Background | None = None,
        period_s: float = 0.02,
    ) -> None:
        super().__init__("status", MountingStatus(), background, period_s)
        self.background.prepare(warm_up)
        self._scene, self._config, self._plan = scene, config, tuple(plan)
        self._scan = self.DeclareAbstractInputPort("scan", AbstractValue.Make(Scan()))
        self._state = self.DeclareAbstractInputPort("state", AbstractValue.Make(MountingState()))
        self._history = self.DeclareAbstractInputPort("history", AbstractValue.Make(PoseHistory()))
        self._history_2 = self.DeclareAbstractInputPort("history_2", AbstractValue.Make(PoseHistory()))

    def ask(self, context: Context, newest: MountingStatus) -> Answer[MountingStatus] | None:
        """Ask for the status with a new scan."""
        scan: Scan = self._scan.Eval(context)
        job: MountingState = self._state.Eval(context)
        if scan.sequence <= newest.sequence or scan.sequence != job.trigger:
            return None
        q = self._history.Eval(context).joints_at(scan.capture_time)
        q_2 = self._history_2.Eval(context).joints_at(scan.capture_time) if self._scene.two else None
        return self.background.ask(digest, newest, scan, job, (q, q_2), self._scene, self._config, self._plan)


def digest(
    status: MountingStatus,
    scan: Scan,
    job: MountingState,
    joints: tuple[Array | None, Array | None],
    scene: MountingScene,
    config: MountingFitConfig,
    plan: Sequence[MountingPose],
) -> MountingStatus:
    """Compute the status after one more scan, as `weldcal calibrate` does; then the pose that would help most."""
    status = dc.replace(status, sequence=scan.sequence)
    q, q_2 = joints
    if q is None or (scene.two and q_2 is None):
        return status.refusing(job.label, "the arm's pose at the time of the scan is not known")
    verify, points = job.purpose == "verify", scan.points_C.astype(float)
    found = status.with_scan(scene, config.circle, job.label, points, (q, q_2), held_out=verify)
    if found.result is status.result:
        return found
    done = len(found.seen) >= config.minimum_scans and found.error_95_m <= config.required_error_m
    return dc.replace(found.proposing(scene, plan), done=done)


@dataclass(frozen=True, eq=False)
class MountingPlanned:
    """The header of the scans' dataset, the scene before the first scan, the circle, and the poses to visit."""

    header: DatasetHeader
    scene: MountingScene
    circle: Circle
    poses: tuple[MountingPose, ...]


@dataclass(eq=False, kw_only=True)
class AddedMounting(AddedJob):
    """The systems of the job; `truth` (X, and Y or Z where they are estimated) is for reports and tests only."""

    header: DatasetHeader
    scene: MountingScene
    plan: tuple[MountingPose, ...]
    scans: int
    procedure: MountingProcedure
    calibrator: MountingCalibrator
    truth: dict[str, RigidTransform]

    def status(self, root: Context) -> MountingStatus:
        """Return the present result of the calibration."""
        status: MountingStatus = self.value(self.calibrator.GetOutputPort("status"), root)
        return status

    def stage(self, root: Context, phases: Phases) -> tuple[str, float]:
        """See AddedJob."""
        state: MountingState = self.state(root)
        return phase_words(state.phase, state.label) if state.label else phase_words("home"), 0.05 + 0.85 * min(
            (state.visit + 1) / max(self.scans, 1), 1.0
        )


class MountingCalibrationJob(Job[MountingPlanned]):
    """The job of a scenario with a `mounting` part."""

    key = "mounting"
    config = MountingJob

    def check(self, scenario: Scenario) -> None:
        """See Job."""
        job = scenario.part(MountingJob)
        if job is not None and job.second_arm is not None:
            check_home(job.second_arm.home_deg, job.second_arm.arm, "mounting.second_arm.home_deg")

    def set_up_world(
        self, scenario: Scenario, rng: np.random.Generator, part: WeldPart | None, X_BP: RigidTransform | None
    ) -> WorldSetup:
        """See Job: the ring of the base mounting, and the second arm at its true pose."""
        job, second = scenario.part(MountingJob), None
        config = None if job is None else job.second_arm
        if config is not None:
            off = random_pose_error(
                rng, 1e-3 * config.placement_translation_mm, np.deg2rad(config.placement_rotation_deg)
            )
            second = place_second_arm(config, off)
        return WorldSetup(second=second, foot=base_circle(scenario.arm), time_step_s=0.004)  # this job has no contact

    def plan(self, scenario: Scenario, station: Station, seed: int) -> MountingPlanned:
        """See Job."""
        header, scene, circle = mounting_scene(scenario, station.arm)
        return MountingPlanned(header, scene, circle, plan_mounting(scenario, scene, seed))

    def add(self, wiring: Wiring, spine: Spine, plan: MountingPlanned) -> AddedMounting:
        """See Job."""
        scenario, c, scene = wiring.scenario, wiring.scenario.calibration, plan.scene
        maximum_time_s = scenario.job.maximum_time_s / scenario.job.speed_factor
        home = (scene.q_home, scene.q_home_2)
        procedure = wiring.add(
            "mounting_procedure",
            MountingProcedure(plan.poses, c.maximum_scans, c.verification_scans, home, maximum_time_s=maximum_time_s),
        )
        fit = MountingFitConfig(plan.circle, c.minimum_scans, c.required_error_mm * 1e-3)
        calibrator = wiring.add(
            "mounting_calibrator", MountingCalibrator(scene, fit, plan.poses, wiring.station.background)
        )
        wiring.connect(calibrator, scan=wiring.out("scanner.scan"), state=procedure.GetOutputPort("state"))
        spine.serve(procedure, status=calibrator.GetOutputPort("status"))
        wiring.feed("scanner.trigger", procedure.GetOutputPort("trigger"))
        wiring.connect(calibrator, history=spine.arm.history)
        for second in spine.arms[1:]:
            wiring.connect(calibrator, history_2=second.history)
            wiring.connect(procedure, settled_goal_2=second.settled_goal, robot_status_2=second.status)
        shown = {"status": calibrator.GetOutputPort("status"), "scan": wiring.out("scanner.scan")}
        return AddedMounting(
            header=plan.header,
            scene=scene,
            plan=plan.poses,
            scans=c.maximum_scans + c.verification_scans,
            procedure=procedure,
            calibrator=calibrator,
            truth=true_poses(scene, wiring.station),
            ports=procedure.ports(len(spine.arms), shown=shown),
            maximum_time_s=maximum_time_s,
        )


def mounting_scene(scenario: Scenario, arm: ArmModel) -> tuple[DatasetHeader, MountingScene, Circle]:
    """Return the header of a dataset of the run's scans, the scene as known before the first one, and the circle.

    From drawings and rough measurements.
    """
    job, c, scanner = scenario.part(MountingJob), scenario.calibration, scenario.scanner_config()
    if job is None or scanner is None:
        raise InputError("A mounting job needs a scanner and a mounting part: write mounting: {} in the scenario.")
    preset, guess, second = scanner.scanner(), c.mounting_guess.pose(), job.second_arm
    header = DatasetHeader(
        robot=scenario.arm,
        flange=scenario.flange_name(),
        scanner=preset.name,
        configuration=c.configuration,
        note="scans of a run",
        scanner_guess=ScannerGuess(**placed(guess), radius_m=c.guess_radius_mm * 1e-3),
        scanner_link=scanner.mounted_on if scanner.mounted_on in LINKS else "",
    )
    known: dict[str, Any] = {
        "scanner": preset,
        "target_known": job.target_known,
        "surroundings": surroundings_of(scenario),
    }
    if second is not None:
        header.second_robot = SecondRobot(robot=second.arm, **placed(second.pose()))
        known |= {"X_BD": second.pose(), "q_home_2": np.deg2rad(second.home_deg)}
    return header, *described_scene(header, arm, guess, np.deg2rad(scenario.home_deg), **known)


def plan_mounting(scenario: Scenario, scene: MountingScene, seed: int) -> tuple[MountingPose, ...]:
    """Plan the calibration poses, the held-out poses and spare ones, before any motion. Raises UnreachableScanner."""
    c = scenario.calibration
    return plan_mounting_poses(scene, c.maximum_scans, c.verification_scans, mounting_plan(scenario, seed))


def mounting_plan(scenario: Scenario, seed: int) -> MountingPlan:
    """Return the limits of the poses that the scenario states."""
    c, job = scenario.calibration, scenario.part(MountingJob)
    assert job is not None
    visited = c.maximum_scans + c.verification_scans
    return MountingPlan(
        seed=seed,
        theta_max_rad=np.deg2rad(c.theta_max_deg),
        spread_rad=np.deg2rad(job.spread_deg),
        max_travel_rad=np.deg2rad(job.travel_deg),
        table_z_m=c.table_z_m,
        margin_m=c.clearance_m,
        candidates=visited + SPARE,
    )


def true_poses(scene: MountingScene, station: Station) -> dict[str, RigidTransform]:
    """Return the true values of the unknowns; in simulation the circle is exactly at its nominal pose."""
    found = {} if station.truth.X_LC is None else {"X": station.truth.X_LC}
    if station.truth.X_BD is not None:
        found["Y"] = station.truth.X_BD
    if not scene.target_known:
        found["Z" if scene.two else "Y"] = scene.X_HR
    return found


JOB = MountingCalibrationJob()
