"""The scanner's clock as a calibration found it: when a frame was taken, from its arrival or its device time."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from weldcal.models.documents import as_number
from weldcal.models.errors import InputError

ARRIVAL, DEVICE = "arrival", "device"
_NUMBERS = ("offset_s", "sigma_s", "jitter_s", "reference_s", "drift", "drift_sigma", "rolling_s", "rolling_sigma_s")


@dataclass(frozen=True, kw_only=True)
class ScannerClock:
    """When a frame was taken, on the robot's clock, s.

    ``kind`` arrival: capture = arrival - offset. ``kind`` device: capture = device + offset + drift (device -
    reference). ``offset_s`` is the mean over frames, ``sigma_s`` its standard deviation, both None where the motion
    does not show them. ``jitter_s`` the standard deviation of single frames about it. ``reference_s`` the clock's time
    that the offset holds for. ``drift`` and ``drift_sigma`` s/s (None for arrivals). ``rolling_s``: an image row y/z is
    exposed so much later per unit (None where the data do not show it). ``late``: ids of frames left out of the offset
    as grossly late or early; ``reason``: why this clock.
    """

    kind: str
    offset_s: float | None
    sigma_s: float | None
    jitter_s: float | None
    reference_s: float
    drift: float | None = None
    drift_sigma: float | None = None
    rolling_s: float | None = None
    rolling_sigma_s: float | None = None
    late: tuple[str, ...] = ()
    reason: str = ""

    def capture(self, arrival: float, device: float | None = None, row: float = 0.0) -> float | None:
        """Capture time (s) of a frame on the robot's clock, expected from its times.

        ``row`` is y/z of what is looked at. None where the offset is not known, or the frame lacks the clock's time.
        """
        if self.offset_s is None or (self.kind == DEVICE and device is None):
            return None
        rolled = (self.rolling_s or 0.0) * row
        if self.kind == DEVICE:
            assert device is not None
            return device + self.offset_s + (self.drift or 0.0) * (device - self.reference_s) + rolled
        return arrival - self.offset_s + rolled

    def document(self) -> dict[str, Any]:
        """Plain values for a file."""
        return {**asdict(self), "late": list(self.late)}


def clock_from_document(value: Any, file: str) -> ScannerClock | None:
    """Return the clock of a calibration.yaml; None without one. Raises InputError naming the key."""
    if value is None:
        return None
    if not isinstance(value, Mapping) or value.get("kind") not in (ARRIVAL, DEVICE):
        raise InputError(f"'{file}': clock.kind must be {ARRIVAL} or {DEVICE}; the file was changed by hand.")
    numbers: dict[str, float | None] = {}
    for key in _NUMBERS:
        number = None if value.get(key) is None else as_number(value[key])
        if number is not None and not math.isfinite(number):
            raise InputError(f"'{file}': clock.{key} must be a finite number; the file was changed by hand.")
        numbers[key] = number
    reference = numbers.pop("reference_s")
    late = value.get("late") or []
    if not isinstance(late, list) or not all(isinstance(id, str) for id in late):
        raise InputError(f"'{file}': clock.late must be a list of ids; the file was changed by hand.")
    return ScannerClock(
        kind=str(value["kind"]),
        reference_s=reference or 0.0,
        late=tuple(late),
        reason=str(value.get("reason", "")),
        **numbers,
    )
