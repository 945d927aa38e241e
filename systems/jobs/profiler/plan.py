"""Plans the profiler job from nominal poses: scans of edge and sphere, touches, passes along a seam; clearances."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.interpolate import CubicSpline

from weldcal.calibration.planning.clearance import LinkCapsule, Surroundings, arm_bodies, path_clearance
from weldcal.calibration.profiler.edge.model import EdgeState
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.plan import (
    Field,
    plan_edge_poses,
    plan_sphere_poses,
    sample_edge_poses,
    sample_sphere_poses,
)
from weldcal.calibration.profiler.sphere.model import SphereSigmas
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import LINKS, ArmModel, forward_kinematics
from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.drivers.simulated.profiler_world import BEVEL_M, POST_RADIUS_M, rig_points, under_straightedge
from weldcal.systems.jobs.profiler.config import ProfilerJob, edge_as_thought, pose_of
from weldcal.systems.messages import Message
from weldcal.systems.motion.guarded_path import GuardedMotion, InfeasiblePath, check_path, straight
from weldcal.welding.seam.curve import SeamCurve

# along a move, between the configurations that are checked against table, surroundings and the arm itself
STEP_RAD = 0.1
STEP_M = 5e-4  # of torch and profiler, between those that are checked against the objects, where these are near
FASTER = 1.2  # than the mean speed in a step of STEP_RAD: no point of the rig is


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanningContext:
    """Nominal or, later, calibrated poses: X_FS, the tip in F, the sphere's centre in B.

    The nominal workpiece at X_BP.
    """

    arm: ArmModel
    job: ProfilerJob
    q_home: Array
    X_FS: RigidTransform
    p_FTip: Array
    center: Array
    cad: WeldPart | None = None
    X_BP: RigidTransform | None = None
    table_z_m: float = 0.0
    surroundings: Surroundings = field(default_factory=Surroundings)

    @property
    def radius_m(self) -> float:
        """Radius of the sphere, m."""
        return 1e-3 * self.job.ball.radius_mm

    @property
    def field(self) -> Field:
        """The depth range of the calibration."""
        return Field(1e-3 * self.job.half_width_mm, 1e-3 * self.job.near_mm, 1e-3 * self.job.far_mm)

    def bodies(self) -> list[LinkCapsule]:
        """Return the arm with the rig on its flange."""
        at = np.array(self.X_FS.translation())
        capsules = [
            Capsule(len(LINKS), np.zeros(3), np.array(self.p_FTip), 0.008),
            Capsule(len(LINKS), np.array([at[0], at[1], 0.01]), at, 0.030),
        ]
        return arm_bodies(self.arm, capsules)

    def gap(self, X_BF: RigidTransform) -> float:
        """Smallest distance (m) of torch and profiler from the surrounding objects; negative inside."""
        points, radii = rig_points(self.p_FTip, self.X_FS)
        p = X_BF.multiply(points.T).T
        e = self.job.straightedge
        X_BE, length, width = pose_of(e.xyz_m, e.rpy_deg), 1e-3 * e.length_mm, 1e-3 * e.width_mm
        gaps = [
            _to_box(p, X_BE, [-0.5 * length, 0.0, -BEVEL_M], [0.5 * length, width, 0.0]),
            np.linalg.norm(p - self.center, axis=1) - self.radius_m,
            _to_post(p, under_straightedge(X_BE, width)),
            _to_post(p, self.center),
        ]
        if self.cad is not None and self.X_BP is not None:
            x, y, z = self.cad.size_m
            gaps.append(_to_box(p, self.X_BP, [-0.5 * x, -0.5 * y, -z], [0.5 * x, 0.5 * y, 0.0]))
        return float((np.min(gaps, axis=0) - radii).min())

    def clear_way(self, q_a: Array, q_b: Array) -> bool:
        """Return whether a straight move in joint space keeps torch, profiler and arm clear of all objects."""
        if not self._keeps_gap(q_a, q_b, 0.5e-3 * self.job.clearance_mm):
            return False
        if self.surroundings.touched_on_path(self.arm, self.bodies(), q_a, q_b):
            return False
        lowest, gap = path_clearance(self.arm, self.bodies(), q_a, q_b, 2.0 * STEP_RAD)
        return lowest > self.table_z_m and gap > 0.0

    def _keeps_gap(self, q_a: Array, q_b: Array, least_m: float) -> bool:
        """Return whether torch and profiler keep `least_m` (m) on a straight move in joint space.

        From each checked configuration on by no more than what they have left there.
        """
        n = max(2, int(np.ceil(float(np.abs(q_b - q_a).max()) / STEP_RAD)) + 1)
        rig, _ = rig_points(self.p_FTip, self.X_FS)
        at = [forward_kinematics(self.arm, q_a + u * (q_b - q_a)).multiply(rig.T).T for u in np.linspace(0.0, 1.0, n)]
        # m of the fastest point for the whole of the move
        speed = max(FASTER * (n - 1) * float(np.linalg.norm(np.diff(at, axis=0), axis=2).max()), STEP_M)
        u = 0.0
        while True:
            left = self.gap(forward_kinematics(self.arm, q_a + u * (q_b - q_a))) - least_m
            if left < 0.0:
                return False
            if u >= 1.0:
                return True
            u = min(u + max(left, STEP_M) / speed, 1.0)

    def standing(self, poses: FlangePoses) -> tuple[Array, NDArray[np.intp]]:
        """Joints (n, 6) of the poses that are reachable and clear, and their indices."""
        q, which = [], []
        for k, (R, p) in enumerate(zip(poses.rotation, poses.translation, strict=True)):
            X = RigidTransform(np.vstack([np.column_stack([R, p]), [0.0, 0.0, 0.0, 1.0]]))
            if self.gap(X) < 1e-3 * self.job.clearance_mm:
                continue
            found = nearest_solution(self.arm, X, self.q_home)
            if found is not None:
                q.append(found)
                which.append(k)
        return np.array(q).reshape(-1, 6), np.array(which, dtype=np.intp)

    def route(self, q_from: Array, goals: Array) -> list[tuple[Array, int]]:
        """A route through all goals (n, 6), each time to the nearest one left: (joints, goal's index or -1: home).

        Raises:
            InputError: a goal has no clear move, not even from home.
        """
        here, left, way = q_from, list(range(len(goals))), []
        while left:
            k = min(left, key=lambda j: float(np.abs(goals[j] - here).max()))
            left.remove(k)
            if not self.clear_way(here, goals[k]):
                if not (self.clear_way(here, self.q_home) and self.clear_way(self.q_home, goals[k])):
                    continue
                way.append((self.q_home, -1))
            way.append((goals[k], k))
            here = goals[k]
        if sum(k >= 0 for _, k in way) < 0.8 * len(goals):
            raise InputError(
                "Too many of the profiler's poses have no clear move: place the objects farther apart in profiler_job."
            )
        return way


def _to_box(p: Array, X: RigidTransform, low: list[float], high: list[float]) -> Array:
    q = X.inverse().multiply(p.T).T
    outside = np.maximum(np.maximum(low - q, q - high), 0.0)
    inside = np.minimum(np.minimum(q - low, high - q).min(axis=1), 1.0)
    return np.asarray(np.where(inside > 0.0, -inside, np.linalg.norm(outside, axis=1)))


def _to_post(p: Array, top: Array) -> Array:
    below = np.maximum(p[:, 2] - top[2], 0.0)
    beside = np.maximum(np.hypot(p[:, 0] - top[0], p[:, 1] - top[1]) - POST_RADIUS_M, 0.0)
    return np.asarray(np.hypot(below, beside))


CANDIDATES = 160
FIRST = 5  # random poses with which the planner starts
CAP_RAD = np.radians(55.0)  # angle from the top of the sphere within which it is touched
SIDE_RAD = np.radians(62.0)  # largest angle between torch and the sphere's normal at a touch
LEAN_RAD = np.radians(25.0)
TURN_RAD = np.radians(60.0)
STATION_M = 0.004  # between joint positions along a pass
RAMP_S = 0.5  # ramps of a pass's speed at both ends


@dataclass(frozen=True, eq=False)
class JointPath(Message):
    """A joint path over its arc length s: knots (n,) m and joints (n, 6) rad, with a speed and ramps at both ends."""

    s: Array
    q: Array
    speed: float

    @property
    def duration(self) -> float:
        """Duration from rest to rest, s."""
        return float(self.s[-1] / self.speed + RAMP_S)

    def at(self, t: float) -> tuple[Array, Array, float]:
        """Joints (6,) rad, joint velocity (6,) rad/s and s (m) at a time since the start."""
        T, v = self.duration, self.speed
        t = min(max(t, 0.0), T)
        left = T - t
        if t < RAMP_S:
            s, ds = 0.5 * v * t * t / RAMP_S, v * t / RAMP_S
        elif left < RAMP_S:
            s, ds = float(self.s[-1]) - 0.5 * v * left * left / RAMP_S, v * left / RAMP_S
        else:
            s, ds = v * (t - 0.5 * RAMP_S), v
        return np.asarray(self.curve(s)), np.asarray(self.curve(s, 1)) * ds, float(s)

    @cached_property
    def curve(self) -> CubicSpline:
        """The spline q(s)."""
        return CubicSpline(self.s, self.q)

    def backwards(self) -> JointPath:
        """Return the reversed path."""
        return JointPath(self.s[-1] - self.s[::-1], self.q[::-1].copy(), self.speed)


@dataclass(frozen=True, eq=False)
class Goal(Message):
    """One goal: `via`, `scan`, `touch` (then descend along `way`, (3,) unit), or `pass` and `torch` along `path`."""

    kind: str
    q: Array
    way: Array | None = None
    path: JointPath | None = None


def plan_edge(planning: PlanningContext, q_from: Array, seed: int, sigma_xz_m: Array) -> list[Goal]:
    """Plan the scans of the straightedge.

    Those that minimise the predicted covariance, and held-out ones among the rest.

    Raises:
        InputError: too few poses are reachable and clear.
    """
    stage, job = planning.job.edge, planning.job
    point, direction = edge_as_thought(job)
    state = EdgeState(planning.X_FS.rotation().matrix(), np.array(planning.X_FS.translation()), point, direction)
    q, poses = _standing(
        planning, sample_edge_poses(state, CANDIDATES, seed, planning.field, stage.tilt_deg), "straightedge"
    )
    first, rest = _split(poses, stage.scans + stage.held_out)
    plan = plan_edge_poses(
        state,
        poses[first],
        poses[rest],
        stage.scans - FIRST,
        sigma_robot_m=1e-3 * job.robot_sigma_mm,
        sigma_xz_m=sigma_xz_m,
        field=planning.field,
    )
    return _scans(planning, q_from, q, first, rest, plan.chosen, stage.held_out)


def plan_sphere(planning: PlanningContext, q_from: Array, seed: int, sigmas: SphereSigmas) -> list[Goal]:
    """Plan the scans of the sphere; see plan_edge."""
    stage = planning.job.sphere
    R, t = planning.X_FS.rotation().matrix(), np.array(planning.X_FS.translation())
    candidates = sample_sphere_poses(
        R, t, planning.center, planning.radius_m, CANDIDATES, seed, planning.field, stage.tilt_deg
    )
    q, poses = _standing(planning, candidates, "sphere")
    first, rest = _split(poses, stage.scans + stage.held_out)
    plan = plan_sphere_poses(
        R,
        t,
        planning.center,
        planning.radius_m,
        poses[first],
        poses[rest],
        stage.scans - FIRST,
        sigmas=sigmas,
        field=planning.field,
    )
    return _scans(planning, q_from, q, first, rest, plan.chosen, stage.held_out)


def plan_touches(planning: PlanningContext, q_from: Array, seed: int) -> list[Goal]:
    """Plan touches at points spread over the sphere's upper part.

    The torch has a different inclination and rotation at each.

    Raises:
        InputError: too few of them can be reached.
    """
    stage, rng = planning.job.sphere, np.random.default_rng([seed, 5])
    yaw = RollPitchYaw(forward_kinematics(planning.arm, planning.q_home).rotation()).yaw_angle()
    q, normals = [], []
    for k in range(20 * stage.touches):
        # Fibonacci lattice: each new point lies in the largest gap of the previous ones
        cosine = 1.0 - (1.0 - np.cos(CAP_RAD)) * ((k + 0.5) % stage.touches) / stage.touches
        angle = 2.399963 * k
        n = np.array([np.sqrt(1.0 - cosine**2) * np.cos(angle), np.sqrt(1.0 - cosine**2) * np.sin(angle), cosine])
        lean = LEAN_RAD * rng.uniform(-1.0, 1.0, 2)
        R = RollPitchYaw(np.pi + lean[0], lean[1], yaw + TURN_RAD * rng.uniform(-1.0, 1.0)).ToRotationMatrix()
        if float(-R.matrix()[:, 2] @ n) < np.cos(SIDE_RAD):
            continue
        tip = planning.center + (planning.radius_m + 1e-3 * stage.gap_mm) * n
        X = RigidTransform(R, tip - R.multiply(planning.p_FTip))
        found = nearest_solution(planning.arm, X, planning.q_home)
        if found is not None and planning.gap(X) > 0.5e-3 * stage.gap_mm and _descends(planning, found, -n):
            q.append(found)
            normals.append(n)
        if len(q) == stage.touches:
            break
    if len(q) < stage.touches:
        raise InputError("The arm cannot touch the sphere from all sides at its nominal position: move it nearer.")
    return [
        Goal("via" if k < 0 else "touch", at, None if k < 0 else -normals[k])
        for at, k in planning.route(q_from, np.array(q))
    ]


def _descends(planning: PlanningContext, q: Array, way: Array) -> bool:
    """Whether the guard lets the torch descend along ``way`` (3,) from joints q (6,) rad to a touch's deepest place."""
    stage, X_FP = planning.job.sphere, RigidTransform(planning.p_FTip)
    way = 1e-3 * (stage.gap_mm + stage.deepest_mm) * way
    X_BP = forward_kinematics(planning.arm, q) @ X_FP
    try:
        check_path(planning.arm, q, [straight("the descent", X_BP, way, 1e-3 * stage.descent_mm_s, X_FP)])
    except InfeasiblePath:
        return False
    return True


def plan_pass(planning: PlanningContext, q_from: Array) -> list[Goal]:
    """Plan the profiler's passes along the nominal seam, square to the plate, the laser line across the groove."""
    assert planning.cad is not None
    assert planning.X_BP is not None
    stage = planning.job.seam
    keep = _stretch(planning, np.asarray(planning.cad.arc_length_m))
    seam = planning.X_BP.multiply(np.asarray(planning.cad.seam_P)[keep].T).T
    tangents = planning.X_BP.rotation().multiply(np.asarray(planning.cad.tangents_P)[keep].T).T
    up = planning.X_BP.rotation().matrix()[:, 2]
    top = seam + planning.cad.depth_m * up + 1e-3 * stage.stand_off_mm * up
    X_SF = planning.X_FS.inverse()
    flange = []
    for p, t in zip(top, tangents, strict=True):
        x = np.cross(t, up)
        flange.append(RigidTransform(RotationMatrix(np.column_stack([x, np.cross(-up, x), -up])), p) @ X_SF)
    goals = _along(planning, q_from, flange, top, 1e-3 * stage.pass_mm_s, "pass")
    for _ in range(stage.passes - 1):
        assert goals[-1].path is not None
        back = goals[-1].path.backwards()
        goals.append(Goal("pass", back.q[0], path=back))
    return goals


def plan_torch(planning: PlanningContext, q_from: Array, curve: SeamCurve) -> list[Goal]:
    """Plan the torch's path along a measured seam, upright, with the profiler ahead."""
    stage = planning.job.seam
    s = np.arange(0.0, curve.length, STATION_M)
    tips = curve.position(s) + 1e-3 * stage.above_root_mm * curve.up(s)
    flange = []
    for tip, t, up in zip(tips, curve.tangent(s), curve.up(s), strict=True):
        x = t - (t @ up) * up
        x /= np.linalg.norm(x)
        R = RotationMatrix(np.column_stack([x, np.cross(-up, x), -up]))
        flange.append(RigidTransform(R, tip - R.multiply(planning.p_FTip)))
    return _along(planning, q_from, flange, tips, 1e-3 * stage.torch_mm_s, "torch")


def _standing(planning: PlanningContext, candidates: FlangePoses, what: str) -> tuple[Array, FlangePoses]:
    q, which = planning.standing(candidates)
    if not len(q):
        raise InputError(f"The arm cannot move the profiler over the {what} at its nominal pose: move it.")
    return q, candidates[which]


def _split(poses: FlangePoses, wanted: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    if len(poses) < wanted + FIRST:
        raise InputError(
            f"Only {len(poses)} poses are clear and reachable, too few for {wanted} scans: ask for fewer or for less"
            " tilt."
        )
    return np.arange(FIRST), np.arange(FIRST, len(poses))


def _scans(
    planning: PlanningContext,
    q_from: Array,
    q: Array,
    first: NDArray[np.intp],
    rest: NDArray[np.intp],
    chosen: tuple[int, ...],
    held_out: int,
) -> list[Goal]:
    taken = [*first, *rest[list(chosen)]]
    spare = [k for k in rest if k not in taken][:held_out]
    way = planning.route(q_from, q[taken])
    goals = [Goal("via" if k < 0 else "scan", at) for at, k in way]
    more = planning.route(goals[-1].q, q[spare])
    return goals + [Goal("via" if k < 0 else "held_out", at) for at, k in more]


def _stretch(planning: PlanningContext, s: Array) -> NDArray[np.bool_]:
    """Mask of the nominal seam's points that are measured."""
    stage = planning.job.seam
    begin, end = 1e-3 * stage.ends_mm, float(s[-1]) - 1e-3 * stage.ends_mm
    if stage.seam_length_mm is not None:
        end = min(end, begin + 1e-3 * stage.seam_length_mm)
    if end - begin < 0.03:
        raise InputError("The measured part of the seam is shorter than 30 mm: reduce seam.ends_mm.")
    return np.asarray((s >= begin) & (s <= end))


def _along(
    planning: PlanningContext, q_from: Array, flange: list[RigidTransform], at: Array, speed: float, kind: str
) -> list[Goal]:
    """Return a goal above the start, then the path."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1))])
    even = np.linspace(0.0, length[-1], max(4, int(length[-1] / STATION_M)))
    chosen = np.unique(np.searchsorted(length, even).clip(0, len(at) - 1))
    first = nearest_solution(planning.arm, flange[0], planning.q_home)
    if first is None:
        raise InputError("The arm cannot reach the seam at its nominal pose: move the workpiece nearer.")
    X_FP = RigidTransform(planning.p_FTip)
    motion = GuardedMotion(
        name="the seam",
        every_pose=True,
        X_BT=[flange[k] @ X_FP for k in chosen],
        time=length[chosen] / speed,
        X_FT=X_FP,
        along=length[chosen],
    )
    joints = check_path(planning.arm, first, [motion])[0].q
    raised = RigidTransform([0.0, 0.0, 0.05]) @ flange[0]
    above = nearest_solution(planning.arm, raised, joints[0])
    ways = [] if above is None else [Goal("via", above)]
    if above is not None and not planning.clear_way(q_from, above):
        ways = [Goal("via", planning.q_home), *ways]
    return [*ways, Goal(kind, joints[0], path=JointPath(length[chosen], joints, speed))]
