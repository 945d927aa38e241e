"""The profiler job: calibrates a laser profiler by an edge and by a touched sphere, measures a seam, moves along it."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context

from weldcal.models.arms.kinematics import ArmModel, jacobian
from weldcal.models.errors import InputError
from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.drivers.config import NoDevice
from weldcal.systems.drivers.simulated.profiler_world import (
    ProfilerFixture,
    ProfilerTruth,
    box_mesh,
    post_mesh,
    straightedge_mesh,
    under_straightedge,
)
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler, drawn_pose
from weldcal.systems.drivers.simulated.rendered_scanner import random_pose_error
from weldcal.systems.drivers.simulated.world import WorldSetup
from weldcal.systems.jobs.job import AddedJob, Job, Phases
from weldcal.systems.jobs.profiler.config import ProfilerJob, check_profiler_job, pose_of
from weldcal.systems.jobs.profiler.plan import PlanningContext
from weldcal.systems.jobs.profiler.procedure import PLANS, ProfilerProcedure, ProfilerState
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand
from weldcal.systems.motion.spine import MOVE_TIMEOUT_S, Spine
from weldcal.systems.phase_words import phase_words
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Wiring


class RobotError(LeafSystem):
    """Adds joint offsets so that the reported flange position differs from the true one, drawn for each goal.

    .. pydrake_system::

        name: RobotError
        input_ports:
        - position_measured
        - job
        output_ports:
        - position

    Both positions (6) rad. The error of the flange's position is `sigma_m` per axis, the orientation has none. It is
    constant for one goal, including the touch after a move and a whole pass.
    """

    def __init__(self, arm: ArmModel, sigma_m: float, seed: int) -> None:
        super().__init__()
        self._arm, self._sigma_m, self._seed = arm, sigma_m, seed
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self.DeclareVectorOutputPort("position", 6, self._add)

    def _add(self, context: Context, output: BasicVector) -> None:
        job: JobCommand = self._job.Eval(context)
        q = np.array(self._position.Eval(context))
        shift = self._sigma_m * np.random.default_rng([self._seed, job.goal_id]).standard_normal(3)
        output.SetFromVector(q + np.linalg.solve(jacobian(self._arm, q), np.concatenate([np.zeros(3), shift])))


@dataclass(eq=False, kw_only=True)
class AddedProfilerJob(AddedJob):
    """The systems of the job."""

    job: ProfilerJob
    procedure: ProfilerProcedure

    def stage(self, root: Context, phases: Phases) -> tuple[str, float]:
        """See AddedJob."""
        state: ProfilerState = self.state(root)
        steps = sum(len(PLANS[stage]) for stage in self.job.stages)
        return state.step or phase_words("start"), 0.05 + 0.9 * (steps - len(state.steps_left)) / max(steps + 1, 1)


class Profiler(Job[PlanningContext]):
    """The job of a scenario with a `profiler_job` part."""

    key = "profiler_job"
    config = ProfilerJob
    move_speed, move_acceleration = 1.2, 5.0  # most moves are short

    def check(self, scenario: Scenario) -> None:
        """See Job."""
        if isinstance(scenario.profiler, RenderedProfiler):
            scenario.profiler.preset()
        check_profiler_job(
            scenario.part(ProfilerJob),
            has_profiler=not isinstance(scenario.profiler, NoDevice),
            has_groove=scenario.workpiece is not None,
            tool=str(scenario.tool),
        )

    def set_up_world(
        self, scenario: Scenario, rng: np.random.Generator, part: WeldPart | None, X_BP: RigidTransform | None
    ) -> WorldSetup:
        """See Job: the objects that the profiler scans and the torch touches."""
        p, job = scenario.profiler, scenario.part(ProfilerJob)
        if not isinstance(p, RenderedProfiler) or job is None:
            return WorldSetup()
        error = 1e-3 * p.mounting_translation_mm, float(np.deg2rad(p.mounting_rotation_deg))
        table_z_m = scenario.calibration.table_z_m
        fixture = draw_fixture(drawn_pose(p), *error, job, rng, table_z_m, part, X_BP)
        return WorldSetup(
            profiler=fixture, time_step_s=fixture.time_step_s, parts=(fixture, fixture.truth), contacts_read=True
        )

    def position_error(self, scenario: Scenario, arm: ArmModel, seed: int) -> LeafSystem | None:
        """See Job: adds position errors to a simulated arm; a real arm has its own errors."""
        job = scenario.part(ProfilerJob)
        assert job is not None
        return RobotError(arm, 1e-3 * job.robot_sigma_mm, seed) if scenario.robot.SIMULATED else None

    def plan(self, scenario: Scenario, station: Station, seed: int) -> PlanningContext:
        """See Job: the nominal data with which the procedure starts."""
        job = scenario.part(ProfilerJob)
        if job is not None and "sphere" in job.stages and not station.diagram.HasOutputPort("torch.touch"):
            raise InputError(
                "This cell cannot detect when the torch touches the sphere: add touch_probe: !UrTouchProbe {host:"
                " ..., input: ...}, or write profiler_job: {stages: [edge]}."
            )
        return planning_context(scenario, station)

    def add(self, wiring: Wiring, spine: Spine, plan: PlanningContext) -> AddedProfilerJob:
        """See Job."""
        profiler = wiring.scenario.profiler
        assert isinstance(profiler, RenderedProfiler)
        procedure = wiring.add(
            "profiler_procedure",
            ProfilerProcedure(
                plan,
                profiler,
                wiring.seed,
                wiring.station.background,
                move_timeout_s=MOVE_TIMEOUT_S / wiring.scenario.job.speed_factor,
            ),
        )
        spine.serve(procedure, profile=wiring.out("profiler.profile"))
        known = wiring.station.diagram.HasOutputPort
        if known("torch.touch"):
            wiring.connect(procedure, touch=wiring.out("torch.touch"))
        wiring.feed("profiler.trigger", procedure.GetOutputPort("trigger"))
        ports = procedure.ports(logged={"torch": wiring.out("cheat.torch")} if known("cheat.torch") else {})
        return AddedProfilerJob(job=plan.job, procedure=procedure, ports=ports, maximum_time_s=plan.job.maximum_time_s)


def planning_context(scenario: Scenario, station: Station) -> PlanningContext:
    """Return the nominal data with which the procedure starts, from drawings only."""
    job, profiler, spec = scenario.part(ProfilerJob), scenario.profiler, scenario.workpiece
    if job is None or not isinstance(profiler, RenderedProfiler):
        raise InputError("This scenario has no profiler: write profiler: !RenderedProfiler {} and profiler_job: {}.")
    return PlanningContext(
        arm=station.arm,
        job=job,
        q_home=np.deg2rad(scenario.home_deg),
        X_FS=drawn_pose(profiler),
        p_FTip=np.array(job.torch.tip_m),
        center=np.array(job.ball.xyz_m),
        cad=station.cad,
        X_BP=None if spec is None else spec.pose_guess.pose(),
        table_z_m=scenario.calibration.table_z_m,
        surroundings=station.surroundings,
    )


JOB = Profiler()


def draw_fixture(
    X_FS_drawn: RigidTransform,
    error_m: float,
    error_rad: float,
    job: ProfilerJob,
    rng: np.random.Generator,
    table_z_m: float,
    workpiece: WeldPart | None,
    X_BP: RigidTransform | None,
) -> ProfilerFixture:
    """Draw the deviations of the true fixture from its nominal dimensions and poses."""
    off = random_pose_error(rng, error_m, error_rad)
    X_FS = RigidTransform(X_FS_drawn.rotation() @ off.rotation(), X_FS_drawn.translation() + off.translation())
    bent = rng.normal(size=3)
    tip = np.array(job.torch.tip_m) + 1e-3 * job.torch.error_mm * bent / np.linalg.norm(bent)
    s = job.straightedge
    moved = random_pose_error(rng, 1e-3 * s.translation_mm, np.deg2rad(s.rotation_deg))
    thought = pose_of(s.xyz_m, s.rpy_deg)
    X_BE = RigidTransform(thought.rotation() @ moved.rotation(), thought.translation() + moved.translation())
    aside = rng.normal(size=3)
    center = np.array(job.ball.xyz_m) + 1e-3 * job.ball.translation_mm * aside / np.linalg.norm(aside)
    radius = 1e-3 * job.ball.radius_mm
    truth = ProfilerTruth(
        X_FS, tip, np.array(X_BE.translation()), X_BE.rotation().matrix()[:, 0].copy(), center, radius
    )
    meshes = [
        (straightedge_mesh(1e-3 * s.length_mm, 1e-3 * s.width_mm).transformed(X_BE), 0.0),
        *(
            (post_mesh(p, table_z_m), 0.6)
            for p in (under_straightedge(X_BE, 1e-3 * s.width_mm), center - [0.0, 0.0, 0.9 * radius])
        ),
        (box_mesh([0.45, 0.0, table_z_m - 0.02], [1.5, 1.2, 0.04]), 0.6),
    ]
    if workpiece is not None and X_BP is not None:
        meshes.append((workpiece.mesh.transformed(X_BP), 0.0))
    return ProfilerFixture(truth, X_BE, job, tuple(meshes))
