"""What sensors by wire show before a job.

One scan, or the pictures of a second, and what to change where they do not.
"""

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.systems.drivers.sensors.acquisition import Acquisition, DeviceFault
from weldcal.systems.drivers.ur.readiness.preflight import Check

LOOK_S = 1.0  # a choice: a camera of 10 Hz shows 10 pictures; half of it makes RATE_SHARE a matter of one picture
START_S = 15.0  # a choice: ATTEMPTS of acquisition with their pauses; half of it fails a device that opens slowly
RATE_SHARE = 0.8  # of the scenario's rate that a camera must reach


@dataclass(frozen=True, eq=False)
class Sensed:
    """The checks of one sensor, and what it sent: a cloud (H, W, 3) or (N, 3) m, a picture (H, W), None."""

    checks: tuple[Check, ...]
    datum: NDArray[Any] | None = None
    summary: dict[str, object] = field(default_factory=dict)


def look_at_scanner(acquisition: Acquisition[Any], *, streams: bool, what: str = "scan") -> Sensed:
    """Take one scan (or profile), as a job does, and let the device go."""
    try:
        acquisition.start(START_S, first_frame=streams)
    except DeviceFault as error:
        return Sensed((Check(what, False, "does not answer", str(error)),))
    try:
        begin = time.monotonic()
        if streams:
            frame = acquisition.frames()[-1]
        else:
            acquisition.request(1)
            found = acquisition.wait_for_answer(1)
            if found is None:
                said = acquisition.fault(time.monotonic()) or f"{acquisition.name} sent nothing."
                return Sensed((Check(what, False, f"none within {time.monotonic() - begin:.1f} s", said),))
            frame = found
        points = frame.datum[..., -1]
        seen = int(np.isfinite(points).sum())
        words = f"{seen} points at {np.nanmedian(points):.3f} m, {time.monotonic() - begin:.1f} s after the trigger"
        words += f", time by {frame.stamp.clock}" + (f" ({frame.note})" if frame.note else "")
        return Sensed((Check(what, True, words),), frame.datum, acquisition.summary())
    finally:
        acquisition.close()


def look_at_camera(acquisition: Acquisition[Any], rate_hz: float) -> Sensed:
    """Take the pictures of one second and let the camera go."""
    try:
        acquisition.start(START_S, first_frame=True)
    except DeviceFault as error:
        return Sensed((Check("pictures", False, "none", str(error)),))
    try:
        before, begin = acquisition.counts.received, time.monotonic()
        time.sleep(LOOK_S)
        fault = acquisition.fault(time.monotonic())
        rate = (acquisition.counts.received - before) / (time.monotonic() - begin)
        frame, summary = acquisition.frames()[-1], acquisition.summary()
        latency = summary.get("latency_ms")
        words = f"{rate:.1f} per second, time by {frame.stamp.clock}"
        if isinstance(latency, dict):
            words += f", {latency['median']:.0f} ms old on arrival, {latency['worst']:.0f} ms at most"
        if fault is not None:
            return Sensed((Check("pictures", False, words, fault),), frame.datum, summary)
        slow = rate < RATE_SHARE * rate_hz
        action = (
            f"The scenario has {rate_hz:g} pictures per second: raise the camera's rate or lower finger_camera.rate_hz."
        )
        return Sensed((Check("pictures", not slow, words, action if slow else ""),), frame.datum, summary)
    finally:
        acquisition.close()
