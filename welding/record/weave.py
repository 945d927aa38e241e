"""Measure a weave from the torch's path: its swings, and the path in their middle."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from weldcal.welding.numerics import Array
from weldcal.welding.record.process import PathError

SETTLED_PERIODS = 1.5  # a choice: the weave grows over the first, and the servo learns the arm's lag
_MIDDLE_PERIODS = 4.0  # a choice: between the knots of the swings' middle; the wave means out over as many
_HALF_WAY = 0.5  # a choice: of the amplitude, on both sides of which a crossing counts


@dataclass(frozen=True, kw_only=True)
class MeasuredWeave:
    """What the torch did.

    Attributes:
        amplitude_m: mean half distance of its sides.
        period_s: of a swing to both sides, with its dwells; swings: how many whole ones are measured.
        bow_m: how far the sides lag behind the middle along the seam.
    """

    amplitude_m: float
    period_s: float
    swings: int
    bow_m: float


def measure_weave(time: Array, error: PathError, period_s: float, plane_rad: float) -> MeasuredWeave | None:
    """Measure the weave of a torch by its places beside the seam; None where fewer than two swings have settled.

    Args:
        time: (N,) s of the places, from when the arc was lit.
        period_s: ordered period; plane_rad: tilt of the weave's plane, left side up.
    """
    rows = time - time[0] >= SETTLED_PERIODS * period_s
    if rows.sum() < 8:
        return None
    t, s = time[rows], error.s[rows]
    side = math.cos(plane_rad) * error.lateral[rows] + math.sin(plane_rad) * error.height[rows]
    side = side - _middle(t, side, period_s)
    side = side - 0.5 * (side.max() + side.min())  # a dwell on one side moves the mean
    starts = _rising(t, side)
    if len(starts) < 3:
        return None
    swings = len(starts) - 1
    cut = np.searchsorted(t, starts)
    low, high = (np.array([f(side[a:b]) for a, b in pairwise(cut)]) for f in (np.min, np.max))
    amplitude = 0.5 * float((high - low).mean())
    whole = slice(int(cut[0]), int(cut[-1]))
    wave = side[whole] / amplitude
    A = np.column_stack([wave**2, t[whole], np.ones(len(wave))])
    bow = -float(np.linalg.lstsq(A, s[whole], rcond=None)[0][0])
    period = float(starts[-1] - starts[0]) / swings
    return MeasuredWeave(amplitude_m=amplitude, period_s=period, swings=swings, bow_m=bow)


def _middle(t: Array, side: Array, period_s: float) -> Array:
    """The middle (N,) of the swings: the torch follows the felt seam, which leaves the planned line under the arc."""
    knots = np.linspace(t[0], t[-1], 2 + int(np.ptp(t) / (_MIDDLE_PERIODS * period_s)))
    hats = np.column_stack([np.interp(t, knots, hat) for hat in np.eye(len(knots))])
    phase = 2.0 * np.pi / period_s * np.outer(t, (1, 2, 3))
    A = np.column_stack([hats, np.sin(phase), np.cos(phase)])
    return np.asarray(hats @ np.linalg.lstsq(A, side, rcond=None)[0][: len(knots)])


def _rising(t: Array, side: Array) -> Array:
    """Times at which a wave about zero comes from its low to its high half, through zero."""
    half, found, low = _HALF_WAY * np.abs(side).max(), [], False
    crossing = math.nan
    for k in range(1, len(side)):
        if side[k - 1] < 0.0 <= side[k]:
            crossing = float(t[k - 1] - side[k - 1] * (t[k] - t[k - 1]) / (side[k] - side[k - 1]))
        low = low or side[k] < -half
        if low and side[k] > half:
            found.append(crossing)
            low = False
    return np.array(found)
