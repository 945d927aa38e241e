"""Draws motions through corners of a cube, what a streaming scanner measures of them, and what chance alone makes of
its errors."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from weldcal.calibration.geometry.se3 import difference, exp_rotation, inverse, skew
from weldcal.calibration.motion.expected import ROBOT, Moves, closed_moves
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.models.arms.chain import chain_inverse, load_chain
from weldcal.models.arrays import Array

CUBE_M = 0.2  # edge
CORNERS = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]]) * CUBE_M
CENTRE_SIGMA_M = (
    5e-5,
    5e-5,
    2e-5,
)  # of a centre, across and along the normal: 0.5 mm of noise in some ten thousand points
NORMAL_SIGMA = 5e-4
FRAME_S, DELAY_S, JITTER_S = 0.05, 0.140, 0.015
_STEP_S, _ROUNDS = 1e-4, 3  # of the exact fit
_SHAPE = 4.0  # of the gamma law of the transport's tail: skewness 1


def cube_moves(
    rng: np.random.Generator, *, linear: bool = False, tilt_deg: float = 15.0
) -> tuple[Moves, RigidTransform]:
    """Moves of a UR10e through four corners of a 200 mm cube, flange up, and a scanner's pose X_BC above that looks
    down."""
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

    A frame is the mean of what the exposure passes over. Arrivals are late by a floor and a gamma tail, 140 +- 15 ms;
    the device's clock reads (capture - epoch_s) / (1 + drift). ``rolling_s``: an image row y/z is exposed so much later
    per unit.
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
        ids=tuple(f"f{k:04d}" for k in range(len(p))),
        arrival=arrival,
        device=told,
        p_C=seen,
        n_C=normal,
        covariance=covariance,
        normal_sigma=np.full(len(p), NORMAL_SIGMA),
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
    """A fixed target X_BT as it moves in the frame of a moving flange: what takes the place of Moves for a scanner on
    the flange."""

    moves: Moves
    X_BT: RigidTransform

    def at(self, t: Array) -> Array:
        """Target poses X_FT (..., 4, 4) at times (...) s, exact."""
        return np.asarray(inverse(self.moves.at(t)) @ self.X_BT.GetAsMatrix4())


def exact_errors(frames: ObservedFrames, capture: Array, moves: Moves, X_BC: RigidTransform) -> Array:
    """Errors (7,) of X_BC's six and of the clock's offset in sigmas, by least squares with the true motion and noise.

    The capture times (N,) s are known but for an offset and a drift, as those of a device are. An estimator can do no
    better, so that what this differs from the normal law by is the draw.
    """
    X = moves.at(capture)
    rate = (moves.at(capture + _STEP_S) - moves.at(capture - _STEP_S)) / (2.0 * _STEP_S)
    p, n = X[:, :3, 3], X[:, :3, 2]
    A = _tangents(n)
    At = np.swapaxes(A, 1, 2)
    g = np.concatenate([rate[:, :3, 3], np.einsum("nij,nj->ni", At, rate[:, :3, 2])], axis=1)
    found = X_BC
    N = np.eye(8)
    offset = 0.0
    for _ in range(_ROUNDS):
        R, t = found.rotation().matrix(), np.asarray(found.translation())
        y = np.concatenate([frames.p_C @ R.T + t - p, np.einsum("nij,nj->ni", At, frames.n_C @ R.T - n)], axis=1)
        J = np.zeros((len(capture), 5, 8))
        J[:, :3, :3], J[:, :3, 3:6] = -skew(frames.p_C @ R.T), np.eye(3)
        J[:, 3:, :3] = -At @ skew(frames.n_C @ R.T)
        J[:, :, 6], J[:, :, 7] = -g, -g * (capture - capture.mean())[:, None]
        W = np.zeros((len(capture), 5, 5))
        W[:, :3, :3] = np.linalg.inv(R @ frames.covariance @ R.T)
        W[:, 3, 3] = W[:, 4, 4] = 1.0 / frames.normal_sigma**2
        N = np.einsum("nia,nij,njb->ab", J, W, J)
        step = -np.linalg.solve(N, np.einsum("nia,nij,nj->a", J, W, y))
        turn = RotationMatrix.ProjectToRotationMatrix(exp_rotation(step[:3]) @ R)
        found, offset = RigidTransform(turn, t + step[3:6]), float(step[6])
    error = np.append(-difference(found.GetAsMatrix4(), X_BC.GetAsMatrix4()), offset)
    return np.asarray(error / np.sqrt(np.diag(np.linalg.inv(N))[:7]))


def _tangents(n: Array) -> Array:
    """Two unit vectors (N, 3, 2) at right angles to normals n (N, 3)."""
    other = np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(n, other)
    x /= np.linalg.norm(x, axis=1)[:, None]
    return np.stack([x, np.cross(n, x)], axis=2)
