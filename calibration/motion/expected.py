"""Motions of a robot through waypoints, and what they will show of X_BC and of the scanner's clock."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.geometry.se3 import pose, skew
from weldcal.calibration.motion.clock_fit import OFFSET, MotionProblem, Variances, frame_weights, linearised
from weldcal.calibration.motion.observed import ObservedFrames, arrival_clock
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arms.chain import chain_poses, load_chain
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

ROBOT = "ur10e"
SPEED, ACCELERATION = 0.25, 1.2  # m/s, m/s^2
PAUSE_S = 0.1  # a choice: a controller's settling between two moves

_FEWEST = 6
_LARGEST = 1e6  # sigmas beyond this are of directions that the motion does not show at all


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

    def at(self, t: Array) -> Array:
        """Flange poses X_BF (..., 4, 4) at times (...) s, exact."""
        k, s = self._progress(np.ravel(t))
        j = (k + 1) % len(self.q)
        if not self.linear:
            X = chain_poses(load_chain(ROBOT), self.q[k] + s[:, None] * (self.q[j] - self.q[k]))
        else:
            R = Rotation.from_matrix(self.poses[:, :3, :3])
            turn = (R[k].inv() * R[j]).as_rotvec()
            p = self.poses[:, :3, 3]
            X = pose((R[k] * Rotation.from_rotvec(s[:, None] * turn)).as_matrix(), p[k] + s[:, None] * (p[j] - p[k]))
        return X.reshape(*np.shape(t), 4, 4)

    def joints(self, t: Array) -> Array:
        """Joint angles (N, J) rad of a moveJ at times (N,) s."""
        k, s = self._progress(t)
        return np.asarray(self.q[k] + s[:, None] * (self.q[(k + 1) % len(self.q)] - self.q[k]))

    def _progress(self, t: Array) -> tuple[np.ndarray, Array]:
        """Which move, and the share 0..1 of it done."""
        ramp = self.speed / ACCELERATION
        cruise = self.lengths / self.speed - ramp
        duration = 2.0 * ramp + cruise + PAUSE_S
        ends = np.cumsum(duration)
        t = np.mod(t, ends[-1])
        k = np.minimum(np.searchsorted(ends, t, side="right"), len(ends) - 1)
        x = t - (ends - duration)[k]
        c = cruise[k]
        up = 0.5 * ACCELERATION * np.minimum(x, ramp) ** 2
        steady = self.speed * np.clip(x - ramp, 0.0, c)
        y = np.clip(x - ramp - c, 0.0, ramp)
        return k, (up + steady + self.speed * y - 0.5 * ACCELERATION * y**2) / self.lengths[k]


def closed_moves(way: Array, *, linear: bool) -> Moves:
    """Moves through waypoints (n, J) rad and back to the first one."""
    chain = load_chain(ROBOT)
    poses = chain_poses(chain, way)
    after = np.roll(np.arange(len(way)), -1)
    steps = np.linspace(0.0, 1.0, 200)
    lengths = np.linalg.norm(poses[after, :3, 3] - poses[:, :3, 3], axis=1)
    if not linear:
        for k in range(len(way)):
            path = chain_poses(chain, way[k] + steps[:, None] * (way[after[k]] - way[k]))[:, :3, 3]
            lengths[k] = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    return Moves(way, poses, lengths, linear)


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


@dataclass(frozen=True)
class PredictedSigma:
    """Hold the accuracy that a motion is expected to give, one sigma.

    ``work_m`` of a point among the flange's places (3-D), ``turn_rad`` of X_BC's rotation (3-D), ``offset_s`` of the
    clock, ``shared`` the largest correlation 0..1 of the offset with a shift of the scanner. Infinite where the motion
    does not show it.
    """

    work_m: float
    turn_rad: float
    offset_s: float
    shared: float


def expected_of_motion(
    motion: ContinuousMotion,
    X_BC: RigidTransform,
    *,
    frame_s: float = 0.05,
    centre_sigma_m: float = 1e-4,
    normal_sigma: float = 1e-3,
    jitter_s: float = 0.015,
    X_FR: RigidTransform | None = None,
) -> PredictedSigma:
    """Predict the sigmas of a calibration from a planned motion, with a frame every ``frame_s``.

    They are as the joint fit would state them.

    ``jitter_s`` is that of the arrivals; for device times give their own, 0.0001 for instance. Raises InputError: less
    than six frames.
    """
    begin, end = motion.span
    t = np.arange(begin, end, frame_s)
    t = t[motion.known(t)]
    if len(t) < _FEWEST:
        raise InputError(f"The motion lasts for {len(t)} frames; {_FEWEST} or more are needed.")
    at = motion.feature(t, X_FR)
    R = X_BC.rotation().matrix()
    n = len(t)
    frames = ObservedFrames(
        ids=tuple(str(k) for k in range(n)),
        arrival=t,
        device=None,
        p_C=(at.p - X_BC.translation()) @ R,
        n_C=at.n @ R,
        covariance=np.zeros((n, 3, 3)),
        normal_sigma=np.zeros(n),
    )
    problem = MotionProblem(frames, arrival_clock(frames), motion, X_FR)
    pivot = at.p.mean(axis=0)
    linear = linearised(problem, X_BC, t, t, 0.0, 0.0, pivot)
    W = frame_weights(linear, Variances(0.0, centre_sigma_m**2, normal_sigma**2, jitter_s**2), np.zeros(n, dtype=bool))
    J = linear.J[:, :, : OFFSET + 1]
    unit = np.array([1e-3] * 3 + [1e-4] * 3 + [1e-3])
    values, vectors = np.linalg.eigh(np.einsum("nia,nij,njb->ab", J, W, J) * np.outer(unit, unit))
    root = vectors / np.sqrt(np.maximum(values, 1.0 / _LARGEST**2))
    C = unit[:, None] * (root @ root.T) * unit
    sigma = np.sqrt(np.diag(C))
    slack = [-skew(p - pivot) for p in at.p]
    spread = np.mean([np.trace(np.hstack([S, np.eye(3)]) @ C[:6, :6] @ np.hstack([S, np.eye(3)]).T) for S in slack])
    share = float(np.abs(C[3:6, 6] / (sigma[3:6] * sigma[6])).max())
    limits = 0.01 * _LARGEST * unit
    return PredictedSigma(
        work_m=float(np.sqrt(spread)) if (sigma[:6] < limits[:6]).all() else float("inf"),
        turn_rad=float(np.linalg.norm(sigma[:3])) if (sigma[:3] < limits[:3]).all() else float("inf"),
        offset_s=float(sigma[6]) if sigma[6] < limits[6] else float("inf"),
        shared=share,
    )
