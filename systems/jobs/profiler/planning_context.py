"""Data of the profiler job's planning: arm, rig on its flange and surrounding objects at their nominal poses; clearances."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.planning.clearance import Body, arm_bodies, path_clearance
from weldcal.calibration.planning.surroundings import Surroundings
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.plan import Field
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import LINKS, ArmModel, forward_kinematics
from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.drivers.simulated.profiler_world import BEVEL_M, POST_RADIUS_M, rig_points, under_straightedge
from weldcal.systems.jobs.profiler.config import ProfilerJob, pose_of

STEP_RAD = (
    0.1  # along a move, between the configurations that are checked against table, surroundings and the arm itself
)
STEP_M = 5e-4  # of torch and profiler, between those that are checked against the objects, where these are near
FASTER = 1.2  # than the mean speed in a step of STEP_RAD: no point of the rig is


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanningContext:
    """Nominal or, later, calibrated poses: X_FS, the tip in F, the sphere's centre in B; the nominal workpiece at X_BP."""

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

    def bodies(self) -> list[Body]:
        """The arm with the rig on its flange."""
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

    def joints(self, X_BF: RigidTransform, q_near: Array) -> Array | None:
        """The inverse kinematics solution nearest to `q_near`; None: out of reach."""
        return nearest_solution(self.arm, X_BF, q_near)

    def clear_way(self, q_a: Array, q_b: Array) -> bool:
        """Whether a straight move in joint space keeps torch, profiler and arm clear of all objects."""
        if not self._keeps_gap(q_a, q_b, 0.5e-3 * self.job.clearance_mm):
            return False
        if self.surroundings.touched_on_path(self.arm, self.bodies(), q_a, q_b):
            return False
        lowest, gap = path_clearance(self.arm, self.bodies(), q_a, q_b, 2.0 * STEP_RAD)
        return lowest > self.table_z_m and gap > 0.0

    def _keeps_gap(self, q_a: Array, q_b: Array, least_m: float) -> bool:
        """Whether torch and profiler keep `least_m` (m) on a straight move in joint space; from each checked configuration on by no more
        than what they have left there.
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
            found = self.joints(X, self.q_home)
            if found is not None:
                q.append(found)
                which.append(k)
        return np.array(q).reshape(-1, 6), np.array(which, dtype=np.intp)

    def route(self, q_from: Array, goals: Array) -> list[tuple[Array, int]]:
        """A route through all goals (n, 6), each time to the nearest remaining one: (joints, goal's index or -1 for home).

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

    def known(self, **changes: object) -> PlanningContext:
        """A copy with updated values."""
        return replace(self, **changes)  # type: ignore[arg-type]


def _to_box(p: Array, X: RigidTransform, low: list[float], high: list[float]) -> Array:
    q = X.inverse().multiply(p.T).T
    outside = np.maximum(np.maximum(low - q, q - high), 0.0)
    inside = np.minimum(np.minimum(q - low, high - q).min(axis=1), 1.0)
    return np.asarray(np.where(inside > 0.0, -inside, np.linalg.norm(outside, axis=1)))


def _to_post(p: Array, top: Array) -> Array:
    below = np.maximum(p[:, 2] - top[2], 0.0)
    beside = np.maximum(np.hypot(p[:, 0] - top[0], p[:, 1] - top[1]) - POST_RADIUS_M, 0.0)
    return np.asarray(np.hypot(below, beside))
