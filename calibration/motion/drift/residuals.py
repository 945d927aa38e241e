"""Residuals of a tracked flange against the calibration, their derivatives, and their noise from second differences."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.geometry.se3 import exp_rotation, skew
from weldcal.models.arrays import Array

MOVE, CLOCK, SCALE = slice(0, 6), 6, 7
SIZE = 8
"""Unknowns of a change: a move of the scanner [rotation; translation] in the base about the pivot, clock (s), scale."""

LEAST = 20
"""Frames that a noise is measured from at least."""

_MOVES_M_S = 0.03  # slower frames say nothing of the jitter
_STRAIGHT = 0.98  # cosine between the directions of three frames whose noise is compared
_GAP = 3.0  # usual intervals: frames farther apart do not differ by noise alone
_CLIP = 4.0  # sigmas: a wrong fit counts as that far off
_LEAST_FACTOR, _LARGEST_FACTOR = 0.3, 30.0
_LEAST_JITTER_S = 1e-5  # a few micrometres of motion


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedFrame:
    """A frame: robot time (s), the feature by the robot then, in B.

    Centre (3,) m, outward normal (3,), their rates (m/s, 1/s); its fit.

    ``p_CR`` (3,) m and ``n_C`` (3,) in the camera frame, after the scanner's correction; ``covariance`` (3, 3) m^2 of
    the centre and ``normal_sigma`` rad per axis: noise of the fit.
    """

    id: str
    time: float
    p_BR: Array
    n_B: Array
    v_BR: Array
    turn_B: Array
    p_CR: Array
    n_C: Array
    covariance: Array
    normal_sigma: float


@dataclass(frozen=True, eq=False)
class Rows:
    """Residuals of n frames.

    Times (n,), r (n, 5) [m m m rad rad] in B, their derivatives (n, 5, SIZE), covariances of the fits (n, 5, 5), and
    centres and normals (n, 3) in C. Two tilts are enough: the normal's third number follows.
    """

    times: Array
    residuals: Array
    derivatives: Array
    covariances: Array
    centers: Array
    normals: Array

    def __len__(self) -> int:
        return len(self.times)

    def part(self, which: slice | NDArray[np.intp] | NDArray[np.bool_]) -> "Rows":
        """Some of the frames."""
        return Rows(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def tracked_rows(X_BC: RigidTransform, pivot: Array, frames: Sequence[TrackedFrame]) -> Rows:
    """Residuals of frames (n) against a calibration.

    ``e`` = X_BC p_C - p_BR, and the tilt of R_BC n_C against the robot's normal.

    A scanner that moved by (a, b) about the pivot, X_BC' = Exp(a, b) X_BC, sees the flange where the old pose puts it
    at e = - a x (q - pivot) - b. A pose that is taken d seconds too early leaves e = v d; a scanner that measures all
    by 1 + s too long, s R_BC p_C.
    """
    names = ("time", "p_BR", "n_B", "v_BR", "turn_B", "p_CR", "n_C", "covariance", "normal_sigma")
    return rows_of(X_BC, pivot, *(np.array([getattr(f, name) for f in frames]) for name in names))


def rows_of(
    X_BC: RigidTransform,
    pivot: Array,
    times: Array,
    p_BR: Array,
    n_B: Array,
    v_BR: Array,
    turn_B: Array,
    p_CR: Array,
    n_C: Array,
    covariances: Array,
    normal_sigmas: Array,
) -> Rows:
    """Return the same from arrays.

    Times (n,), p_BR, n_B, v_BR, turn_B, p_CR, n_C (n, 3), covariances (n, 3, 3), normal_sigmas (n,).
    """
    n = len(times)
    R, p = X_BC.rotation().matrix(), np.asarray(X_BC.translation())
    q = p_CR @ R.T + p
    n_R = n_C @ R.T
    first = R[:, 0] - n_B * (n_B @ R[:, 0])[:, None]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(n_B, first)
    across = np.stack([first, second], axis=1)  # (n, 2, 3)
    r = np.empty((n, 5))
    r[:, :3] = q - p_BR
    r[:, 3:] = np.einsum("nij,nj->ni", across, n_R - n_B)
    H = np.zeros((n, 5, SIZE))
    H[:, :3, :3] = skew(q - pivot)
    H[:, :3, 3:6] = -np.eye(3)
    H[:, 3:, :3] = across @ skew(n_R)
    H[:, :3, CLOCK] = v_BR
    H[:, 3:, CLOCK] = np.einsum("nij,nj->ni", across, turn_B)
    H[:, :3, SCALE] = p_CR @ R.T
    S = np.zeros((n, 5, 5))
    S[:, :3, :3] = R @ covariances @ R.T
    S[:, [3, 4], [3, 4]] = (normal_sigmas**2)[:, None]
    return Rows(np.asarray(times, dtype=float), r, H, S, np.asarray(p_CR), np.asarray(n_C))


def about(covariance: Array, lever: Array) -> Array:
    """Return a covariance (6, 6) [rotation; translation] about one point, as of a point ``lever`` (3,) m farther."""
    A = np.eye(6)
    A[3:, :3] = -skew(lever)
    return np.asarray(A @ covariance @ A.T)


def moved_about(X_BC: RigidTransform, move: Array, pivot: Array) -> RigidTransform:
    """X_BC after a move (6,) [rotation; translation] in the base about the pivot (3,)."""
    M = np.eye(4)
    M[:3, :3] = exp_rotation(move[:3])
    M[:3, 3] = pivot - M[:3, :3] @ pivot + move[3:]
    return RigidTransform(M) @ X_BC


@dataclass(frozen=True)
class FrameNoise:
    """Factors on the stated sigmas of the fits' centres and normals, and the jitter (s) of the frames' times."""

    center: float = 1.0
    normal: float = 1.0
    jitter_s: float = 0.0

    def covariance(self, fit: Array, motion: Array) -> Array:
        """Covariance (5, 5) of a residual with the fit's (5, 5) and its derivative (5,) by the time.

        S + sigma_j^2 u u'.
        """
        factors = np.array([self.center] * 3 + [self.normal] * 2)
        return np.asarray(fit * np.outer(factors, factors) + self.jitter_s**2 * np.outer(motion, motion))


class NoiseMemory:
    """The noise to test with, from windows of some hundred frames that are measured one after another.

    A window's factors vary by a tenth, with its few triples and wrong fits. A statistic that counts in sigmas of the
    window that happens to be the quietest is too large, and a test of many frames meets such windows. So the noise is
    the newest window's, but in no part less than the geometric mean over the windows of the last ``frames``, to which a
    moment of wrong fits adds little.
    """

    def __init__(self, frames: int) -> None:
        self._most, self._count = frames, 0
        self._mean = np.zeros(3)  # logarithms

    def noise(self, window: FrameNoise, new: int) -> FrameNoise:
        """Return the noise after a window with ``new`` frames more than the one before it."""
        now = np.log([window.center, window.normal, max(window.jitter_s, _LEAST_JITTER_S)])
        self._count = min(self._count + new, self._most)
        self._mean += (now - self._mean) * min(new / self._count, 1.0)
        mean = np.exp(self._mean)
        return FrameNoise(max(window.center, mean[0]), max(window.normal, mean[1]), max(window.jitter_s, mean[2]))


def measured_noise(rows: Rows, *, clock_s: float = 0.0) -> FrameNoise | None:
    """Return the noise in rows (n) in the order of their times; None where fewer than LEAST triples follow each other.

    Second differences of neighbours cancel what varies slowly: the calibration's error, a change of the pose, the
    scanner's warp along the path. ``clock_s`` is a known error of the clock, which acceleration would leave in them.
    The jitter is taken from the motion's direction and the fits' noise from the two directions across it. Differences
    are clipped at four robust sigmas: a skewed jitter counts whole, a wrong fit does not.
    """
    if len(rows) < LEAST + 2:
        return None
    u = rows.derivatives[:, :, CLOCK]
    r = rows.residuals - clock_s * u
    dt = np.diff(rows.times)
    near = dt < _GAP * float(np.median(dt))
    speed = np.linalg.norm(u[:, :3], axis=1)
    moving = speed > _MOVES_M_S
    way = np.where(moving[:, None], u[:, :3] / np.maximum(speed, _MOVES_M_S)[:, None], 0.0)
    turned = np.einsum("ni,ni->n", way[2:], way[:-2])
    alike = near[1:] & near[:-1] & (moving[2:] == moving[:-2]) & (moving[1:-1] == moving[:-2])
    alike &= (turned > _STRAIGHT) | ~moving[1:-1]
    if int(alike.sum()) < LEAST:
        return None
    # what a frame is too early by, from its centre along the motion, and what that leaves across it and in the tilt
    late = np.einsum("ni,ni->n", r[:, :3], way) / np.maximum(speed, _MOVES_M_S)
    left = r - late[:, None] * u
    d, d_late = _second(left)[alike], _second(late[:, None])[alike, 0]
    S, way, speed, moving = (x[1:-1][alike] for x in (rows.covariances, way, speed, moving))
    P = np.eye(3) - way[:, :, None] * way[:, None, :]
    expected = np.einsum("nij,njk,nik->n", P, S[:, :3, :3], P)
    center = _factor(np.sqrt(_variance(np.einsum("ni,ni->n", d[:, :3], d[:, :3]) / np.maximum(expected, 1e-18))))
    own = center**2 * np.einsum("ni,nij,nj->n", way, S[:, :3, :3], way) / np.maximum(speed, _MOVES_M_S) ** 2
    jitter = 0.0
    if int(moving.sum()) >= LEAST:
        own_m, square = own[moving], d_late[moving] ** 2
        limit = _CLIP**2 * max(_variance(square / own_m), 1.0) * own_m
        weight = 1.0 / (own_m + float(np.median(square)))
        jitter = float(np.sqrt(max(float((weight * (np.minimum(square, limit) - own_m)).sum() / weight.sum()), 0.0)))
    tilt = np.einsum("ni,ni->n", d[:, 3:], d[:, 3:])
    turn = u[1:-1][alike, 3:]
    expected = S[:, 3, 3] + S[:, 4, 4] + own * np.einsum("ni,ni->n", turn, turn)
    return FrameNoise(center, _factor(np.sqrt(_variance(tilt / expected))), jitter)


def _second(values: Array) -> Array:
    """Second differences (n - 2, k) of values (n, k), with the variance of one of them."""
    return np.asarray((values[:-2] - 2.0 * values[1:-1] + values[2:]) / np.sqrt(6.0))


def _variance(squares: Array) -> float:
    """Mean of squares (n,), each clipped at so many robust sigmas."""
    limit = (_CLIP * MAD * float(np.median(np.sqrt(squares)))) ** 2
    return float(np.minimum(squares, max(limit, 1e-18)).mean())


def _factor(value: float) -> float:
    return float(np.clip(value, _LEAST_FACTOR, _LARGEST_FACTOR))
