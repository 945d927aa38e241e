"""Force mode and freedrive: a deviation from the commanded motion that forces on the tool drive [M]; and what touches
the tool.

The arm that the motions see is `nominal`; the real one is it, moved by a deviation along and about the task frame's
axes. The deviation's speed is (force asked for + force felt) / DAMPING, up to the axis' limit.
"""

from dataclasses import dataclass, field

import numpy as np

from weldcal.models.arms.kinematics import ArmModel, kinematics_and_jacobian
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.tools.emulators.ur.controller.motions import STEP_S, MotionRefused, newton
from weldcal.tools.emulators.ur.controller.poses import inverse, matrix, rotation_matrix

# [M] N s/m and N m s/rad
DAMPING = np.array([500.0] * 3 + [50.0] * 3)
FREE_DAMPING = DAMPING / 5.0
# [M] how fast the deviation's speed may change, m/s^2 and rad/s^2
ACCELERATION = np.array([10.0] * 3 + [50.0] * 3)
FREE_LIMITS = np.array([0.25] * 3 + [1.0] * 3)
# stiffer than this the compliant arm, 500 steps a second, would chatter
STIFFEST_N_M = 1e5


@dataclass
class Nominal:
    """The arm as its motions see it."""

    model: ArmModel
    q_target: Array
    qd_target: Array
    p_FT: Array


@dataclass
class Task:
    """What force_mode was asked for: frame as a matrix in the base, 1 where compliant, [f; t] to press with, type,
    limits."""

    frame: Array
    selection: Array
    wrench: Array
    kind: int
    limits: Array
    damping: Array


class Compliance:
    """The deviation under way."""

    def __init__(self, model: ArmModel, q: Array, qd: Array, p_FT: Array, task: Task) -> None:
        self.nominal = Nominal(model, q.copy(), qd.copy(), p_FT)
        self.task = task
        self._moved, self._turned, self._speed = np.zeros(3), np.eye(3), np.zeros(6)

    def velocity(self, q: Array, X_FT: Array, qd_nominal: Array, wrench: Array, live: bool) -> Array:
        """Joint velocity (6) of the real arm at q for the next step; while it is not live the deviation stands still.

        Raises:
            MotionRefused: the deviation leads out of reach.
        """
        nominal, model = self.nominal, self.nominal.model
        nominal.q_target, nominal.qd_target = nominal.q_target + qd_nominal * STEP_S, qd_nominal
        R, p, J = kinematics_and_jacobian(model, q, nominal.p_FT)
        axes = _axes(self.task, p + R @ X_FT[:3, 3], (J @ qd_nominal)[3:])
        felt = np.concatenate([axes.T @ wrench[:3], axes.T @ wrench[3:]])
        asked = np.where(self.task.selection > 0.0, (self.task.wrench + felt) / self.task.damping, 0.0)
        asked = np.clip(asked, -self.task.limits, self.task.limits) if live else np.zeros(6)
        self._speed += np.clip(asked - self._speed, -ACCELERATION * STEP_S, ACCELERATION * STEP_S)
        self._moved = self._moved + axes @ self._speed[:3] * STEP_S
        self._turned = rotation_matrix(axes @ self._speed[3:] * STEP_S) @ self._turned
        R, p, _ = kinematics_and_jacobian(model, nominal.q_target)
        X = np.eye(4)
        X[:3, :3], X[:3, 3] = R, p
        X = X @ X_FT
        X[:3, :3], X[:3, 3] = self._turned @ X[:3, :3], X[:3, 3] + self._moved
        found = newton(model, X @ inverse(X_FT), q)
        if found is None:
            raise MotionRefused("force mode leaves the arm's reach")
        return np.asarray((found - q) / STEP_S, dtype=np.float64)


def force_task(
    frame: list[float], selection: Array, wrench: Array, kind: int, limits: Array, gain_scaling: float
) -> Task:
    """The task of one call of force_mode."""
    # for an axis that is not compliant the limit is a deviation, which this arm has none of
    return Task(matrix(frame), selection, wrench, kind, np.abs(limits), DAMPING / max(gain_scaling, 1e-3))


def free_task(frame: list[float], free_axes: Array) -> Task:
    """The task of freedrive: every free axis gives way to the hand."""
    return Task(matrix(frame), free_axes, np.zeros(6), 2, FREE_LIMITS, FREE_DAMPING)


def _axes(task: Task, p: Array, v: Array) -> Array:
    """Axes (3, 3) of the task frame in the base: type 1 turns y towards the frame's origin, type 3 x along the
    motion."""
    R = task.frame[:3, :3]
    if task.kind == 1:
        y = task.frame[:3, 3] - p
        if (distance := float(np.linalg.norm(y))) < 1e-6:
            return R
        y = y / distance
        x = np.cross(y, R[:, 2])
        if float(np.linalg.norm(x)) < 1e-6:
            return R
        x = x / np.linalg.norm(x)
        return np.column_stack([x, y, np.cross(x, y)])
    if task.kind == 3:
        x = v - (v @ R[:, 2]) * R[:, 2]
        if (speed := float(np.linalg.norm(x))) < 1e-6:
            return R
        return np.column_stack([x / speed, np.cross(R[:, 2], x / speed), R[:, 2]])
    return R


@dataclass
class ElasticContact:
    """An elastic half-space and a hand; wrenches are [f; t] on the tool centre point in base axes (N, N m)."""

    point: Array = field(default_factory=lambda: np.zeros(3))
    normal: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    stiffness: float = 0.0
    push: Array = field(default_factory=lambda: np.zeros(6))

    def place(self, point: list[float], normal: list[float], stiffness: float) -> None:
        """Puts the plane somewhere; a stiffness of 0 takes it away.

        Raises:
            InputError: a normal without a direction, or a stiffness that is negative or too high to be stable.
        """
        n = np.array(normal)
        if not (length := float(np.linalg.norm(n))) > 0.0:
            raise InputError("Give a normal that is not zero.")
        if not 0.0 <= stiffness <= STIFFEST_N_M:
            raise InputError(f"Give a stiffness from 0 to {STIFFEST_N_M:.0f} N/m.")
        self.point, self.normal, self.stiffness = np.array(point), n / length, stiffness

    @property
    def empty(self) -> bool:
        """Nothing touches the tool, wherever it is."""
        return self.stiffness == 0.0 and not self.push.any()

    def depth(self, p: Array) -> float:
        """How far p (3,) is behind the surface (m), 0 in front of it."""
        return max(0.0, float((self.point - p) @ self.normal)) if self.stiffness > 0.0 else 0.0

    def wrench(self, p: Array) -> Array:
        """What acts on the tool centre point at p (3,)."""
        found = self.push.copy()
        found[:3] += self.stiffness * self.depth(p) * self.normal
        return found


@dataclass
class ForceSensor:
    """Offset of zero_ftsensor, and the wrench that a client writes in place of the built-in sensor's."""

    offset: Array = field(default_factory=lambda: np.zeros(6))
    external: bool = False
    written: list[float] = field(default_factory=lambda: [0.0] * 6)
