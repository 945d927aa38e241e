"""Generates robot motions exactly: moveJ and moveL with trapezoidal speed through corners of a cube, and what a scanner sees."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.models.arms.chain import chain_inverse, chain_poses, load_chain
from weldcal.models.arrays import Array

ROBOT = "ur10e"
CUBE_M, SPEED, ACCELERATION = 0.2, 0.25, 1.2  # edge m, m/s, m/s^2
CORNERS = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]]) * CUBE_M
CENTRE_SIGMA_M = (
    5e-5,
    5e-5,
    2e-5,
)  # of a centre, across and along the normal: 0.5 mm of noise in some ten thousand points
NORMAL_SIGMA = 5e-4
FRAME_S, DELAY_S, JITTER_S = 0.05, 0.140, 0.015
PAUSE_S = 0.1
_SHAPE = 4.0  # of the gamma law of the transport's tail: skewness 1


@dataclass(frozen=True, eq=False)
class Moves:
    """Moves between waypoints ``q`` (n, J) rad, one after the other and round again: each trapezoidal in one path parameter,
    straight in joints (moveJ) or in space (moveL); ``lengths`` (n,) m are those of the paths of the flange."""

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


def cube_moves(
    rng: np.random.Generator, *, linear: bool = False, tilt_deg: float = 15.0
) -> tuple[Moves, RigidTransform]:
    """Moves of a UR10e through four corners of a 200 mm cube, flange up, and a scanner's pose X_BC above that looks down."""
    chain = load_chain(ROBOT)
    middle = np.array([rng.uniform(0.45, 0.65), rng.uniform(-0.25, 0.25), rng.uniform(0.25, 0.4)])
    turn = rng.uniform(-np.pi, np.pi)
    q, near = [], np.array([0.2, -1.4, 2.0, 1.0, 1.6, 0.0])
    for corner in CORNERS:
        lean = np.radians(tilt_deg) * rng.uniform(-1.0, 1.0, 2)
        R = Rotation.from_euler("zxy", [turn, *lean]).as_matrix()
        found = chain_inverse(chain, RigidTransform(RotationMatrix(R), middle + corner - 0.5 * CUBE_M), near)
        assert found is not None
        near = near + np.mod(found - near + np.pi, 2.0 * np.pi) - np.pi
        q.append(near)
    down = Rotation.from_euler(
        "zxy", [rng.uniform(-np.pi, np.pi), np.pi + rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2)]
    )
    R_BC = down.as_matrix()
    X_BC = RigidTransform(RotationMatrix(R_BC), middle - 0.75 * R_BC[:, 2])
    return closed_moves(np.array(q), linear=linear), X_BC


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


def observed_frames(
    moves: "Moves | SeenFromHand",
    X_BC: RigidTransform,
    duration_s: float,
    rng: np.random.Generator,
    *,
    device: bool,
    exposure_s: float = 0.01,
    rolling_s: float = 0.0,
    drift: float = 0.0,
    epoch_s: float = 0.0,
) -> tuple[ObservedFrames, Array]:
    """Frames of a streaming scanner, and their true capture times (N,) s.

    A frame is the mean of what the exposure passes over. Arrivals are late by a floor and a gamma tail, 140 +- 15 ms; the device's
    clock reads (capture - epoch_s) / (1 + drift). ``rolling_s``: an image row y/z is exposed so much later per unit.
    """
    count = int((duration_s - 1.0) / FRAME_S)
    capture = 0.5 + FRAME_S * np.linspace(0.0, count - 1.0, count) + float(rng.uniform(0.0, FRAME_S))
    X_CB = X_BC.inverse().GetAsMatrix4()
    ticks = exposure_s * (np.arange(5) - 2.0) / 5.0
    X = X_CB @ moves.at(capture[:, None] + ticks)
    for _ in range(3 if rolling_s else 0):
        u = X[:, :, 1, 3].mean(axis=1) / X[:, :, 2, 3].mean(axis=1)
        X = X_CB @ moves.at((capture + rolling_s * u)[:, None] + ticks)
    p, n = X[:, :, :3, 3].mean(axis=1), X[:, :, :3, 2].mean(axis=1)
    if rolling_s:
        u = p[:, 1] / p[:, 2]
        step = X_CB @ moves.at((capture + rolling_s * u)[:, None] + np.array([-1e-4, 1e-4]))
        v = (step[:, 1, :3, 3] - step[:, 0, :3, 3]) / 2e-4
        shear = np.eye(3) + rolling_s / p[:, 2, None, None] * v[:, :, None] * np.array([0.0, 1.0, 0.0])
        n = np.linalg.solve(np.swapaxes(shear, 1, 2), n[:, :, None])[:, :, 0]
    n /= np.linalg.norm(n, axis=1)[:, None]
    axes = _axes(n)
    noise = rng.standard_normal((len(p), 3)) * CENTRE_SIGMA_M
    seen = p + np.einsum("nij,nj->ni", axes, noise)
    lean = NORMAL_SIGMA * rng.standard_normal((len(p), 2))
    normal = n + np.einsum("nij,nj->ni", axes[:, :, :2], lean)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    covariance = np.einsum("nij,j,nkj->nik", axes, np.square(CENTRE_SIGMA_M), axes)
    scale = JITTER_S / np.sqrt(_SHAPE)
    arrival = capture + DELAY_S - _SHAPE * scale + rng.gamma(_SHAPE, scale, len(p))
    told = np.round((capture - epoch_s) / (1.0 + drift), 6) if device else None
    frames = ObservedFrames(
        tuple(f"f{k:04d}" for k in range(len(p))),
        arrival,
        told,
        seen,
        normal,
        covariance,
        np.full(len(p), NORMAL_SIGMA),
    )
    return frames, capture


def _axes(n: Array) -> Array:
    """Rotations (N, 3, 3) whose third column is n (N, 3)."""
    other = np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(n, other)
    x /= np.linalg.norm(x, axis=1)[:, None]
    return np.stack([x, np.cross(n, x), n], axis=2)


@dataclass(frozen=True, eq=False)
class SeenFromHand:
    """A fixed target X_BT as it moves in the frame of a moving flange: what takes the place of Moves for a scanner on the flange."""

    moves: Moves
    X_BT: RigidTransform

    def at(self, t: Array) -> Array:
        """Target poses X_FT (..., 4, 4) at times (...) s, exact."""
        return np.asarray(inverse(self.moves.at(t)) @ self.X_BT.GetAsMatrix4())


def hand_moves(
    rng: np.random.Generator,
    *,
    linear: bool = False,
    lean_deg: float = 25.0,
    spread_m: float = 0.08,
    waypoints: int = 6,
) -> tuple[Moves, RigidTransform, RigidTransform]:
    """Moves of a UR10e with a scanner on its flange about a fixed target, X_FC and X_BT; the target stays near the middle of the view."""
    chain = load_chain(ROBOT)
    X_FC = RigidTransform(
        RotationMatrix(
            Rotation.from_euler("zxy", [rng.uniform(-np.pi, np.pi), *rng.uniform(-0.2, 0.2, 2)]).as_matrix()
        ),
        np.array([0.08, 0.02, 0.06]) + rng.uniform(-0.02, 0.02, 3),
    )
    X_BT = RigidTransform(
        RotationMatrix(Rotation.from_euler("xy", rng.uniform(-0.1, 0.1, 2)).as_matrix()),
        [rng.uniform(0.55, 0.7), rng.uniform(-0.2, 0.2), 0.02],
    )
    q: list[Array] = []
    near = np.array([0.2, -1.4, 2.0, -2.1, -1.6, 0.0])
    while len(q) < waypoints:
        lean = np.radians(lean_deg) * rng.uniform(-1.0, 1.0, 3)
        R_BC = Rotation.from_euler("zxy", [lean[0], np.pi + lean[1], lean[2]]).as_matrix()
        p = X_BT.translation() - rng.uniform(0.5, 0.62) * R_BC[:, 2] + spread_m * rng.uniform(-1.0, 1.0, 3)
        X_BF = RigidTransform(RotationMatrix(R_BC), p) @ X_FC.inverse()
        found = chain_inverse(chain, X_BF, near)
        if found is not None:
            near = near + np.mod(found - near + np.pi, 2.0 * np.pi) - np.pi
            q.append(near)
    return closed_moves(np.array(q), linear=linear), X_FC, X_BT


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
