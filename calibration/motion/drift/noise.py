"""Noise of tracked residuals, measured from their second differences: fit noise across the motion, jitter along it."""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.motion.drift.residuals import CLOCK, Rows
from weldcal.models.arrays import Array

LEAST = 20
"""Frames that a noise is measured from at least."""

_MOVES_M_S = 0.03  # slower frames say nothing of the jitter
_STRAIGHT = 0.98  # cosine between the directions of three frames whose noise is compared
_GAP = 3.0  # usual intervals: frames farther apart do not differ by noise alone
_CLIP = 4.0  # sigmas: a wrong fit counts as that far off
_LEAST_FACTOR, _LARGEST_FACTOR = 0.3, 30.0
_LEAST_JITTER_S = 1e-5  # a few micrometres of motion


@dataclass(frozen=True)
class FrameNoise:
    """Factors on the stated sigmas of the fits' centres and normals, and the jitter (s) of the frames' times."""

    center: float = 1.0
    normal: float = 1.0
    jitter_s: float = 0.0

    def covariance(self, fit: Array, motion: Array) -> Array:
        """Covariance (5, 5) of a residual with the fit's (5, 5) and its derivative (5,) by the time: S + sigma_j^2 u
        u'."""
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
        """The noise after a window with ``new`` frames more than the one before it."""
        now = np.log([window.center, window.normal, max(window.jitter_s, _LEAST_JITTER_S)])
        self._count = min(self._count + new, self._most)
        self._mean += (now - self._mean) * min(new / self._count, 1.0)
        mean = np.exp(self._mean)
        return FrameNoise(max(window.center, mean[0]), max(window.normal, mean[1]), max(window.jitter_s, mean[2]))


def measured_noise(rows: Rows, *, clock_s: float = 0.0) -> FrameNoise | None:
    """The noise in rows (n) in the order of their times; None where fewer than LEAST triples follow each other.

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
