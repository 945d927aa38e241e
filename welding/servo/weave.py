"""Computes the weave: the torch oscillates across the seam with a dwell at each side, and the tip keeps its path."""

import math
from dataclasses import dataclass

from weldcal.models.errors import InputError


class WeaveError(InputError):
    """A weave with invalid settings."""


@dataclass(frozen=True)
class WeaveConfig:
    """Settings of the weave.

    Attributes:
        amplitude_m: to each side; 0 for a stringer bead. frequency_hz: swings a second, the rests not counted.
        dwell_left_s, dwell_right_s: rest at each side.
    """

    amplitude_m: float = 0.0
    frequency_hz: float = 1.0
    dwell_left_s: float = 0.0
    dwell_right_s: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.amplitude_m, self.frequency_hz, self.dwell_left_s, self.dwell_right_s)
        if not all(math.isfinite(v) and v >= 0.0 for v in numbers) or self.frequency_hz == 0.0:
            raise WeaveError("A weave needs a frequency above zero, and an amplitude and dwell of zero or more.")
        if self.amplitude_m > 8.0e-3 or self.frequency_hz > 5.0:
            raise WeaveError("A weave may swing by 8 mm and 5 times a second at most.")

    @property
    def peak_speed_m_s(self) -> float:
        """The torch's largest speed across the seam."""
        return 2.0 * math.pi * self.frequency_hz * self.amplitude_m


def weave_at(config: WeaveConfig, since: float) -> tuple[float, float]:
    """(offset to the left m, its rate m/s) so many seconds after the arc was lit; it grows over the first swing."""
    if config.amplitude_m == 0.0 or since <= 0.0:
        return 0.0, 0.0
    half = 0.5 / config.frequency_hz
    period = 2.0 * half + config.dwell_left_s + config.dwell_right_s
    # A swing starts in the middle, towards the left side.
    t = (since + 0.5 * half) % period
    slope = math.pi / half
    if t < half:
        wave, rate = -math.cos(slope * t), slope * math.sin(slope * t)
    elif t < half + config.dwell_left_s:
        wave, rate = 1.0, 0.0
    elif t < 2.0 * half + config.dwell_left_s:
        t -= half + config.dwell_left_s
        wave, rate = math.cos(slope * t), -slope * math.sin(slope * t)
    else:
        wave, rate = -1.0, 0.0
    share = min(1.0, since * config.frequency_hz)
    growth = config.frequency_hz if share < 1.0 else 0.0
    return config.amplitude_m * share * wave, config.amplitude_m * (share * rate + growth * wave)
