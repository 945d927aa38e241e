"""Chooses the clock that orders the frames in time: the device's own where it runs evenly, else the arrivals."""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.data.scanner_clock import ARRIVAL, DEVICE
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.models.arrays import Array

_MOST_LACKING = 0.2  # of the frames may have no device time; those are left out then
_APART_S = 1.0  # a device time that deviates so far from the arrivals' straight line is of a clock that was reset
_MOST_DRIFT = 1e-2  # a choice: a hundred times what crystals are off (100 ppm); beyond, the unit is not seconds


@dataclass(frozen=True, eq=False)
class FrameClock:
    """Times of the frames by one clock: ``base`` (N,) s near the robot's time, NaN where a frame has none.

    A frame's nominal capture time is base + sign * offset (+ drift * (base - reference)). ``shift`` s was added to the
    clock's own times. ``reason`` says why the clock was chosen.
    """

    kind: str
    base: Array
    sign: float
    shift: float
    reference: float
    reason: str

    def nominal(self, offset: float, drift: float = 0.0) -> Array:
        """Nominal capture times (N,) s on the robot's clock."""
        return np.asarray(self.base + self.sign * offset + drift * (self.base - self.reference))


def arrival_clock(frames: ObservedFrames, reason: str = "The frames have no device times.") -> FrameClock:
    """The frames ordered by their arrivals."""
    return FrameClock(ARRIVAL, frames.arrival, -1.0, 0.0, float(np.median(frames.arrival)), reason)


def choose_clock(frames: ObservedFrames) -> FrameClock:
    """The device's clock where it runs evenly beside the arrivals; else the arrivals, with the reason."""
    if frames.device is None or not np.isfinite(frames.device).any():
        return arrival_clock(frames)
    has = np.isfinite(frames.device)
    if has.mean() < 1.0 - _MOST_LACKING:
        return arrival_clock(frames, f"Only {int(has.sum())} of {len(has)} frames have a device time.")
    device, arrival = frames.device[has], frames.arrival[has]
    if len(device) < 3 or np.ptp(device) <= 0.0:
        return arrival_clock(frames, "The device times do not advance.")
    middle = float(np.median(device))
    # arrivals are late by a skewed law: medians of differences, not least squares
    half = len(device) // 2
    apart = device[half:] - device[: len(device) - half]
    rate = float(np.median(((arrival[half:] - arrival[: len(arrival) - half])[apart > 0.0]) / apart[apart > 0.0]))
    if not abs(rate - 1.0) < _MOST_DRIFT:
        return arrival_clock(
            frames,
            f"The device times advance {rate:.3g} times as slowly as the robot's; they are not in seconds or not of the"
            " frames.",
        )
    late = arrival - device
    shift = float(np.median(late))
    if float(np.percentile(np.abs(late - shift), 99.0)) > _APART_S:
        return arrival_clock(frames, "The device's clock was set anew while it recorded.")
    return FrameClock(DEVICE, frames.device + shift, 1.0, shift, middle + shift, "The frames have device times.")
