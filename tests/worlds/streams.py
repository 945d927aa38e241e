"""Motions of a robot through waypoints, and what they will show of X_BC and of the scanner's clock."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.geometry.se3 import as_transform, pose
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.inverse import continued_solution
from weldcal.models.arms.kinematics import chain_poses, load_arm
from weldcal.models.arrays import Array

ROBOT = "ur10e"
SPEED, ACCELERATION = 0.25, 1.2  # m/s, m/s^2
PAUSE_S = 0.1  # a choice: a controller's settling between two moves


@dataclass(frozen=True, eq=False)
class Moves:
    """Moves between waypoints ``q`` (n, J) rad, one after the other and round again.

    Each trapezoidal in one path parameter, straight in joints (moveJ) or in space (moveL); ``lengths`` (n,) m are those
    of the paths of the flange.
    """

    q: Array
    poses: Array
    lengths: Array
    linear: bool
    speed: float = SPEED
    robot: str = ROBOT
    acceleration: float = ACCELERATION
    pause_s: float = PAUSE_S

    def at(self, t: Array) -> Array:
        """Flange poses X_BF (..., 4, 4) at times (...) s, exact."""
        k, s = self._progress(np.ravel(t))
        j = (k + 1) % len(self.q)
        if not self.linear:
            X = chain_poses(load_chain(self.robot), self.q[k] + s[:, None] * (self.q[j] - self.q[k]))
        else:
            R = Rotation.from_matrix(self.poses[:, :3, :3])
            turn = (R[k].inv() * R[j]).as_rotvec()
            p = self.poses[:, :3, 3]
            X = pose((R[k] * Rotation.from_rotvec(s[:, None] * turn)).as_matrix(), p[k] + s[:, None] * (p[j] - p[k]))
        return X.reshape(*np.shape(t), 4, 4)

    def joints(self, t: Array) -> Array:
        """Joint angles (N, J) rad at times (N,) s."""
        k, s = self._progress(np.ravel(t))
        q = np.asarray(self.q[k] + s[:, None] * (self.q[(k + 1) % len(self.q)] - self.q[k]))
        if not self.linear:
            return q
        arm = load_arm(self.robot)
        found = [
            continued_solution(arm, as_transform(X), near) for X, near in zip(self.at(np.ravel(t)), q, strict=True)
        ]
        return np.array(found, dtype=float)

    @property
    def _peaks(self) -> Array:
        """The largest speed (n,) m/s of each move: a short one does not reach the speed."""
        return np.minimum(self.speed, np.sqrt(self.acceleration * self.lengths))

    @property
    def ends_s(self) -> Array:
        """When each move has ended, its pause included (n,) s; the last one closes the loop."""
        return np.cumsum(self._peaks / self.acceleration + self.lengths / self._peaks + self.pause_s)

    def _progress(self, t: Array) -> tuple[np.ndarray, Array]:
        """Which move, and the share 0..1 of it done; at rest before 0."""
        a, ends = self.acceleration, self.ends_s
        t = np.mod(np.maximum(t, 0.0), ends[-1])
        k = np.minimum(np.searchsorted(ends, t, side="right"), len(ends) - 1)
        x, v, length = t - np.append(0.0, ends)[k], self._peaks[k], self.lengths[k]
        ramp = v / a
        c = length / v - ramp
        y = np.clip(x - ramp - c, 0.0, ramp)
        up, steady = 0.5 * a * np.minimum(x, ramp) ** 2, v * np.clip(x - ramp, 0.0, c)
        return k, (up + steady + v * y - 0.5 * a * y**2) / length


def closed_moves(way: Array, *, linear: bool, robot: str = ROBOT, fastest: bool = False, **options: float) -> Moves:
    """Moves through waypoints (n, J) rad and back to the first one.

    Args:
        way: the waypoints. linear: moveL, else moveJ. robot: its name.
        fastest: the speed of a moveJ is that of the flange where it is fastest; else its mean.
        options: speed m/s, acceleration m/s^2, pause_s.
    """
    chain = load_chain(robot)
    poses = chain_poses(chain, way)
    after = np.roll(np.arange(len(way)), -1)
    steps = np.linspace(0.0, 1.0, 200)
    lengths = np.linalg.norm(poses[after, :3, 3] - poses[:, :3, 3], axis=1)
    if not linear:
        for k in range(len(way)):
            path = chain_poses(chain, way[k] + steps[:, None] * (way[after[k]] - way[k]))[:, :3, 3]
            apart = np.linalg.norm(np.diff(path, axis=0), axis=1)
            lengths[k] = apart.max() * len(apart) if fastest else apart.sum()
    return Moves(way, poses, lengths, linear, robot=robot, **options)


def recorded_stream(
    moves: Moves,
    duration_s: float,
    rng: np.random.Generator,
    *,
    rate: float = 500.0,
    jitter_s: float = 1e-4,
    joints: bool = False,
) -> RobotStream:
    """The robot's stream: times late by an exponential law of mean ``jitter_s``, numbers rounded to six digits."""
    t = np.arange(0.0, duration_s, 1.0 / rate)
    told = np.round(t + jitter_s * rng.exponential(size=len(t)) - jitter_s, 6)
    order = np.argsort(told, kind="stable")
    if joints:
        q = np.round(moves.joints(t), 6)
        return RobotStream(told[order], chain_poses(load_chain(ROBOT), q)[order], q[order], ROBOT)
    X = moves.at(t)
    X[:, :3, 3] = np.round(X[:, :3, 3], 6)
    return RobotStream(told[order], X[order], None, ROBOT)
