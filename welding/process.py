"""What the weld was: where the arc burned, how fast the torch went, and how far its path lay off the true seam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weldcal.models.errors import InputError
from weldcal.welding.seam import SeamCurve
from weldcal.welding.vectors import Array

_BAND = 0.25  # a travel speed beyond +-25 % is commonly taken as another welding procedure


class ProcessLogError(InputError):
    """A weld log that cannot be evaluated."""


@dataclass(frozen=True)
class TorchEvent:
    """The arc going on or off at a time s and a seam arc length m."""

    time: float
    on: bool
    s: float


@dataclass(frozen=True)
class PathError:
    """Per sample: arc length on the true seam m, offset to its left m, offset along its up m."""

    s: Array
    lateral: Array
    height: Array

    @property
    def mean_m(self) -> float:
        """Mean unsigned lateral error, m."""
        return float(np.mean(np.abs(self.lateral)))

    @property
    def max_m(self) -> float:
        """Largest unsigned lateral error, m."""
        return float(np.max(np.abs(self.lateral)))


@dataclass(frozen=True)
class SpeedStatistics:
    """Torch speed over arc length.

    Attributes:
        mean, least, most: m/s; cv: standard deviation over mean, by arc length.
        outside_m: length of weld at a speed outside +-25 % of the wanted one.
        welded_m: length welded; seconds: time it took.
    """

    mean: float
    least: float
    most: float
    cv: float
    outside_m: float
    welded_m: float
    seconds: float


def path_error(p_B: ArrayLike, seam: SeamCurve) -> PathError:
    """How far each point lies off the true line, in the seam's own frame.

    Args:
        p_B: (N,3) m, in order of travel.
        seam: the line they should be on, in the same frame.

    Raises:
        ProcessLogError: no points, or not (N,3).
    """
    p = np.asarray(p_B, dtype=float)
    if p.ndim != 2 or p.shape[1] != 3 or not len(p):
        raise ProcessLogError(f"A path needs an (N, 3) array of points in metres; this one has shape {p.shape}.")
    s = np.empty(len(p))
    s[0] = float(seam.project(p[0]))
    for i in range(1, len(p)):
        s[i] = seam.nearest(p[i], s[i - 1])
    gap = p - seam.position(s)
    return PathError(s, np.sum(gap * seam.normal(s), axis=1), np.sum(gap * seam.up(s), axis=1))


def torch_events(time: ArrayLike, torch_on: ArrayLike, s: ArrayLike) -> tuple[TorchEvent, ...]:
    """Every change of the arc, from (N,) times, flags and seam arc lengths. The arc is off before the first."""
    t, on, arc = np.asarray(time, dtype=float), np.asarray(torch_on, dtype=bool), np.asarray(s, dtype=float)
    before = np.concatenate([[False], on[:-1]])
    return tuple(TorchEvent(float(t[i]), bool(on[i]), float(arc[i])) for i in np.flatnonzero(on != before))


def speed_statistics(
    time: ArrayLike, p_B: ArrayLike, torch_on: ArrayLike, weld_speed: float, window_s: float = 0.05
) -> SpeedStatistics:
    """Torch speed statistics where the arc burned.

    Args:
        time: (N,) s; p_B: (N,3) torch point m; torch_on: (N,) flags.
        weld_speed: the wanted speed, m/s.
        window_s: a speed is the path over this time, so that a robot's noise is not taken for speed.

    Raises:
        ProcessLogError: the lengths differ, or the arc burned for less than three windows.
    """
    t, p = np.asarray(time, dtype=float), np.asarray(p_B, dtype=float)
    on: NDArray[np.bool_] = np.asarray(torch_on, dtype=bool)
    if not len(t) == len(p) == len(on):
        raise ProcessLogError("Times, torch points and arc flags must have the same length.")
    if on.sum() < 2:
        raise ProcessLogError("The arc never burned: there is no weld to evaluate.")
    t_on, p_on = t[on], p[on]
    if t_on[-1] - t_on[0] < 3.0 * window_s:
        raise ProcessLogError("The arc burned too briefly to speak of a speed.")
    # Evenly in time first; then each stretch counts by its length, as metal does.
    even = np.arange(t_on[0], t_on[-1], window_s)
    q = np.column_stack([np.interp(even, t_on, p_on[:, k]) for k in range(3)])
    lengths = np.linalg.norm(np.diff(q, axis=0), axis=1)
    speed = lengths / window_s
    total = max(float(lengths.sum()), 1e-12)
    mean = float((speed * lengths).sum() / total)
    spread = float(np.sqrt(((speed - mean) ** 2 * lengths).sum() / total))
    outside = float(lengths[np.abs(speed / weld_speed - 1.0) > _BAND].sum())
    return SpeedStatistics(
        mean, float(speed.min()), float(speed.max()), spread / mean, outside, total, float(t_on[-1] - t_on[0])
    )
