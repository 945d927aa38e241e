"""Light worlds for calibration in motion: moves through a cube, what a streaming scanner measures of them, drift."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from tests.worlds.streams import ROBOT, Moves, closed_moves
from weldcal.calibration.geometry.se3 import exp_rotation, fit_rigid, inverse, rotation_vector
from weldcal.calibration.motion.drift.residuals import Rows, rows_of
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import chain_poses, load_arm
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
    """Make moves of a UR10e through four corners of a 200 mm cube, flange up, and a scanner's pose X_BC.

    The scanner is above and looks down.
    """
    chain = load_chain(ROBOT)
    middle = np.array([rng.uniform(0.45, 0.65), rng.uniform(-0.25, 0.25), rng.uniform(0.25, 0.4)])
    turn = rng.uniform(-np.pi, np.pi)
    q, near = [], np.array([0.2, -1.4, 2.0, 1.0, 1.6, 0.0])
    for corner in CORNERS:
        lean = np.radians(tilt_deg) * rng.uniform(-1.0, 1.0, 2)
        R = Rotation.from_euler("zxy", [turn, *lean]).as_matrix()
        found = nearest_solution(chain, RigidTransform(RotationMatrix(R), middle + corner - 0.5 * CUBE_M), near)
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
    moves: "Moves | TargetInHand",
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
class TargetInHand:
    """A fixed target X_BT as it moves in the frame of a moving flange.

    What takes the place of Moves for a scanner on the flange.
    """

    moves: Moves
    X_BT: RigidTransform

    def at(self, t: Array) -> Array:
        """Target poses X_FT (..., 4, 4) at times (...) s, exact."""
        return np.asarray(inverse(self.moves.at(t)) @ self.X_BT.GetAsMatrix4())


_CENTER = np.array([-0.65, -0.25, 0.45])  # of the work, in B
_Q_NEAR = np.array([0.3, -1.6, 2.0, -2.0, -1.5, 0.3])
_STEP_S = 0.004
_ACCELERATION = 1.2  # m/s^2 of the TCP, roughly


@dataclass(frozen=True)
class Change:
    """Something that happens at ``time_s``.

    The scanner turns by ``rotation_rad`` (3,) about its own origin and shifts by ``translation_m`` (3,), in the base,
    at once or, over ``over_s`` seconds, evenly; ``scale`` changes with exp(-t / over_s).
    """

    time_s: float = np.inf
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    over_s: float = 0.0
    scale: float = 0.0


@dataclass(frozen=True, kw_only=True)
class WorldConfig:
    """What differs between worlds: size of the work (m), speed (m/s), time between frames (s), jitter of the stamps.

    ``device`` a clock of 0.1 ms, ``arrival`` a skewed transport of 15 ms; sigmas of systematic errors of the arm (rad)
    and the scanner (m).
    """

    cube_m: float = 0.2
    speed_m_s: float = 0.25
    frame_s: float = 0.05
    stamps: str = "device"
    task_s: float = 1800.0
    arm_rad: float = 1.5e-4
    warp_m: float = 1e-4
    centre_m: float = 3.5e-5
    depth_m: float = 2e-5
    normal_rad: float = 6e-4
    stated: float = 0.8  # of the true noise that a fit states
    outliers: float = 0.003
    calibration_m: float = 5e-5
    calibration_rad: float = 1.2e-4
    changes: tuple[Change, ...] = field(default_factory=tuple)


@dataclass(frozen=True, eq=False)
class FeatureWorld:
    """A calibration and the residuals of the frames against it. Truth stays in ``config``."""

    X_BC: RigidTransform
    covariance: Array
    pivot: Array
    rows: Rows


def simulate(config: WorldConfig, duration_s: float, seed: int) -> FeatureWorld:
    """Residuals of a recording.

    The arm moves by joint-space moves between the corners of random tasks, each repeated for ``task_s``; its poses are
    reported by other kinematics than it has. Deterministic for ``seed``.
    """
    rng = np.random.default_rng(seed)
    z = -_CENTER / np.linalg.norm(_CENTER) * 0.2 + np.array([0.1, 0.35, -0.9])
    z = z / np.linalg.norm(z)
    R_true = _facing(z)
    p_true = _CENTER - 0.65 * z
    nominal = load_chain(ROBOT)
    actual = replace(nominal, stack=_perturbed(nominal.stack, config.arm_rad, rng))
    warp = _warp(config.warp_m, rng)
    n = int(duration_s / config.frame_s)
    capture: Array = np.asarray((np.arange(n) + rng.uniform()) * config.frame_s * (1.0 + 2e-5 * rng.standard_normal()))
    stamps: Array = capture + _stamp_errors(config.stamps, n, rng)
    p, nrm, V, p_act, n_act, believed = (np.empty((n, k)) for k in (3, 3, 6, 3, 3, 3))
    task = np.minimum((capture / config.task_s).astype(int), int(duration_s / config.task_s))
    for k in np.unique(task):
        now = np.flatnonzero(task == k)
        q = _loop(config, -z, rng)
        period = len(q) * _STEP_S
        phase, late = np.mod(capture[now], period), np.mod(stamps[now], period)
        for arm, at, out_p, out_n in ((nominal, late, p, nrm), (actual, phase, p_act, n_act)):
            X = chain_poses(arm, q)
            out_p[now], out_n[now] = _sample(X[:, :3, 3], at), _unit(_sample(X[:, :3, 2], at))
        V[now] = _sample(_velocities(chain_poses(nominal, q)), late)
        believed[now] = _sample(chain_poses(nominal, q)[:, :3, 3], phase)
    R_k, p_k, scale = _scanner(config.changes, R_true, p_true, capture)
    p_C = np.einsum("nji,nj->ni", R_k, p_act - p_k)
    n_C = np.einsum("nji,nj->ni", R_k, n_act)
    p_C, n_C = warp(p_C, n_C)
    fitted = _best_move(p_C, believed, R_k, p_k, (task == task[0]) & (capture < capture[0] + 60.0))
    p_C = p_C * (1.0 + scale)[:, None]
    far = (p_C[:, 2] / 0.65) ** 2
    S = (config.depth_m**2 - config.centre_m**2) * n_C[:, :, None] * n_C[:, None, :] + config.centre_m**2 * np.eye(3)
    S = S * (far**2)[:, None, None]
    p_C = p_C + np.einsum("nij,nj->ni", np.linalg.cholesky(S), rng.standard_normal((n, 3)))
    n_C = _unit(n_C + config.normal_rad * rng.standard_normal((n, 3)))
    wrong = rng.random(n) < config.outliers
    p_C[wrong] += rng.normal(0.0, 2e-3, (int(wrong.sum()), 3))
    n_C[wrong] = _unit(n_C[wrong] + rng.normal(0.0, 0.01, (int(wrong.sum()), 3)))
    # the calibration: the pose that fits the first task best, with an error of the size that it states, about the
    # middle of the work
    a = fitted[:3] + config.calibration_rad * rng.standard_normal(3)
    b = fitted[3:] + config.calibration_m * rng.standard_normal(3)
    R_hat = exp_rotation(a) @ R_true
    p_hat = exp_rotation(a) @ (p_true - _CENTER) + _CENTER + b
    X_BC = RigidTransform(RotationMatrix.ProjectToRotationMatrix(R_hat), p_hat)
    lever = p_hat - _CENTER
    A = np.eye(6)
    A[3:, :3] = -np.array([[0, -lever[2], lever[1]], [lever[2], 0, -lever[0]], [-lever[1], lever[0], 0]])
    C = A @ np.diag(np.repeat([config.calibration_rad**2, config.calibration_m**2], 3)) @ A.T
    stated = np.full(n, config.stated * config.normal_rad)
    rows = rows_of(
        X_BC, _CENTER, stamps, p, nrm, V[:, 3:], np.cross(V[:, :3], nrm), p_C, n_C, config.stated**2 * S, stated
    )
    return FeatureWorld(X_BC, C, _CENTER, rows.part(np.argsort(stamps, kind="stable")))


def _best_move(p_C: Array, p_B: Array, R: Array, p: Array, which: Array) -> Array:
    """Return the turn and shift (6,) about the middle of the work that the systematic errors there look like."""
    seen = np.einsum("nij,nj->ni", R[which], p_C[which]) + p[which]
    X = fit_rigid(p_B[which] - _CENTER, seen - _CENTER)
    return np.concatenate([rotation_vector(X.rotation()), X.translation()])


def _stamp_errors(kind: str, n: int, rng: np.random.Generator) -> Array:
    """Stamps minus captures (n,) s after the mean delay is taken off."""
    if kind == "device":
        return np.asarray(1e-4 * rng.standard_normal(n) + 1e-4 * np.sin(np.arange(n) / 7e3))
    shape = 2.0
    return np.asarray(rng.gamma(shape, 0.015 / np.sqrt(shape), n) - 0.015 * np.sqrt(shape))


def _scanner(changes: tuple[Change, ...], R: Array, p: Array, t: Array) -> tuple[Array, Array, Array]:
    """Rotations (n, 3, 3), positions (n, 3) and scale errors (n,) of the scanner at times (n,)."""
    turn, shift, scale = np.zeros((len(t), 3)), np.zeros((len(t), 3)), np.zeros(len(t))
    for c in changes:
        since = np.maximum(t - c.time_s, 0.0)
        share = (t >= c.time_s).astype(float) if c.over_s <= 0.0 else np.minimum(since / c.over_s, 1.0)
        turn += share[:, None] * np.array(c.rotation_rad)
        shift += share[:, None] * np.array(c.translation_m)
        if c.scale:
            scale += c.scale * (1.0 - np.exp(-since / c.over_s))
    return exp_rotation(turn) @ R, p + shift, scale


def _perturbed(stack: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Link transforms of a real arm: small turns and lengths that the controller does not know."""
    out = stack.copy()
    for k in range(6):
        out[k, :3, :3] = out[k, :3, :3] @ exp_rotation(sigma * rng.standard_normal(3))
        out[k, :3, 3] += 3e-5 * rng.standard_normal(3)
    return out


def _warp(sigma: float, rng: np.random.Generator) -> Callable[[Array, Array], tuple[Array, Array]]:
    """A scanner's error along its rays, a cubic of the place in the image and in depth; of that rms over the work."""
    powers = [(i, j, k) for i in range(4) for j in range(4) for k in range(2) if 0 < i + j + k < 4]
    factors = rng.standard_normal(len(powers)) / np.sqrt(len(powers))

    def error(p: Array) -> Array:
        x, y, d = p[:, 0] / p[:, 2] / 0.25, p[:, 1] / p[:, 2] / 0.25, (p[:, 2] - 0.65) / 0.15
        return np.asarray(
            3.0 * sigma * sum(f * x**i * y**j * d**k for f, (i, j, k) in zip(factors, powers, strict=True))
        )

    def apply(p: Array, n: Array) -> tuple[Array, Array]:
        ray = p / np.linalg.norm(p, axis=1, keepdims=True)
        e, h = error(p), 0.01
        slope = np.stack([(error(p + h * axis) - error(p - h * axis)) / (2.0 * h) for axis in np.eye(3)], axis=1)
        # a surface whose points move by e along the view turns its normal by the slope of e
        return p + e[:, None] * ray, _unit(
            n - (slope - (slope * n).sum(axis=1, keepdims=True) * n) * (ray * n).sum(axis=1, keepdims=True)
        )

    return apply


def _loop(config: WorldConfig, towards: Array, rng: np.random.Generator) -> Array:
    """Joint positions (n, 6) every _STEP_S seconds of a closed path through four to six poses that show the flange."""
    arm = load_arm("ur10e")
    goals: list[Array] = []
    near = _Q_NEAR
    for _ in range(200):
        if len(goals) == 4 + int(rng.integers(0, 3)):
            break
        p = _CENTER + config.cube_m * (rng.random(3) - 0.5)
        R = exp_rotation(np.append(0.35 * rng.standard_normal(2), 0.0).clip(-0.5, 0.5)) @ _facing(towards)
        q = nearest_solution(arm, RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p), near)
        if q is None:
            continue
        if goals and np.abs(q - goals[0]).max() > 1.5:
            continue
        goals.append(q)
        near = goals[0]
    places = chain_poses(arm, np.array(goals))[:, :3, 3]
    out = []
    for k in range(len(goals)):
        j = (k + 1) % len(goals)
        way = float(np.linalg.norm(places[j] - places[k]))
        ramp = min(config.speed_m_s / _ACCELERATION, np.sqrt(way / _ACCELERATION))
        peak = ramp * _ACCELERATION
        total = way / max(peak, 1e-6) + ramp
        t = np.arange(0.0, total, _STEP_S)
        s = np.where(t < ramp, 0.5 * t**2, np.where(t < total - ramp, ramp * (t - 0.5 * ramp), 0.0)) * _ACCELERATION
        s = np.where(t >= total - ramp, way - 0.5 * _ACCELERATION * (total - t) ** 2, s) / max(way, 1e-9)
        out.append(goals[k] + s[:, None] * (goals[j] - goals[k]))
        if rng.random() < 0.5:
            out.append(np.tile(goals[j], (int(rng.integers(1, 80)), 1)))
    return np.vstack(out)


def _facing(z: Array) -> Array:
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _velocities(X: Array) -> Array:
    """[angular; linear] (n, 6) of poses (n, 4, 4) a step apart on a closed path."""
    later, before = np.roll(X, -1, axis=0), np.roll(X, 1, axis=0)
    v = (later[:, :3, 3] - before[:, :3, 3]) / (2.0 * _STEP_S)
    D = later[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2)
    w = 0.5 * np.stack([D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]], axis=1)
    return np.hstack([w / (2.0 * _STEP_S), v])


def _sample(values: Array, at: Array) -> Array:
    """Values (n, k) on the closed path at phases (m,) s."""
    x = at / _STEP_S
    i = np.floor(x).astype(int)
    w = (x - i)[:, None]
    return np.asarray((1.0 - w) * values[i % len(values)] + w * values[(i + 1) % len(values)])


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))
