"""Finds a laser profiler's clock offset from one straight edge that it crosses while the arm moves to and fro."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from weldcal.calibration.errors import TooFewPoses, UndeterminedPoses
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array

_WIDEST_S, _STEP_S = 0.5, 0.005
_FEWEST = 20
_OPEN_S = 0.02  # one sigma beyond which the offset counts as not shown
_SOFT = 2.0  # residuals, in sigmas, from which on they count less
_BLOCK_S = 0.5  # within which errors are common: the edge is not straight, the arm not exact


@dataclass(frozen=True, eq=False)
class LineClock:
    """A profiler's clock offset, and the edge that showed it.

    ``offset_s`` is the profile's stamp less the robot's time of the same instant, ``sigma_s`` its standard deviation.
    The edge has a ``point`` (3,) m and a ``direction`` (3,) in the base. ``rms_m`` is the points' distance from it,
    ``before_m`` that at offset zero.
    """

    offset_s: float
    sigma_s: float
    point: Array
    direction: Array
    rms_m: float
    before_m: float


def offset_from_line(time: Array, points_P: Array, X_FP: Array, motion: ContinuousMotion) -> LineClock:
    """Clock offset of a profiler on the flange from points of one straight edge.

    ``time`` (n,) s stamps of the profiles; ``points_P`` (n, 3) m where each profile crosses the edge, profiler frame;
    ``X_FP`` (4, 4) the profiler in the flange. A wrong time moves a point by the velocity across the edge: where that
    velocity is the same all along, it looks like a shift of the edge. Raises TooFewPoses, and UndeterminedPoses where
    the motion does not show the offset.
    """
    order = np.argsort(time, kind="stable")
    time, points = np.asarray(time, dtype=float)[order], np.asarray(points_P, dtype=float)[order]
    zero = motion.span[0]
    inside = motion.known(time - _WIDEST_S) & motion.known(time + _WIDEST_S)
    if np.count_nonzero(inside) < _FEWEST:
        raise TooFewPoses(
            f"{int(np.count_nonzero(inside))} profiles lie within the robot's stream; {_FEWEST} are needed, half a"
            " second from its ends."
        )
    time, points = time[inside] - zero, points[inside]

    def placed(d: float) -> Array:
        X = motion.poses(zero + time - d) @ X_FP
        return np.asarray(np.einsum("nij,nj->ni", X[:, :3, :3], points) + X[:, :3, 3])

    offsets = np.arange(-_WIDEST_S, _WIDEST_S + 0.5 * _STEP_S, _STEP_S)
    start = float(offsets[np.argmin([np.median(_distances(placed(d))) for d in offsets])])
    point, direction = _line(placed(start))
    side = np.linalg.svd(direction[None])[2][1:]  # (2, 3) across the edge
    along = (placed(start) - point) @ direction
    half = max(float(np.abs(along).max()), 1e-3)
    scale = 1.0

    def residuals(x: Array) -> Array:
        q = placed(start + x[4]) - point
        a = (q @ direction)[:, None] / half
        return np.asarray((q @ side.T - x[:2] - a * x[2:4]) / scale)

    def flat(x: Array) -> Array:
        return residuals(x).ravel()

    x = np.zeros(5)
    for _ in range(3):
        scale = MAD * float(np.median(np.abs(flat(x) * scale))) + 1e-9
        unit = np.array([scale] * 4 + [1e-3])
        x = least_squares(flat, x, loss="soft_l1", f_scale=_SOFT, x_scale=unit).x
    sigma = max(offset_sigma(flat, x, unit, time, _SOFT, _BLOCK_S))
    offset = start + float(x[4])
    if sigma > _OPEN_S or abs(offset) > _WIDEST_S - 2.0 * _STEP_S:
        raise UndeterminedPoses(
            "The motion does not show the profiler's clock offset: cross the edge to and fro, so that the velocity"
            " across it changes its sign."
        )
    a, b = point + side.T @ x[:2], direction + side.T @ x[2:4] / half
    rms = float(np.sqrt(np.mean(np.sum((residuals(x) * scale) ** 2, axis=1))))
    before = float(np.sqrt(np.mean(_distances(placed(0.0)) ** 2)))
    return LineClock(offset, float(sigma), a, b / np.linalg.norm(b), rms, before)


def offset_sigma(
    f: Callable[[Array], Array], x: Array, unit: Array, time: Array, soft: float, block_s: float
) -> tuple[float, float]:
    """Standard deviation of the last unknown of a soft-L1 fit, with errors that are common within blocks of time.

    Args:
        f: residuals, those of each of the times (n,) s one after the other, in sigmas, of the unknowns x (K,).
        unit: (K,) sizes of the unknowns, for differences; soft: residual from which on they count less.
        block_s: length of a block.

    Returns:
        By the scatter of the residuals, and as the fit states it for independent ones.
    """
    steps = 1e-3 * np.diag(unit)
    J = np.stack([(f(x + h) - f(x - h)) / (2.0 * h.sum()) for h in steps], axis=1)
    r = f(x)
    weight = 1.0 / np.sqrt(1.0 + (r / soft) ** 2)
    N = J.T @ (weight[:, None] * J)
    d = np.sqrt(np.maximum(np.diag(N), 1e-30))
    inverse_N = np.linalg.pinv(N / np.outer(d, d), hermitian=True) / np.outer(d, d)
    scores = (J * (weight * r)[:, None]).reshape(len(time), -1, len(x)).sum(axis=1)
    block = ((time - time[0]) / block_s).astype(int)
    sums = np.array([scores[block == b].sum(axis=0) for b in np.unique(block)])
    errors, single = (inverse_N @ sums.T)[-1], (inverse_N @ scores.T)[-1]
    common = float(errors @ errors) * len(sums) / max(len(sums) - 1, 1)
    # never below errors that are independent from one time to the next
    return float(np.sqrt(max(common, float(single @ single)))), float(np.sqrt(inverse_N[-1, -1]))


def _line(q: Array) -> tuple[Array, Array]:
    """Return a point (3,) and the direction (3,) of the line through points (n, 3)."""
    middle = np.median(q, axis=0)
    return middle, np.linalg.svd(q - middle, full_matrices=False)[2][0]


def _distances(q: Array) -> Array:
    """Distances (n,) of points (n, 3) from their line."""
    middle, direction = _line(q)
    e = q - middle
    return np.asarray(np.linalg.norm(e - np.outer(e @ direction, direction), axis=1))
