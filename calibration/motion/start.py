"""Searches the clock's offset coarsely: one robust rigid fit of all frames for each of many offsets."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.motion.clock import FrameClock
from weldcal.calibration.motion.observed import ObservedFrames
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


@dataclass(frozen=True, eq=False)
class Start:
    """Coarse result: the delay (s) of the clock's base behind capture, X_BC, and the curve of cost against delay:
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
    """The delay, searched from EARLIEST_S to LATEST_S (or only those given, s), with the least error of a rigid fit;
    None where no delay puts enough frames within the stream. Centres and normals are used together, so that a motion
    along a line is enough for a start."""
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
    """The delay of least cost; where a motion repeats itself, of those about as good the one nearest to zero."""
    c = np.where(np.isfinite(cost), cost, np.inf)
    around = np.minimum(np.concatenate([[np.inf], c[:-1]]), np.concatenate([c[1:], [np.inf]]))
    good = np.flatnonzero((c <= around) & (c <= _ALIAS**2 * c.min() + _SAME_M**2))
    return float(delays[good[np.argmin(np.abs(delays[good]))]])


def _costs(
    frames: ObservedFrames, base: Array, delays: Array, motion: ContinuousMotion, X_FR: RigidTransform | None
) -> tuple[Array, Array, Array]:
    """Mean square errors (D,) m^2 of the better frames, NaN where too few are known, rotations (D, 3, 3) and positions
    (D, 3)."""
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
