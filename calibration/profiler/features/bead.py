"""Measures a bead in a raw profile: width from toe to toe, height over the plates, and area, each with its sigma.

A toe is where the height over the plates falls below a stated one. The plates are one parabola on both sides, or two
lines where that does not hold: then they meet under the bead (fillet, roof), or a chord joins the toes (lap).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag
from scipy.ndimage import binary_dilation, grey_closing, grey_opening, label, median_filter
from scipy.stats import theilslopes

from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.profiler.motion import Floats
from weldcal.calibration.profiler.returns import returns_of

TOE_M = 0.2e-3  # a choice: above noise and scale of a plate, below any bead
LEAST_WIDTH_M, LEAST_HEIGHT = 2e-3, 1.5  # of a bead; the height in those of its toes
BALL_M = 1.2e-3  # widest spatter that is taken out
SPIKE, EDGE = 5, 1  # samples: a spike downwards has fewer; those beside spatter that go with it
SPATTER, NOISE_M = 7.0, 0.02e-3  # sigmas off what opening and closing leave; the least sigma of a sample
OUTER, FEWEST = 0.12, 10  # of the samples lie on the plate at each end; samples of the plate on each side
BESIDE_M, TOE_SLOPE = 1e-3, 0.1  # beyond a toe nothing is taken for the plate; least slope of a bead's side
TOE_HALF_M, TOE_FEWEST = 0.4e-3, 4  # on each side of a toe, of the curve that gives it: reach, and least samples
CROWN = 0.3  # of the width to each side of the crown, of the curve that gives the height
WIDE_GAP, GAP_SAMPLES = 3.0, 12  # steps that make a gap, and the samples whose curve fills it
ROUNDS, LAGS, OUTLIER = 12, 5, 4.0  # neighbours that may share their noise; sigmas
NO_BEAD = "The profile shows no bead with plate on both sides: centre the bead in the laser line."
BROKEN = 20.0  # a choice: by how much chi-square falls where two lines take the place of the parabola


@dataclass(frozen=True, eq=False, kw_only=True)
class BeadFeatures:
    """A bead's section.

    Attributes:
        points: left toe, right toe, crown and the plate below it, (4, 2) [x, z] m.
        values: width m, height m and area m2, (3,); sigmas: of each, (3,).
    """

    points: Floats
    values: Floats
    sigmas: Floats


def bead_features(profile: ArrayLike, toe_m: float = TOE_M) -> BeadFeatures:
    """Measure the bead of a profile (n, 2) [x, z] m.

    ``z`` grows away from the sensor; NaN where nothing returned. ``toe_m``: height over the plates at the toes.

    Raises:
        FeatureNotFound: no bead with plate on both sides. InputError: not a profile.
    """
    p = _cleaned(returns_of(profile, 8 * FEWEST, "bead") * [1.0, -1.0])
    k = max(int(OUTER * len(p)), FEWEST)
    origin, turn = _level(p, k)
    q = (p - origin) @ turn
    u, v = q[np.argsort(q[:, 0], kind="stable")].T
    w = v - _plates(u, v, (u[k], u[-k])).at(u)
    top = float(median_filter(w, k, mode="nearest").max())
    core = _region(u, w, max(0.5 * top, toe_m))
    beside = 0.5 * (core[1] - core[0])
    plates = _plates(u, v, (max(core[0] - beside, u[k]), min(core[1] + beside, u[-k])))
    toes = _region(u, v - plates.at(u), toe_m)
    for _ in range(ROUNDS):
        plates = _plates(u, v, (toes[0] - BESIDE_M, toes[1] + BESIDE_M))
        w = v - plates.at(u) - toe_m
        found = np.array([_toe(u, w, at, plates.sigma, inwards) for at, inwards in zip(toes, (1.0, -1.0), strict=True)])
        toes = (found[0, 0], found[1, 0])
    if found[:, 1].min() < TOE_SLOPE or toes[1] - toes[0] < LEAST_WIDTH_M:
        raise FeatureNotFound(NO_BEAD)
    up, values, sigmas = _measured(u, w, plates, found, toe_m)
    points = (np.column_stack([up[:, 0], plates.at(up[:, 0]) + up[:, 1]]) @ turn.T + origin) * [1.0, -1.0]
    return BeadFeatures(points=points, values=values, sigmas=sigmas)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Plates:
    """The plates: height rows(u) @ coefficients, their covariance, and the sigma of a sample.

    ``shared`` is the factor on variances of sums, for noise that neighbours share.
    """

    rows: Callable[[Floats], Floats]
    coefficients: Floats
    covariance: Floats
    sigma: float
    shared: float

    def at(self, u: Floats) -> Floats:
        """Heights (n,) m at u (n,) m."""
        return np.asarray(self.rows(u) @ self.coefficients)


def _level(p: Floats, k: int) -> tuple[Floats, Floats]:
    """Return the middle (2,) of a profile [x, up] and axes, the columns of (2, 2), one along both plates."""
    angle = float(np.mean([np.arctan(theilslopes(part[:, 1], part[:, 0])[0]) for part in (p[:k], p[-k:])]))
    c, s = np.cos(angle), np.sin(angle)
    return np.median(p, axis=0), np.array([[c, -s], [s, c]])


def _cleaned(p: Floats) -> Floats:
    """Leave out spikes and balls, by a closing and then an opening: both keep a slope and a corner as they are.

    Of a profile (n, 2) [x, up] m by rising x.
    """
    wide = 1 + int(BALL_M / float(np.median(np.diff(p[:, 0]))))
    off: Floats = p[:, 1] - median_filter(p[:, 1], wide, mode="nearest")
    level = SPATTER * max(MAD * float(np.median(np.abs(off))), NOISE_M)
    off = np.asarray(grey_closing(p[:, 1], (SPIKE,))) - p[:, 1]
    p = p[~binary_dilation(off > level, iterations=EDGE)]
    off = p[:, 1] - np.asarray(grey_opening(p[:, 1], (wide,)))
    return np.asarray(p[~binary_dilation(off > level, iterations=EDGE)])


def _region(u: Floats, w: Floats, level_m: float) -> tuple[float, float]:
    """Return the ends of the bead, roughly: of the samples over a level those neighbours that enclose most area."""
    w = median_filter(w, SPIKE, mode="nearest")
    regions, count = label(w > level_m)
    areas = np.bincount(regions, np.where(w > level_m, w, 0.0), count + 1)[1:]
    inside = np.flatnonzero(regions == 1 + np.argmax(areas)) if count else np.zeros(1, int)
    if np.ptp(u[inside]) < LEAST_WIDTH_M or w[inside].max() < LEAST_HEIGHT * level_m:
        raise FeatureNotFound(NO_BEAD)
    return float(u[inside[0]]), float(u[inside[-1]])


def _fit(A: Floats, y: Floats, sigma: float = 0.0) -> tuple[Floats, Floats, float]:
    """Return coefficients, covariance and a sample's sigma by least squares.

    The worst sample is left out, one after the other, while it is off by more than OUTLIER sigmas.
    """
    if len(y) < A.shape[1] + 2:
        raise FeatureNotFound("The profile has too few returns at the bead's toes or crown: check the exposure.")
    found = np.linalg.lstsq(A, y, rcond=None)[0]
    off = np.abs(y - A @ found)
    s = max(sigma, MAD * float(np.median(off)), 1e-7)
    worst = int(np.argmax(off))
    if off[worst] > OUTLIER * s:
        return _fit(np.delete(A, worst, axis=0), np.delete(y, worst), sigma)
    s = max(sigma, float(np.sqrt(off @ off / (len(y) - A.shape[1])))) if sigma > 0.0 else s
    return np.asarray(found, float), np.asarray(s**2 * np.linalg.inv(A.T @ A), float), s


def _powers(u: Floats, count: int) -> Floats:
    return np.asarray((1e3 * u)[:, None] ** np.arange(count))


def _plates(u: Floats, v: Floats, limits: tuple[float, float]) -> _Plates:
    """Fit the plates outside two places: one parabola, or a line on each side where chi-square falls by BROKEN."""
    left, right = u < limits[0], u > limits[1]
    if min(left.sum(), right.sum()) < FEWEST:
        raise FeatureNotFound(NO_BEAD)
    outside = left | right
    one, C, sigma = _fit(_powers(u, 3)[outside], v[outside])
    (a, C_a, s_a), (b, C_b, s_b) = (_fit(_powers(u, 2)[side], v[side]) for side in (left, right))
    two = float(np.hypot(s_a, s_b)) / np.sqrt(2.0)
    off = (v - _powers(u, 3) @ one)[outside]
    rest = np.concatenate([(v - _powers(u, 2) @ a)[left], (v - _powers(u, 2) @ b)[right]])
    falls = np.minimum((off / two) ** 2, OUTLIER**2) - np.minimum((rest / two) ** 2, OUTLIER**2)
    if falls.sum() < BROKEN:
        rows, factor = partial(_powers, count=3), _shared(off, sigma)
        return _Plates(rows=rows, coefficients=one, covariance=C, sigma=sigma, shared=factor)
    first, last = limits[0] + BESIDE_M, limits[1] - BESIDE_M
    meet = 1e-3 * (a[0] - b[0]) / (b[1] - a[1]) if a[1] != b[1] else np.inf
    corner = first < meet < last

    def two_rows(at: Floats) -> Floats:  # that meet, or with a chord from toe to toe
        share = (1.0 * (at < meet) if corner else np.clip((last - at) / (last - first), 0.0, 1.0))[:, None]
        ours, theirs = (at, at) if corner else (np.minimum(at, first), np.maximum(at, last))
        return np.hstack([share * _powers(ours, 2), (1.0 - share) * _powers(theirs, 2)])

    both, found = block_diag(C_a, C_b), np.concatenate([a, b])
    return _Plates(rows=two_rows, coefficients=found, covariance=both, sigma=two, shared=_shared(rest, two))


def _shared(r: Floats, sigma: float) -> float:
    """Factor on the variance of a sum of neighbours, from the correlations of residuals (n,) that follow each other."""
    r = np.clip(r, -OUTLIER * sigma, OUTLIER * sigma)
    return max(1.0, 1.0 + 2.0 * float(sum(r[:-k] @ r[k:] for k in range(1, LAGS + 1)) / (r @ r)))


def _toe(u: Floats, w: Floats, at: float, sigma: float, inwards: float) -> tuple[float, float, float]:
    """Step to where heights w (n,) m pass zero, on a parabola through the samples around; ``inwards`` is 1 or -1.

    Returns:
        the place m, the slope there, positive inwards, and the sigma of the height, m.
    """
    low, k, high = np.searchsorted(u, [at - TOE_HALF_M, at, at + TOE_HALF_M])
    near = slice(max(min(low, k - TOE_FEWEST), 0), max(high, k + TOE_FEWEST))
    (level, slope, _), covariance, _ = _fit(_powers(u[near] - at, 3), w[near], sigma)
    slope *= 1e3 * inwards
    step = np.clip(-level / slope, -3e-4, 3e-4) if slope > TOE_SLOPE else 2e-4
    return at + inwards * float(step), slope, float(np.sqrt(covariance[0, 0]))


def _measured(u: Floats, w: Floats, plates: _Plates, toes: Floats, toe_m: float) -> tuple[Floats, Floats, Floats]:
    """Measure heights w (n,) m over those of the toes.

    Returns:
        place and height over the plates of toes, crown and the plate below it, (4, 2) m; width, height and area, (3,);
        their sigmas.
    """
    (first, last), half = toes[:, 0], CROWN * (toes[1, 0] - toes[0, 0])
    inside = (u > first) & (u < last)
    crown = float(u[inside][np.argmax(median_filter(w[inside], inside.sum() // 5))])
    grid = np.linspace(-half, half, 241)
    for _ in range(2):
        crown = float(np.clip(crown, first + half, last - half))
        near, below = np.abs(u - crown) < half, plates.at(crown + grid)
        curve, covariance, sigma = _fit(_powers(u[near] - crown, 5), (w + plates.at(u))[near])
        over = _powers(grid, 5) @ curve - below + toe_m
        at = grid[np.argmax(over) : np.argmax(over) + 1]
        crown, top = crown + float(at[0]), _powers(at, 5)[0]
    place = np.concatenate([[first], u[inside], [last]])
    height = np.concatenate([[0.0], w[inside], [0.0]]) + toe_m
    step = np.diff(place)
    pitch, weight = float(np.median(step)), 0.5 * (step[:-1] + step[1:])
    area, hidden = float(0.5 * (height[:-1] + height[1:]) @ step), 0.0
    for k in np.flatnonzero(step > WIDE_GAP * pitch):  # the chord over it is not the curve
        beside = np.argsort(np.abs(place - 0.5 * (place[k] + place[k + 1])))[:GAP_SAMPLES]
        (_, _, bend), C, _ = _fit(_powers(place[beside] - place[k], 3), height[beside], sigma)
        cubed = 1e6 * step[k] ** 3 / 6.0
        area -= bend * cubed
        hidden += (C[2, 2] + (bend / 3.0) ** 2) * cubed**2
    ends = plates.rows(toes[:, 0]) / toes[:, 1:2]
    by = np.array([ends.sum(axis=0), plates.rows(np.array([crown]))[0], weight @ plates.rows(u[inside])])
    own = [((toes[:, 2] / toes[:, 1]) ** 2).sum() + pitch**2 / 24.0, top @ covariance @ top]
    own.append(sigma**2 * (weight @ weight) + hidden)
    points = np.array([[first, toe_m], [last, toe_m], [crown, over.max()], [crown, 0.0]])
    variance = plates.shared * (np.einsum("ki,ij,kj->k", by, plates.covariance, by) + own)
    return points, np.array([last - first, over.max(), area]), np.sqrt(variance)
