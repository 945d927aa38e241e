"""Statistics of a torch's speed where its arc burned, by arc length."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weldcal.welding.record.process import ProcessLogError

_BAND = 0.25  # a travel speed beyond +-25 % is commonly taken as another welding procedure


@dataclass(frozen=True, kw_only=True)
class SpeedStatistics:
    """Statistics of the torch speed over arc length.

    Attributes:
        mean, least, most: m/s; cv: standard deviation over mean, by arc length; 0 where the torch stood still.
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


def speed_statistics(
    time: ArrayLike, p_B: ArrayLike, torch_on: ArrayLike, weld_speed: float, window_s: float = 0.05
) -> SpeedStatistics:
    """Torch speed statistics where the arc burned.

    Args:
        time: (N,) s; p_B: (N,3) torch point m; torch_on: (N,) flags.
        weld_speed: the wanted speed, m/s.
        window_s: a speed is the path over this time, which suppresses the robot's noise.

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
        raise ProcessLogError("The arc burned too briefly to compute a speed.")
    # Sampled evenly in time first; then each stretch is weighted by its length, as the metal deposited is.
    even = np.arange(t_on[0], t_on[-1], window_s)
    q = np.column_stack([np.interp(even, t_on, p_on[:, k]) for k in range(3)])
    lengths = np.linalg.norm(np.diff(q, axis=0), axis=1)
    speed = lengths / window_s
    total = max(float(lengths.sum()), 1e-12)
    mean = float((speed * lengths).sum() / total)
    spread = float(np.sqrt(((speed - mean) ** 2 * lengths).sum() / total))
    outside = float(lengths[np.abs(speed / weld_speed - 1.0) > _BAND].sum())
    return SpeedStatistics(
        mean=mean,
        least=float(speed.min()),
        most=float(speed.max()),
        cv=spread / mean if mean else 0.0,
        outside_m=outside,
        welded_m=total,
        seconds=float(t_on[-1] - t_on[0]),
    )
