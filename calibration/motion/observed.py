"""Frames with the flange found in them, and the clock that orders them: the device's own, else the arrivals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.scanner_correction import ARRIVAL, DEVICE
from weldcal.models.arrays import Array

_MOST_LACKING = 0.2  # of the frames may have no device time; those are left out then
_APART_S = 1.0  # a device time that deviates so far from the arrivals' straight line is of a clock that was reset
_MOST_DRIFT = 1e-2  # a choice: a hundred times what crystals are off (100 ppm); beyond, the unit is not seconds


@dataclass(frozen=True, eq=False, kw_only=True)
class ObservedFrames:
    """N frames in the order of their arrival.

    ``arrival`` (N,) s on the robot's clock. ``device`` (N,) s on the scanner's own clock, NaN where a frame has none,
    or None. ``p_C`` (N, 3) m flange centre and ``n_C`` (N, 3) outward normal in the camera frame. ``covariance`` (N, 3,
    3) m^2 of the centre, ``normal_sigma`` (N,) rad an axis. ``slide`` (N, 3) m in the camera frame, or None: how a
    centre moves if the edges found lie one noise of the face below it (a rough face hides where its chamfer begins).
    """

    ids: tuple[str, ...]
    arrival: Array
    device: Array | None
    p_C: Array
    n_C: Array
    covariance: Array
    normal_sigma: Array
    slide: Array | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def pick(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> "ObservedFrames":
        """Some of the frames."""
        index = np.arange(len(self.ids))[which]
        return ObservedFrames(
            ids=tuple(self.ids[k] for k in index),
            arrival=self.arrival[index],
            device=None if self.device is None else self.device[index],
            p_C=self.p_C[index],
            n_C=self.n_C[index],
            covariance=self.covariance[index],
            normal_sigma=self.normal_sigma[index],
            slide=None if self.slide is None else self.slide[index],
        )


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
    """Return the frames ordered by their arrivals."""
    return FrameClock(ARRIVAL, frames.arrival, -1.0, 0.0, float(np.median(frames.arrival)), reason)


def choose_clock(frames: ObservedFrames) -> FrameClock:
    """Return the device's clock where it runs evenly beside the arrivals; else the arrivals, with the reason."""
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
