"""The tablet job and its plan: one picture of the tablet, then the pen touches each of its landmarks."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context

from weldcal.calibration.planning.clearance import LinkCapsule, arm_bodies
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.drivers.simulated.rendered_wrist_camera import RenderedWristCamera
from weldcal.systems.drivers.simulated.tablet_world import tablet_fittings
from weldcal.systems.drivers.simulated.world import WorldSetup
from weldcal.systems.jobs.job import AddedJob, Job, Phases
from weldcal.systems.jobs.tablet.config import TabletConfig, TabletTruth, WristPicture, check_tablet
from weldcal.systems.jobs.tablet.procedure import TabletPlan, TabletProcedure, TabletState
from weldcal.systems.motion.clear_moves import clear_move
from weldcal.systems.motion.guarded_path import check_path, straight
from weldcal.systems.motion.spine import MOVE_TIMEOUT_S, Spine
from weldcal.systems.phase_words import phase_words
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Wiring

PEN_BODY_M = 0.006  # radius of the pen in the clearance checks
# a slightly inclined view determines the tablet's tilt better than a perpendicular one
_LOOK_ASLANT_RAD = (0.12, -0.10)
# between the tilt directions of consecutive touches: the golden angle, so that no direction repeats
_LEAN_STEP_RAD = 2.4


def tablet_of(scenario: Scenario) -> TabletConfig:
    """Return the nominal tablet; raises InputError where there is none."""
    tablet = scenario.part(TabletConfig)
    if tablet is None:
        raise InputError("This scenario has no tablet: write tablet: {} and tool: pen in it, or run scenario 'tablet'.")
    return tablet


def camera_of(scenario: Scenario) -> RenderedWristCamera:
    """Return the nominal wrist camera; raises InputError where there is none."""
    if not isinstance(scenario.wrist_camera, RenderedWristCamera):
        raise InputError("The tablet job needs a camera: write wrist_camera: !RenderedWristCamera {} in the scenario.")
    return scenario.wrist_camera


def nearest_joints(arm: ArmModel, X_BF: RigidTransform, q_near: Array) -> Array:
    """Return the joints (6,) of a flange pose nearest to `q_near`, whole turns included.

    Raises InputError where out of reach.
    """
    found = inverse_kinematics(arm, X_BF)
    if len(found) == 0:
        raise InputError("The arm cannot reach the tablet at its nominal pose; move it nearer in the scenario.")
    turns = found + 2.0 * np.pi * np.round((q_near - found) / (2.0 * np.pi))
    inside = np.all((turns >= arm.position_lower) & (turns <= arm.position_upper), axis=1)
    turns = np.where(np.reshape(inside, (-1, 1)), turns, found)
    return np.asarray(turns[np.abs(turns - q_near).max(axis=1).argmin()])


def plan_tablet(scenario: Scenario, arm: ArmModel) -> TabletPlan:
    """Plan the camera pose and the descents onto each landmark from nominal poses.

    Raises:
        InputError: the scenario has no tablet, or a pose is out of reach. InfeasiblePath: so is a descent.
    """
    tablet, X_FC = tablet_of(scenario), camera_of(scenario).nominal()
    q_home = np.deg2rad(scenario.home_deg)
    X_BT, page, p_FP = tablet.pose(), tablet.landmarks_m(), np.array(tablet.pen.tip_m)
    X_FP = RigidTransform(p_FP)
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
        X_BP = RigidTransform(R, tip)
        q = nearest_joints(arm, X_BP @ X_FP.inverse(), q)
        way = np.array([0.0, 0.0, -1e-3 * (tablet.clearance_mm + tablet.deepest_mm)])
        check_path(arm, q, [straight(f"the descent to landmark {k + 1}", X_BP, way, 1e-3 * tablet.descent_mm_s, X_FP)])
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
    """Check that every straight move in joint space keeps arm and pen above the table and free of self-collision.

    Raises:
        InputError: one does not; nothing has moved.
    """
    pen = Capsule(6, np.zeros(3), plan.p_FP, PEN_BODY_M)
    bodies: list[LinkCapsule] = arm_bodies(station.arm, (pen,))
    goals = [plan.q_home, plan.q_look, *plan.q_above, plan.q_home]
    names = ["home", "the look", *(f"landmark {k + 1}" for k in range(len(plan.q_above))), "home"]
    for k in range(len(goals) - 1):
        if not clear_move(scenario, station, bodies, goals[k], goals[k + 1]):
            raise InputError(
                f"The move from {names[k]} to {names[k + 1]} would touch the table, the surroundings or the arm itself:"
                " choose another home_deg, a smaller tablet.turn_deg, or another place for the tablet."
            )


@dataclass(eq=False, kw_only=True)
class AddedVisit(AddedJob):
    """The systems of the job, the nominal tablet and camera; `known` is the ground truth of a simulation."""

    plan: TabletPlan
    tablet: TabletConfig
    camera: RenderedWristCamera
    procedure: TabletProcedure
    station: Station
    known: TabletTruth | None

    @property
    def truth(self) -> TabletTruth:
        """For reports and tests; raises RuntimeError in a cell that is not simulated."""
        if self.known is None:
            raise RuntimeError("only a simulated tablet has a known true pose")
        return self.known

    def picture(self, root: Context) -> WristPicture:
        """Return the camera's newest picture."""
        diagram = self.station.diagram
        shown: WristPicture = diagram.GetOutputPort("wrist_camera.picture").Eval(diagram.GetMyContextFromRoot(root))
        return shown

    def view(self) -> tuple[Array, Array]:
        """See AddedJob: in front of the tablet."""
        middle = self.tablet.pose().multiply(np.r_[0.5 * self.tablet.landmarks_m().max(axis=0), 0.0])
        return middle + np.array([0.55, -0.35, 0.45]), middle + np.array([0.0, 0.0, 0.08])

    def stage(self, root: Context, phases: Phases) -> tuple[str, float]:
        """See AddedJob: the picture is a tenth of the run, the touches are nearly all of the rest."""
        state: TabletState = self.state(root)
        touching = state.phase in ("to_above", "descend", "lift")
        text = phase_words(state.phase, f"{state.landmark + 1} of {len(self.plan.q_above)}" if touching else "")
        touched = 0.80 * len(state.touches) / len(self.plan.q_above)
        return text, 0.95 if state.finished else 0.05 + 0.05 * (state.trigger > 0) + touched


class Tablet(Job[TabletPlan]):
    """The job of a scenario with a `tablet` part."""

    key = "tablet"
    config = TabletConfig

    def check(self, scenario: Scenario) -> None:
        """See Job."""
        check_tablet(scenario)

    def set_up_world(
        self, scenario: Scenario, rng: np.random.Generator, part: WeldPart | None, X_BP: RigidTransform | None
    ) -> WorldSetup:
        """See Job: camera, pen and tablet at their true poses."""
        visit = tablet_fittings(tablet_of(scenario), scenario.wrist_camera, scenario.digitizer, rng)
        return WorldSetup(fittings=(visit,), parts=(visit.tablet, visit.truth), contacts_read=True)

    def plan(self, scenario: Scenario, station: Station, seed: int) -> TabletPlan:
        """See Job."""
        plan = plan_tablet(scenario, station.arm)
        check_moves(scenario, station, plan)
        return plan

    def add(self, wiring: Wiring, spine: Spine, plan: TabletPlan) -> AddedVisit:
        """See Job."""
        station, scenario = wiring.station, wiring.scenario
        procedure = wiring.add("tablet_procedure", TabletProcedure(station.arm, plan))
        picture = wiring.out("wrist_camera.picture")
        spine.serve(procedure, picture=picture, touch=wiring.out("digitizer.touch"))
        wiring.feed("wrist_camera.trigger", procedure.GetOutputPort("trigger"))
        return AddedVisit(
            plan=plan,
            tablet=tablet_of(scenario),
            camera=camera_of(scenario),
            procedure=procedure,
            station=station,
            known=station.truth.tablet,
            ports=procedure.ports(shown={"picture": picture}),
            maximum_time_s=plan.maximum_time_s,
        )


JOB = Tablet()
