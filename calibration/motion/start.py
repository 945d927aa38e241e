"""Search the offset of the clock coarsely: a robust fit of all frames for each of many offsets; also in hand."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import least_squares

from weldcal.calibration.geometry.se3 import exp_rotation, inverse, nearest_rotation
from weldcal.calibration.motion.observed import FrameClock, ObservedFrames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array

EARLIEST_S, LATEST_S = -0.5, 2.0
"""Delays (s) of a frame behind its capture that are searched."""
_STEP_S, _FINE_S = 0.01, 0.001
_MOST_FRAMES = 150
_ARM_M = 0.1  # a lever that turns an error of the normal into a length
_SHARE = 0.8  # of the frames that must agree
_ALIAS = 1.3  # times the least rms: another delay that fits so well is one of a motion that repeats itself
_SAME_M = 2e-5  # rms below any scanner's
_LEAST_KNOWN = 0.5  # of the frames must lie within the stream

_STEP_IN_HAND_S, _FINE_IN_HAND_S = 0.02, 0.002
_MOST_IN_HAND = 100
_FEWEST = 8
_ROBUST_M = 3e-3  # a choice: a nominal arm's errors are inliers, a wrong frame of 10 mm and more is not
_STEP_RAD = 1.5e-8  # of a difference: the root of the machine's precision


@dataclass(frozen=True, eq=False)
class Start:
    """Coarse result: the delay (s) of the clock's base behind capture, X_BC, and the curve of cost against delay.

    ``delays`` (D,) s and ``rms_m`` (D,) of the better part of the frames, NaN where too few lie within the stream.
    ``X_FR``: the feature on what moves, or the fixed target X_BT.
    """

    delay_s: float
    X_BC: RigidTransform
    delays: Array
    rms_m: Array
    X_FR: RigidTransform | None = None


def search_start(
    frames: ObservedFrames,
    clock: FrameClock,
    motion: ContinuousMotion,
    X_FR: RigidTransform | None = None,
    *,
    delays: Array | None = None,
) -> Start | None:
    """The delay, searched from EARLIEST_S to LATEST_S (or only those given, s), with the least error of a rigid fit.

    None where no delay puts enough frames within the stream. Centres and normals are used together, so that a motion
    along a line is enough for a start.
    """
    usable = np.flatnonzero(np.isfinite(clock.base))
    if len(usable) < 3:
        return None
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, min(len(usable), _MOST_FRAMES)).astype(int))]
    part, base = frames.pick(chosen), clock.base[chosen]
    given = delays is not None
    if delays is None:
        delays = np.arange(EARLIEST_S, LATEST_S + 0.5 * _STEP_S, _STEP_S)
    cost, _, _ = _costs(part, base, delays, motion, X_FR)
    if not np.isfinite(cost).any():
        return None
    best = plausible(delays, cost)
    fine = np.array([best]) if given else best + np.arange(-_STEP_S, _STEP_S + 0.5 * _FINE_S, _FINE_S)
    fine_cost, R, p = _costs(part, base, fine, motion, X_FR)
    k = int(np.nanargmin(fine_cost)) if np.isfinite(fine_cost).any() else 0
    order = np.argsort(np.concatenate([delays, fine]), kind="stable")
    return Start(
        float(fine[k]),
        RigidTransform(RotationMatrix.ProjectToRotationMatrix(R[k]), p[k]),
        np.concatenate([delays, fine])[order],
        np.sqrt(np.concatenate([cost, fine_cost])[order]),
    )


def plausible(delays: Array, cost: Array) -> float:
    """Return the delay of least cost; where a motion repeats itself, of those about as good the one nearest to zero."""
    c = np.where(np.isfinite(cost), cost, np.inf)
    around = np.minimum(np.concatenate([[np.inf], c[:-1]]), np.concatenate([c[1:], [np.inf]]))
    good = np.flatnonzero((c <= around) & (c <= _ALIAS**2 * c.min() + _SAME_M**2))
    return float(delays[good[np.argmin(np.abs(delays[good]))]])


def _costs(
    frames: ObservedFrames, base: Array, delays: Array, motion: ContinuousMotion, X_FR: RigidTransform | None
) -> tuple[Array, Array, Array]:
    """Return the mean square errors (D,) m^2 of the better frames, rotations (D, 3, 3) and positions (D, 3).

    Errors are NaN where too few frames are known.
    """
    t = base - delays[:, None]
    X = motion.poses(t.ravel())
    if X_FR is not None:
        X = X @ X_FR.GetAsMatrix4()
    p_B, n_B = (X[:, :3, c].reshape(len(delays), len(base), 3) for c in (3, 2))
    known = np.isfinite(p_B[:, :, 0])
    p_B, n_B = np.nan_to_num(p_B), np.nan_to_num(n_B)
    weight = known.astype(float)
    enough = known.sum(axis=1) >= max(3, int(_LEAST_KNOWN * len(base)))
    for _ in range(3):
        R, p = _rigid(p_B, n_B, frames, weight)
        e = np.einsum("dij,nj->dni", R, frames.p_C) + p[:, None] - p_B
        m = np.einsum("dij,nj->dni", R, frames.n_C) - n_B
        square = (e * e).sum(axis=2) + _ARM_M**2 * (m * m).sum(axis=2)
        ranked = np.sort(np.where(known, square, np.inf), axis=1)
        counts = np.maximum((_SHARE * known.sum(axis=1)).astype(int), 1)
        limit = ranked[np.arange(len(delays)), counts - 1]
        weight = (known & (square <= limit[:, None])).astype(float)
    cost = (square * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1.0)
    return np.where(enough, cost, np.nan), R, p


def _rigid(p_B: Array, n_B: Array, frames: ObservedFrames, weight: Array) -> tuple[Array, Array]:
    """Rotations (D, 3, 3) and positions (D, 3) of weighted rigid fits of centres and normals."""
    total = np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    mean_B = np.einsum("dn,dni->di", weight, p_B) / total
    mean_C = weight @ frames.p_C / total
    H = np.einsum("dn,dni,nj->dij", weight, p_B, frames.p_C) - total[:, :, None] * mean_B[:, :, None] * mean_C[:, None]
    H += _ARM_M**2 * np.einsum("dn,dni,nj->dij", weight, n_B, frames.n_C)
    U, _, Vt = np.linalg.svd(H)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    R = U @ Vt
    return R, mean_B - np.einsum("dij,dj->di", R, mean_C)


def search_in_hand(frames: ObservedFrames, clock: FrameClock, motion: ContinuousMotion) -> Start | None:
    """The delay from EARLIEST_S to LATEST_S that fits best, with X_FC (as ``X_BC``) and the target X_BT (as ``X_FR``).

    ``motion`` is inverted. None where no delay puts enough frames within the stream.

    For a delay, R_BF (R_FC p_C + p_FC) + p_BF = p_BT and R_BF R_FC n_C = n_BT are linear in the nine elements of R_FC,
    p_FC, p_BT and n_BT. The rotation nearest to those elements begins a robust fit with eleven unknowns.
    """
    usable = np.flatnonzero(np.isfinite(clock.base))
    if len(usable) < _FEWEST:
        return None
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, min(len(usable), _MOST_IN_HAND)).astype(int))]
    part, base = frames.pick(chosen), clock.base[chosen]
    delays = np.arange(EARLIEST_S, LATEST_S + 0.5 * _STEP_IN_HAND_S, _STEP_IN_HAND_S)
    found = [_at(part, base, float(d), motion) for d in delays]
    cost = np.array([f[0] for f in found])
    if not np.isfinite(cost).any():
        return None
    best = plausible(delays, cost)
    fine = best + np.arange(-_STEP_IN_HAND_S, _STEP_IN_HAND_S + 0.5 * _FINE_IN_HAND_S, _FINE_IN_HAND_S)
    found_fine = [_at(part, base, float(d), motion) for d in fine]
    cost_fine = np.array([f[0] for f in found_fine])
    k = int(np.nanargmin(cost_fine)) if np.isfinite(cost_fine).any() else 0
    _, R, p, p_T, n_T = found_fine[k]
    order = np.argsort(np.concatenate([delays, fine]), kind="stable")
    return Start(
        float(fine[k]),
        RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p),
        np.concatenate([delays, fine])[order],
        np.sqrt(np.concatenate([cost, cost_fine])[order]),
        RigidTransform(RotationMatrix.MakeFromOneVector(n_T, 2), p_T),
    )


def _at(
    frames: ObservedFrames, base: Array, delay: float, motion: ContinuousMotion
) -> tuple[float, Array, Array, Array, Array]:
    """Mean square error (m^2) of the better frames at a delay (s), R_FC, p_FC, p_BT and n_BT.

    NaN where too few are known.
    """
    X_FB = motion.poses(base - delay)
    known = np.isfinite(X_FB[:, 0, 0])
    nothing = (float("nan"), np.eye(3), np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    if np.count_nonzero(known) < max(_FEWEST, 0.5 * len(base)):
        return nothing
    X = inverse(X_FB[known])
    R_B, p_B, p_C, n_C = X[:, :3, :3], X[:, :3, 3], frames.p_C[known], frames.n_C[known]
    R = _relaxed(R_B, p_B, p_C, n_C)
    p, p_T = _shifts(R_B, p_B, p_C @ R.T)
    n_T = np.einsum("nij,nj->i", R_B, n_C @ R.T)
    n_T /= max(float(np.linalg.norm(n_T)), 1e-9)

    def residuals(x: Array) -> Array:
        turned = exp_rotation(x[:3]) @ R
        e = np.einsum("nij,nj->ni", R_B, p_C @ turned.T + x[3:6]) + p_B - x[6:9]
        n = n_T + x[9] * a + x[10] * b
        m = np.einsum("nij,nj->ni", R_B, n_C @ turned.T) - n / np.linalg.norm(n)
        return np.asarray(np.concatenate([e, _ARM_M * m], axis=1).ravel())

    def slopes(x: Array) -> Array:
        # forward differences for the rotation only: a call of the residuals for each of eleven unknowns takes most of
        # the search
        J = np.zeros((len(R_B), 6, 11))
        n = n_T + x[9] * a + x[10] * b
        length = np.linalg.norm(n)
        across = (np.eye(3) - np.outer(n, n) / length**2) / length
        J[:, :3, 3:6], J[:, :3, 6:9] = R_B, -np.eye(3)
        J[:, 3:, 9:] = -_ARM_M * across @ np.column_stack([a, b])
        now = residuals(x)
        for k in range(3):
            turned = x.copy()
            turned[k] += _STEP_RAD
            J[:, :, k] = ((residuals(turned) - now) / _STEP_RAD).reshape(-1, 6)
        return J.reshape(-1, 11)

    a = np.linalg.svd(n_T[None])[2][1]
    b = np.cross(n_T, a)
    x0 = np.concatenate([np.zeros(3), p, p_T, np.zeros(2)])
    x = least_squares(residuals, x0, slopes, loss="soft_l1", f_scale=_ROBUST_M, max_nfev=12).x
    square = np.sort((residuals(x).reshape(-1, 6) ** 2).sum(axis=1))
    n = n_T + x[9] * a + x[10] * b
    cost = float(square[: max(int(_SHARE * len(square)), 1)].mean())
    return cost, exp_rotation(x[:3]) @ R, x[3:6], x[6:9], n / np.linalg.norm(n)


def _relaxed(R_B: Array, p_B: Array, p_C: Array, n_C: Array) -> Array:
    """Return the rotation nearest to the nine elements that solve the linear equations."""
    n = len(p_C)
    A = np.zeros((n, 6, 18))
    A[:, :3, :9] = (R_B[:, :, :, None] * p_C[:, None, None, :]).reshape(n, 3, 9)
    A[:, :3, 9:12] = R_B
    A[:, :3, 12:15] = -np.eye(3)
    A[:, 3:, :9] = _ARM_M * (R_B[:, :, :, None] * n_C[:, None, None, :]).reshape(n, 3, 9)
    A[:, 3:, 15:] = -_ARM_M * np.eye(3)
    y = np.concatenate([-p_B, np.zeros((n, 3))], axis=1)
    return nearest_rotation(np.linalg.lstsq(A.reshape(-1, 18), y.ravel(), rcond=1e-6)[0][:9].reshape(3, 3))


def _shifts(R_B: Array, p_B: Array, seen_F: Array) -> tuple[Array, Array]:
    """p_FC and p_BT (3,) m for a known R_FC; ``seen_F`` (N, 3) m are the centres turned by it."""
    n = len(seen_F)
    A = np.concatenate([R_B, np.broadcast_to(-np.eye(3), (n, 3, 3))], axis=2)
    y = -p_B - np.einsum("nij,nj->ni", R_B, seen_F)
    x = np.linalg.lstsq(A.reshape(-1, 6), y.ravel(), rcond=1e-6)[0]
    return x[:3], x[3:]
