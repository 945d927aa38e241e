"""The three features of a V-groove in a raw profile: both upper edges and the root, as intersections of four robust lines."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter

from weldcal.calibration.profiler.errors import FeatureNotFound
from weldcal.calibration.profiler.motion import Floats
from weldcal.models.errors import InputError

MEDIAN = 9  # samples: takes out spikes for the start only
OUTER = 0.12  # of the samples at each end lie on the plate
MINIMUM_DEPTH_M = 1e-3
MINIMUM_SAMPLES = 6  # of each of the four lines
ROUNDS = 8
TUKEY = 4.0
MARGIN_M = 0.5e-3  # beside an intersection nothing is taken for either line


@dataclass(frozen=True, eq=False)
class GrooveFeatures:
    """Edge, root, edge by rising x: points (3, 2) [x, z] m, their sigmas (3, 2) m, and the rms of the samples in m."""

    points: Floats
    sigmas: Floats
    rms_m: float


def groove_features(profile: ArrayLike) -> GrooveFeatures:
    """The features of a V-groove in a profile (n, 2) [x, z] m, z growing away from the sensor, NaN where nothing returned.

    Raises:
        FeatureNotFound: no V-groove with both walls and the plate on both sides. InputError: not a profile.

    Source: sphere and touch paper, section 3.2 (its feature points 1 to 3).
    """
    p = np.asarray(profile, float)
    if p.ndim != 2 or p.shape[1] != 2:
        raise InputError(f"A profile is an array (n, 2) of [x, z], not {p.shape}.")
    p = p[np.isfinite(p).all(axis=1)]
    p = p[np.argsort(p[:, 0], kind="stable")]
    n = len(p)
    if n < 8 * MINIMUM_SAMPLES:
        raise FeatureNotFound(f"The profile has {n} returns only: bring the groove into the scanner's range.")
    x, z = p.T
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


@dataclass(frozen=True, eq=False)
class _Line:
    """z = a + b (x - x0), the covariance (2, 2) of [a, b] and the sigma of a sample in z."""

    x0: float
    a: float
    b: float
    covariance: Floats
    sigma: float


def _start(x: Floats, z: Floats) -> Floats:
    """Where the four lines meet, roughly: the plate from the outer samples, the root deepest, the edges where it leaves."""
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
        sigma = max(1.4826 * float(np.median(np.abs(r))), 1e-7)
        weight = np.clip(1.0 - (r / (TUKEY * sigma)) ** 2, 0.0, None) ** 2
        a, b = _orthogonal(x - x0, z, weight)
    A = np.column_stack([np.ones(len(x)), x - x0]) * np.sqrt(weight)[:, None]
    # of Tukey's estimate at 4 sigma, which uses nine tenths of what the samples say
    in_z = sigma * np.hypot(1.0, b)
    return _Line(x0, a, b, np.asarray(np.linalg.inv(A.T @ A) * in_z**2 * (weight**2).mean() / weight.mean()), sigma)


def _orthogonal(u: Floats, z: Floats, weight: Floats) -> tuple[float, float]:
    """Intercept at u = 0 and slope of the line with the least weighted squares of distances across it."""
    total = weight.sum()
    mean = np.array([weight @ u, weight @ z]) / total
    d = np.column_stack([u, z]) - mean
    _, vectors = np.linalg.eigh((weight[:, None] * d).T @ d)
    b = float(vectors[1, 1] / vectors[0, 1])
    return float(mean[1] - b * mean[0]), b


def _meet(one: _Line, two: _Line) -> float:
    return float(((one.a - one.b * one.x0) - (two.a - two.b * two.x0)) / (two.b - one.b))


def _crossing(one: _Line, two: _Line) -> tuple[Floats, Floats]:
    """The intersection (2,) and its sigma (2,), by the covariances of both lines."""
    x = _meet(one, two)
    z = one.a + one.b * (x - one.x0)
    g1, g2 = np.array([1.0, x - one.x0]), np.array([1.0, x - two.x0])
    v1, v2 = float(g1 @ one.covariance @ g1), float(g2 @ two.covariance @ g2)
    lean = two.b - one.b
    return np.array([x, z]), np.array(
        [np.sqrt(v1 + v2) / abs(lean), np.hypot(two.b * np.sqrt(v1), one.b * np.sqrt(v2)) / abs(lean)]
    )


def _is_groove(lines: list[_Line]) -> bool:
    plate = 0.5 * (lines[0].b + lines[3].b)
    return lines[1].b > plate + 0.2 and lines[2].b < plate - 0.2 and abs(lines[0].b - lines[3].b) < 0.5
