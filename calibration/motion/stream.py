"""Interpolates a robot's recorded stream in continuous time.

Smoothed joints or poses, velocities, and where it has no data.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.models.arms.kinematics import Chain, chain_poses
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.robots import get_chain

Flags = NDArray[np.bool_]

_HALF_WIDTHS = (2, 3, 4, 6, 8, 12, 16, 24)  # samples on either side of a local parabola
_WIDEST_S = 0.06  # half a window; an arm changes its acceleration within some ten milliseconds
_GAP_S, _GAP_STEPS = 0.04, 5.0  # between two samples: beyond both, the motion between them is unknown
_STEP_S = 1e-3  # half the interval of a velocity
_CHUNK = 16_384  # samples smoothed at a time
_HELD_S = 0.02  # values that repeat for no longer were read faster than the robot updates them
_HELD_SHARE = 0.4  # of the samples in motion that repeat, for a stream to count as such


@dataclass(frozen=True, eq=False)
class FeatureMotion:
    """Motion of the flange feature at N times, base frame.

    Centre ``p`` (N, 3) m, outward normal ``n`` (N, 3), and their rates ``v`` (N, 3) m/s and ``turn`` (N, 3) 1/s. NaN
    where the stream has no data.
    """

    p: Array
    n: Array
    v: Array
    turn: Array


class ContinuousMotion:
    """Flange pose X_BF as a function of the robot's time, from its stream.

    Joints (or positions and quaternions) are smoothed by local parabolas. How wide is found by leave-one-out prediction
    of the stream itself, so that a clean stream is hardly touched, and jitter of its times and rounding are averaged.
    In between, cubic Hermite polynomials through the parabolas' values and slopes. No value is given across a gap or
    outside the stream.

    ``inverted``: the poses are X_FB. A scanner on the flange sees the fixed world move so.
    """

    def __init__(self, stream: RobotStream, *, inverted: bool = False) -> None:
        """Raises InputError: fewer than ten samples, or a robot of the joints that is not known."""
        self._chain: Chain | None = None
        self.inverted = inverted
        if stream.joints is not None:
            self._chain = get_chain(stream.robot)
            groups = [stream.joints]
        else:
            groups = [stream.poses[:, :3, 3], _continuous_quaternions(stream.poses[:, :3, :3])]
        keep = ~_held(stream.time, np.hstack(groups))
        keep &= np.concatenate([[True], np.diff(stream.time) > 0.0])
        t, groups = stream.time[keep], [g[keep] for g in groups]
        if len(t) < 10:
            raise InputError("The robot's stream has fewer than ten samples; record it at 100 per second or more.")
        # times near zero: a spline squares them
        self._zero = float(t[0])
        t = t - self._zero
        self.step_s = float(np.median(np.diff(t)))
        gap = np.diff(t) > max(_GAP_S, _GAP_STEPS * self.step_s)
        self._bounds = np.concatenate([[0], np.flatnonzero(gap) + 1, [len(t)]])
        self._begins, self._ends = t[self._bounds[:-1]], t[self._bounds[1:] - 1]
        self._splines, self.half_widths_s = [], []
        for values in groups:
            fitted, slopes, half_width = _smoothed(t, values, self._bounds)
            self._splines.append(CubicHermiteSpline(t, fitted, slopes))
            self.half_widths_s.append(half_width * self.step_s)

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of the stream, s."""
        return self._zero + float(self._begins[0]), self._zero + float(self._ends[-1])

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """Intervals (begin, end) s within the stream that have no data."""
        return [
            (self._zero + float(e), self._zero + float(b))
            for e, b in zip(self._ends[:-1], self._begins[1:], strict=True)
        ]

    def known(self, t: Array) -> Flags:
        """Return whether the stream has data at times (N,) s."""
        x = np.asarray(t, dtype=float) - self._zero
        k = np.clip(np.searchsorted(self._begins, x, side="right") - 1, 0, None)
        return np.asarray((x >= self._begins[k]) & (x <= self._ends[k]))

    def poses(self, t: Array) -> Array:
        """Flange poses X_BF (N, 4, 4), or X_FB where inverted, at times (N,) s; NaN where the stream has no data."""
        t = np.asarray(t, dtype=float)
        values = [spline(t - self._zero) for spline in self._splines]
        X = inverse(self._compose(values)) if self.inverted else self._compose(values)
        X[~self.known(t)] = np.nan
        return X

    def _compose(self, values: list[Array]) -> Array:
        if self._chain is not None:
            return chain_poses(self._chain, values[0])
        return pose(Rotation.from_quat(values[1]).as_matrix(), values[0])

    def feature(self, t: Array, X_FR: RigidTransform | None = None) -> FeatureMotion:
        """Motion of the feature (X_FR in the flange frame; identity: the bare flange) at times (N,) s."""
        t = np.asarray(t, dtype=float)
        X_R = np.eye(4) if X_FR is None else X_FR.GetAsMatrix4()
        begin, end = self.span
        early, late = np.maximum(t - _STEP_S, begin), np.minimum(t + _STEP_S, end)
        now, before, after = (self.poses(np.concatenate([t, early, late])) @ X_R).reshape(3, -1, 4, 4)
        dt = np.maximum(late - early, 1e-9)[:, None]
        p, n = now[:, :3, 3], now[:, :3, 2]
        return FeatureMotion(p, n, (after[:, :3, 3] - before[:, :3, 3]) / dt, (after[:, :3, 2] - before[:, :3, 2]) / dt)


def _continuous_quaternions(R: Array) -> Array:
    """Quaternions (n, 4) xyzw of rotations (n, 3, 3), their signs such that neighbours are near each other."""
    q = Rotation.from_matrix(R).as_quat()
    flips = np.cumprod(np.where((q[1:] * q[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
    q[1:] *= flips[:, None]
    return np.asarray(q)


def _held(t: Array, values: Array) -> Flags:
    """Samples (n,) that repeat the one before because the robot had not updated it yet.

    None where that is not usual.
    """
    same = np.concatenate([[False], (np.diff(values, axis=0) == 0.0).all(axis=1)])
    first = np.maximum.accumulate(np.where(same, 0, np.arange(len(t))))
    runs = np.bincount(first, minlength=len(t))  # samples of the run that begins here
    last = np.minimum(first + runs[first] - 1, len(t) - 1)
    short = t[last] - t[first] < _HELD_S
    repeats = same & short
    if np.count_nonzero(repeats) < _HELD_SHARE * max(int(np.count_nonzero(short)), 1):
        return np.zeros(len(t), dtype=bool)
    return np.asarray(repeats)


def _smoothed(t: Array, values: Array, bounds: NDArray[np.int64]) -> tuple[Array, Array, int]:
    """Values and slopes (n, c) of local parabolas, and their half width in samples.

    Half of that with the least leave-one-out error.

    That one balances noise and bias of a single time. Here the noise averages over the frames, while the bias where a
    move's acceleration jumps is the same in every lap. Half the width has a quarter of the bias and 1.4 times the
    noise.
    """
    step = float(np.median(np.diff(t)))
    best: tuple[float, int] | None = None
    found: dict[int, tuple[Array, Array]] = {}
    for m in _HALF_WIDTHS:
        if m > 2 and m * step > _WIDEST_S:
            break
        fitted, slopes, error = _parabolas(t, values, bounds, m)
        found[m] = fitted, slopes
        if best is not None and error >= best[0]:
            if m > 2 * best[1]:
                break  # it rises
            continue
        best = (error, m)
    assert best is not None
    half_width = max(m for m in found if m <= max(best[1] // 2, _HALF_WIDTHS[0]))
    return (*found[half_width], half_width)


def _parabolas(t: Array, values: Array, bounds: NDArray[np.int64], m: int) -> tuple[Array, Array, float]:
    """Local parabolas over ``m`` samples on either side.

    Values and slopes (n, c), and the mean square of the errors with which each sample is predicted without itself.
    """
    fitted, slopes = values.copy(), np.zeros_like(values)
    total, count = 0.0, 0
    for a, b in pairwise(bounds.tolist()):
        n = b - a
        if n < 4:  # too short for a parabola: straight lines
            if n > 1:
                slopes[a:b] = np.gradient(values[a:b], t[a:b], axis=0)
            continue
        half = min(m, (n - 1) // 2)
        for begin in range(a, b, _CHUNK):
            i = np.arange(begin, min(begin + _CHUNK, b))
            first = np.clip(i - half, a, b - 2 * half - 1)
            w = first[:, None] + np.arange(2 * half + 1)
            x = (t[w] - t[i, None]) / (half * (t[b - 1] - t[a]) / (n - 1))
            weight = (1.0 - (np.abs(w - i[:, None]) / (2.0 * half + 1.0)) ** 2) ** 2
            A = np.stack([np.ones_like(x), x, x * x], axis=2)
            WA = weight[:, :, None] * A
            N = np.swapaxes(WA, 1, 2) @ A
            inverse = np.linalg.inv(N + 1e-12 * np.eye(3))
            coefficients = inverse @ (np.swapaxes(WA, 1, 2) @ values[w])
            fitted[i] = coefficients[:, 0]
            slopes[i] = coefficients[:, 1] / (half * (t[b - 1] - t[a]) / (n - 1))
            # the weight of a sample in its own prediction
            own = np.minimum(inverse[:, 0, 0] * weight[np.arange(len(i)), i - first], 0.999)
            left_out = (values[i] - fitted[i]) / (1.0 - own)[:, None]
            total += float((left_out**2).sum())
            count += left_out.size
    return fitted, slopes, total / max(count, 1)
