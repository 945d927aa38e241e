"""A UR arm's exact motion through waypoints: moveJ or moveL with trapezoidal speed, as its controller plans it.

A segment has one path parameter s from 0 to 1; s(t) accelerates, cruises and brakes with constant rates. moveJ
interpolates the joints by s, moveL the flange's position, its rotation about one axis. The arm rests at each waypoint
for the dwell time.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.models.arms.inverse import inverse_kinematics, nearest_solution
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, kinematics_and_jacobian
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

MOVES = ("moveJ", "moveL")
_SAMPLES = 33  # of a segment, for its length and its largest speed
_NEWTON_M = 1e-10

CORNERS = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]], dtype=np.float64) - 0.5
"""Four corners of a cube that lie in no plane (section 3.2 of the paper), in units of its edge."""


@dataclass(frozen=True)
class Trapezoid:
    """s from 0 to 1 with the greatest rate ``v`` (1/s) and acceleration ``a`` (1/s^2)."""

    v: float
    a: float

    @property
    def ramp_s(self) -> float:
        """Length of each ramp, s."""
        return min(self.v / self.a, float(np.sqrt(1.0 / self.a)))

    @property
    def duration_s(self) -> float:
        """From rest to rest, s."""
        return 1.0 / (self.a * self.ramp_s) + self.ramp_s

    def s(self, t: float) -> float:
        """The parameter at ``t`` s after the start."""
        ramp, whole = self.ramp_s, self.duration_s
        if t <= 0.0:
            return 0.0
        if t >= whole:
            return 1.0
        if t < ramp:
            return 0.5 * self.a * t * t
        if t > whole - ramp:
            return 1.0 - 0.5 * self.a * (whole - t) ** 2
        return self.a * ramp * (t - 0.5 * ramp)


class Segment:
    """One move between two joint configurations (6,) rad at a flange speed (m/s) and acceleration (m/s^2)."""

    def __init__(self, arm: ArmModel, q_from: Array, q_to: Array, move: str, speed: float, acceleration: float) -> None:
        if move not in MOVES:
            raise InputError(f"The move '{move}' is not known: use {' or '.join(MOVES)}.")
        self._arm, self._linear = arm, move == "moveL"
        self._q = (q_from, q_to)
        self._X = tuple(forward_kinematics(arm, q) for q in self._q)
        turn = AngleAxis((self._X[0].rotation().inverse() @ self._X[1].rotation()).matrix())
        self._axis, self._angle = turn.axis(), turn.angle()
        places = np.array([self._pose(s).translation() for s in np.linspace(0.0, 1.0, _SAMPLES)])
        # metres of flange travel per unit of s, where it is fastest
        self.length_m = float(np.linalg.norm(np.diff(places, axis=0), axis=1).max()) * (_SAMPLES - 1)
        if self.length_m < 1e-6:
            raise InputError("Two waypoints in a row are the same place: the path needs a distance between them.")
        self.profile = Trapezoid(speed / self.length_m, acceleration / self.length_m)

    def _pose(self, s: float) -> RigidTransform:
        if not self._linear:
            return forward_kinematics(self._arm, self._q[0] + s * (self._q[1] - self._q[0]))
        a, b = (X.translation() for X in self._X)
        turned = self._X[0].rotation() @ RotationMatrix(AngleAxis(s * self._angle, self._axis))
        return RigidTransform(turned, a + s * (b - a))

    def joints(self, s: float) -> Array:
        """Joint angles (6,) rad at ``s``."""
        q = self._q[0] + s * (self._q[1] - self._q[0])
        return q if not self._linear else _newton(self._arm, self._pose(s), q)


def _newton(arm: ArmModel, X: RigidTransform, q: Array) -> Array:
    """Joint angles (6,) rad of a pose from others not far away."""
    R_goal, p_goal = X.rotation().matrix(), X.translation()
    for _ in range(12):
        R, p, J = kinematics_and_jacobian(arm, q)
        turn = R_goal @ R.T
        e = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1], *(2.0 * (p_goal - p))])
        if float(np.abs(e).max()) < _NEWTON_M:
            return q
        q = q + np.linalg.solve(J, 0.5 * e)
    raise InputError("A straight move passes a singularity of the arm: use moveJ, or another place of the cube.")


@dataclass(frozen=True, eq=False)
class RobotPath:
    """The moves one after the other, over and over: at rest before 0, and the arm's own dwell at each waypoint (s)."""

    arm: ArmModel
    waypoints: tuple[Array, ...]
    segments: tuple[Segment, ...]
    dwell_s: float

    @cached_property
    def starts_s(self) -> Array:
        """When each segment begins, and when the loop is closed (n + 1,) s."""
        return np.concatenate([[0.0], np.cumsum([s.profile.duration_s + self.dwell_s for s in self.segments])])

    @property
    def loop_s(self) -> float:
        """Time of one loop, s."""
        return float(self.starts_s[-1])

    def joints(self, t: float) -> Array:
        """Joint angles (6,) rad at time ``t`` s."""
        if t <= 0.0:
            return self.waypoints[0]
        t = float(np.mod(t, self.loop_s))
        k = int(np.searchsorted(self.starts_s, t, side="right")) - 1
        k = min(k, len(self.segments) - 1)
        return self.segments[k].joints(self.segments[k].profile.s(t - float(self.starts_s[k])))

    def pose(self, t: float) -> RigidTransform:
        """Flange pose X_BF at time ``t`` s."""
        return forward_kinematics(self.arm, self.joints(t))


def path_through(
    arm: ArmModel,
    poses: list[RigidTransform],
    q_near: Array,
    *,
    move: str = "moveJ",
    speed: float = 0.25,
    acceleration: float = 1.2,
    dwell_s: float = 0.0,
) -> RobotPath:
    """A closed path through flange poses X_BF, from joint angles near ``q_near`` (6,) rad.

    Raises InputError out of reach.
    """
    if len(poses) < 2 or not (speed > 0.0 and acceleration > 0.0 and dwell_s >= 0.0):
        raise InputError("A path needs two poses, and a positive speed and acceleration.")
    q: list[Array] = []
    for X in poses:
        found = nearest_solution(arm, X, q[-1] if q else q_near)
        if found is None:
            raise InputError(f"A waypoint is out of the {arm.name}'s reach: move the cube nearer, or make it smaller.")
        q.append(found)
    moves = tuple(Segment(arm, a, b, move, speed, acceleration) for a, b in pairwise([*q, q[0]]))
    return RobotPath(arm, tuple(q), moves, dwell_s)


def cube_poses(
    centre_m: Array, edge_m: float, towards: RotationMatrix, lean_rad: float, rng: np.random.Generator
) -> list[RigidTransform]:
    """Flange poses at four corners of a cube about ``centre_m``, each turned away from ``towards`` by up to
    ``lean_rad``."""
    return [leaning(centre_m + edge_m * corner, towards, lean_rad, rng) for corner in CORNERS]


def leaning(p: Array, towards: RotationMatrix, lean_rad: float, rng: np.random.Generator) -> RigidTransform:
    """A pose at ``p`` (3,) m whose rotation is off ``towards``: each of roll, pitch and yaw by up to ``lean_rad``."""
    off = RollPitchYaw(*rng.uniform(-lean_rad, lean_rad, 3)).ToRotationMatrix()
    return RigidTransform(towards @ off, p)


def reachable_start(arm: ArmModel, X_BF: RigidTransform, elbow_up: bool = True) -> Array:
    """Joint angles (6,) rad for a pose, with the elbow as high as it gets (or as low).

    Raises InputError out of reach.
    """
    found = inverse_kinematics(arm, X_BF)
    if not len(found):
        raise InputError(f"The {arm.name} does not reach the cube: move it nearer.")
    # the height of the elbow, by the upper arm's angle
    height = [-np.sin(q[1]) for q in found]
    order = np.argsort(height)
    return np.asarray(found[int(order[-1 if elbow_up else 0])], dtype=np.float64)
