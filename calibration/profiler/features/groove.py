"""Extracts the edges and the root of a V-groove from a raw profile, as intersections of four robust lines.

Where the seam turns under the laser line its walls are curved in the profile: a bend that the samples show is followed,
and one that they may hide is in the sigmas.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter

from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.profiler.motion import Floats
from weldcal.calibration.profiler.returns import returns_of

MEDIAN = 9  # samples: takes out spikes for the start only
OUTER = 0.12  # of the samples at each end lie on the plate
MINIMUM_DEPTH_M = 1e-3  # a choice: below any groove to weld, above noise and scale of a plate
MINIMUM_SAMPLES = 6  # of each of the four lines
ROUNDS = 8
TUKEY = 4.0  # as in frustum.py
BENT = 2.5  # sigmas of its bend from which a wall is taken for curved, as beside a seam that turns
MEETINGS = 12
MARGIN_M = 0.5e-3  # beside an intersection nothing is taken for either line


@dataclass(frozen=True, eq=False)
class GrooveFeatures:
    """Edge, root, edge by rising x: points (3, 2) [x, z] m, their sigmas (3, 2) m, and the rms of the samples in m."""

    points: Floats
    sigmas: Floats
    rms_m: float


def groove_features(profile: ArrayLike) -> GrooveFeatures:
    """Find the features of a V-groove in a profile (n, 2) [x, z] m.

    ``z`` grows away from the sensor; NaN where nothing returned.

    Raises:
        FeatureNotFound: no V-groove with both walls and the plate on both sides. InputError: not a profile.

    Source: sphere and touch paper, section 3.2 (its feature points 1 to 3).
    """
    x, z = returns_of(profile, 8 * MINIMUM_SAMPLES, "groove").T
    knots = _start(x, median_filter(z, MEDIAN, mode="nearest"))
    for _ in range(ROUNDS):
        parts = _parts(x, knots)
        if min(part.sum() for part in parts) < MINIMUM_SAMPLES:
            raise FeatureNotFound(
                "The profile shows no V-groove with plate on both sides: centre the groove and come no closer."
            )
        lines = [_line(x[part], z[part]) for part in parts]
        new = np.array([_meet(a, b) for a, b in pairwise(lines)])
        moved = float(np.abs(new - knots).max())
        knots = new
        if not (np.isfinite(knots).all() and (np.diff(knots) > 0.0).all()):
            raise FeatureNotFound("The lines in the profile make no V-groove: scan across the groove, not along it.")
        if moved < 1e-7:
            break
    if not _is_groove(lines):
        raise FeatureNotFound("The lines in the profile make no V-groove: scan across the groove, not along it.")
    points, sigmas = zip(*(_crossing(a, b) for a, b in pairwise(lines)), strict=True)
    rms = float(np.sqrt(np.mean([line.sigma**2 for line in lines])))
    return GrooveFeatures(np.array(points), np.array(sigmas), rms)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Line:
    """z, a polynomial of u = (x - x0) / reach.

    Its coefficients (k,) and their covariance, and the sigma of a sample across it.

    Straight where the samples show no bend. `unseen` are then the squares (m) that coefficients of higher powers may
    still have, each with what of its power (m, 4) the polynomial leaves.
    """

    x0: float
    reach: float
    coefficients: Floats
    covariance: Floats
    unseen: Floats
    left: Floats
    sigma: float

    def at(self, x: float) -> tuple[float, float, float]:
        """Height, slope and variance of the height at x."""
        powers = ((x - self.x0) / self.reach) ** np.arange(4)
        k = len(self.coefficients)
        slope = self.coefficients[1:] * np.arange(1, k) @ powers[: k - 1] / self.reach
        variance = powers[:k] @ self.covariance @ powers[:k] + self.unseen @ (self.left @ powers) ** 2
        return float(self.coefficients @ powers[:k]), float(slope), float(variance)

    @property
    def slope(self) -> float:
        """In the middle."""
        return float(self.coefficients[1] / self.reach)


def _start(x: Floats, z: Floats) -> Floats:
    """Where the four lines meet, roughly.

    The plate from the outer samples, the root deepest, the edges where it leaves.
    """
    k = max(int(OUTER * len(x)), MINIMUM_SAMPLES)
    ends = np.r_[:k, len(x) - k : len(x)]
    slope, level = np.polyfit(x[ends], z[ends], 1)
    depth = z - (level + slope * x)
    root = int(np.argmax(depth))
    if depth[root] < MINIMUM_DEPTH_M or not k < root < len(x) - k:
        raise FeatureNotFound(
            "The profile shows no V-groove: centre the groove in the laser line, with plate on both sides."
        )
    deep = depth > 0.1 * depth[root]
    left = root - int(np.argmin(deep[root::-1]))
    right = root + int(np.argmin(deep[root:]))
    if deep[root::-1].all() or deep[root:].all():
        raise FeatureNotFound("The profile shows one side of the groove only: centre the groove in the laser line.")
    return np.array([x[left], x[root], x[right]])


def _parts(x: Floats, knots: Floats) -> list[NDArray[np.bool_]]:
    margin = min(MARGIN_M, 0.1 * float(np.diff(knots).min()))
    limits = np.concatenate([[-np.inf], knots, [np.inf]])
    return [(x > a + margin) & (x < b - margin) for a, b in pairwise(limits)]


def _line(x: Floats, z: Floats) -> _Line:
    """By Tukey's weights, from repeated medians of a thinned set; distances are taken across the line, not along z."""
    thin = slice(None, None, max(1, len(x) // 60))
    u, v = x[thin], z[thin]
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = (v[None, :] - v[:, None]) / (u[None, :] - u[:, None])
    b = float(np.nanmedian(np.nanmedian(np.where(np.isfinite(slopes), slopes, np.nan), axis=1)))
    x0 = float(x.mean())
    a = float(np.median(z - b * (x - x0)))
    weight = np.ones(len(x))
    sigma = 1.0
    for _ in range(10):
        across = 1.0 / np.hypot(1.0, b)
        r = (z - a - b * (x - x0)) * across
        sigma = max(MAD * float(np.median(np.abs(r))), 1e-7)
        weight = np.clip(1.0 - (r / (TUKEY * sigma)) ** 2, 0.0, None) ** 2
        a, b = _orthogonal(x - x0, z, weight)
    # of Tukey's estimate at 4 sigma, which uses nine tenths of what the samples say
    spread = sigma**2 * (1.0 + b * b) * float((weight**2).mean() / weight.mean())
    reach = float(np.ptp(x)) / 2.0
    root = np.sqrt(weight)[:, None]
    powers = root * ((x - x0) / reach)[:, None] ** np.arange(4)
    rest = root[:, 0] * (z - a - b * (x - x0))
    straight = np.array([a, b * reach, 0.0, 0.0])
    unseen: list[float] = []
    left: list[Floats] = []
    for k in (4, 3, 2):
        C = np.asarray(np.linalg.inv(powers[:, :k].T @ powers[:, :k]) * spread, float)
        change = np.linalg.lstsq(powers[:, :k], rest, rcond=None)[0]
        bend = float(change[-1] ** 2)
        if k == 2 or bend > BENT**2 * C[-1, -1]:
            break
        unseen.append(max(bend - float(C[-1, -1]), 0.0))
        lower = np.linalg.lstsq(powers[:, : k - 1], powers[:, k - 1], rcond=None)[0]
        left.append(np.concatenate([-lower, [1.0], np.zeros(4 - k)]))
    found = straight[:2] if k == 2 else straight[:k] + change
    hidden, of = np.array(unseen), np.array(left).reshape(-1, 4)
    return _Line(x0=x0, reach=reach, coefficients=found, covariance=C, unseen=hidden, left=of, sigma=sigma)


def _orthogonal(u: Floats, z: Floats, weight: Floats) -> tuple[float, float]:
    """Intercept at u = 0 and slope of the line with the least weighted squares of distances across it."""
    total = weight.sum()
    mean = np.array([weight @ u, weight @ z]) / total
    d = np.column_stack([u, z]) - mean
    _, vectors = np.linalg.eigh((weight[:, None] * d).T @ d)
    b = float(vectors[1, 1] / vectors[0, 1])
    return float(mean[1] - b * mean[0]), b


def _meet(one: _Line, two: _Line) -> float:
    x = 0.5 * (one.x0 + two.x0)
    for _ in range(MEETINGS):
        (z1, b1, _), (z2, b2, _) = one.at(x), two.at(x)
        step = (z1 - z2) / (b2 - b1) if b1 != b2 else np.nan
        x += step
        if not abs(step) > 1e-9:
            break
    return float(x)


def _crossing(one: _Line, two: _Line) -> tuple[Floats, Floats]:
    """Return the intersection (2,) and its sigma (2,), by the covariances of both lines."""
    x = _meet(one, two)
    (z, b1, v1), (_, b2, v2) = one.at(x), two.at(x)
    lean = b2 - b1
    return np.array([x, z]), np.array(
        [np.sqrt(v1 + v2) / abs(lean), np.hypot(b2 * np.sqrt(v1), b1 * np.sqrt(v2)) / abs(lean)]
    )


def _is_groove(lines: list[_Line]) -> bool:
    first, down, up, last = (line.slope for line in lines)
    plate = 0.5 * (first + last)
    return down > plate + 0.2 and up < plate - 0.2 and abs(first - last) < 0.5
