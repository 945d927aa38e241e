"""Compute the weave: where the torch is beside its seam at a time, and the largest frequency that limits allow."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from weldcal.models.errors import InputError
from weldcal.welding.numerics import clip

SHAPES = {"sine": (0.5, 0.0), "triangle": (0.2, 0.0), "trapezoid": (0.2, 1.0 / 3.0), "crescent": (0.5, 0.0)}
"""Of each shape: share of a crossing in which it gains its speed, and again loses it; share of a swing at rest.

A choice: 0.5 makes a sine; at 0.2 the middle 60 % of a crossing are straight, and the jerk stays finite.
"""
LARGEST_M, LARGEST_HZ = 8.0e-3, 5.0  # a choice: beyond what arc weaving uses
BOW_SHARE = 0.25  # a choice: of the amplitude, how far a crescent lags at its sides
WEAVE_SHARE = 0.7  # a choice: of each limit, what the weave may use; the rest is for the path itself
_LEARNT_PER_SWING = 0.7  # a choice: two swings remove three quarters of an error
_MOST_LATE_S, _MOST_GAIN = 0.1, 0.25  # a choice: twice what an arm of 50 ms lag shows at 2 Hz


class WeaveError(InputError):
    """A weave with invalid settings, or one that the limits do not allow."""


class Swing(NamedTuple):
    """The torch beside its seam's point: to the side in the weave's plane and ahead along the seam, m; rates, m/s."""

    side: float = 0.0
    side_rate: float = 0.0
    ahead: float = 0.0
    ahead_rate: float = 0.0


class Bound(NamedTuple):
    """A limit of what grows with a power of the frequency: 1 speed, 2 acceleration, 3 jerk."""

    power: int
    needed: float
    allowed: float


@dataclass(frozen=True, kw_only=True)
class WeaveConfig:
    """Settings of the weave.

    Attributes:
        shape: one of SHAPES; a crescent is a sine whose sides lag behind its middle.
        amplitude_m: to each side; 0 for a stringer bead.
        frequency_hz: swings a second, the dwells not counted.
        dwell_left_s, dwell_right_s: rest at each side.
        bow_m: how far a crescent's sides lag behind its middle; negative: they lead; None: BOW_SHARE of the amplitude.
        plane_rad: tilt of the weave's plane about the seam; positive: the left side is higher.
    """

    shape: str = "sine"
    amplitude_m: float = 0.0
    frequency_hz: float = 1.0
    dwell_left_s: float = 0.0
    dwell_right_s: float = 0.0
    bow_m: float | None = None
    plane_rad: float = 0.0

    def __post_init__(self) -> None:
        if self.shape not in SHAPES:
            raise WeaveError(f"The weave's shape must be {', '.join(SHAPES)}, not '{self.shape}'.")
        numbers = (self.amplitude_m, self.frequency_hz, self.dwell_left_s, self.dwell_right_s)
        if not all(math.isfinite(v) and v >= 0.0 for v in numbers) or self.frequency_hz == 0.0:
            raise WeaveError("A weave needs a frequency above zero, and an amplitude and dwell of zero or more.")
        if self.amplitude_m > LARGEST_M or self.frequency_hz > LARGEST_HZ:
            raise WeaveError(f"A weave may swing by {1e3 * LARGEST_M:g} mm and {LARGEST_HZ:g} times a second at most.")
        if not (abs(self.plane_rad) <= 0.5 * math.pi and abs(self.lag_m) <= self.amplitude_m):
            raise WeaveError("A weave's plane tilts by 90 deg and its bow is as large as its amplitude at most.")

    @property
    def period_s(self) -> float:
        """Time of a swing to both sides, with its dwells."""
        return 1.0 / self.frequency_hz + self.dwell_left_s + self.dwell_right_s

    @property
    def lag_m(self) -> float:
        """How far the sides lag behind the middle; 0 for all shapes but the crescent."""
        if self.shape != "crescent":
            return 0.0
        return BOW_SHARE * self.amplitude_m if self.bow_m is None else self.bow_m

    @property
    def _crossing_s(self) -> float:
        return 0.5 * (1.0 - SHAPES[self.shape][1]) / self.frequency_hz

    @property
    def side_peaks(self) -> tuple[float, float, float]:
        """The torch's largest speed, acceleration and jerk to the side, m/s, m/s^2 and m/s^3."""
        blend, unit = SHAPES[self.shape][0], 1.0 / self._crossing_s
        turn = 0.5 * math.pi / blend * unit
        speed = self.amplitude_m * _top_rate(blend) * unit
        return speed, speed * turn, speed * turn**2

    @property
    def ahead_peaks(self) -> tuple[float, float, float]:
        """The same along the seam; the square of a cosine has twice its frequency."""
        turn = 2.0 * math.pi * self.frequency_hz
        speed = abs(self.lag_m) * turn
        return speed, speed * 2.0 * turn, speed * 4.0 * turn**2

    @property
    def peak_speed_m_s(self) -> float:
        """The torch's largest speed to the side."""
        return self.side_peaks[0]


def _top_rate(blend: float) -> float:
    """Rate in the middle of a crossing from -1 to 1 in unit time, whose rate grows and falls as a quarter sine."""
    return 2.0 / (1.0 - 2.0 * blend + 4.0 * blend / math.pi)


def _crossing(u: float, blend: float) -> tuple[float, float]:
    """(place, rate) at u (0..1) of a crossing from -1 to 1 in unit time."""
    if u > 0.5:
        place, rate = _crossing(1.0 - u, blend)
        return -place, rate
    top = _top_rate(blend)
    if u >= blend:
        return top * (u - 0.5), top
    angle = 0.5 * math.pi * u / blend
    return -1.0 + top * blend * 2.0 / math.pi * (1.0 - math.cos(angle)), top * math.sin(angle)


def weave_at(config: WeaveConfig, since: float) -> Swing:
    """The weave so many seconds after the arc was lit; it grows over the first swing."""
    if config.amplitude_m == 0.0 or since <= 0.0:
        return Swing()
    blend, rest = SHAPES[config.shape]
    crossing, half = config._crossing_s, 0.5 / config.frequency_hz
    back = crossing + rest * half + config.dwell_left_s
    # A swing starts in the middle, towards the left side.
    t = (since + 0.5 * crossing) % config.period_s
    if t < crossing:
        wave, rate = _crossing(t / crossing, blend)
    elif back <= t < back + crossing:
        wave, rate = (-v for v in _crossing((t - back) / crossing, blend))
    else:
        wave, rate = math.copysign(1.0, back - t), 0.0
    share = min(1.0, since / config.period_s)
    growth = 1.0 / config.period_s if share < 1.0 else 0.0
    wave, rate = share * wave, share * rate / crossing + growth * wave
    lag = config.lag_m
    return Swing(config.amplitude_m * wave, config.amplitude_m * rate, -lag * wave**2, -2.0 * lag * wave * rate)


def tool_bounds(
    config: WeaveConfig, chord_m: float, yaw_rad_s: float, pitch_rad_s: float, weld_speed_m_s: float
) -> list[Bound]:
    """Limits of the tool: turning about its axis, pitching, and a torch and tip that never go back along the seam."""
    speed = config.peak_speed_m_s
    c, s = math.cos(config.plane_rad), abs(math.sin(config.plane_rad))
    return [
        Bound(1, speed * c, WEAVE_SHARE * yaw_rad_s * chord_m),
        Bound(1, speed * s, WEAVE_SHARE * pitch_rad_s * chord_m),
        Bound(1, config.ahead_peaks[0], WEAVE_SHARE * weld_speed_m_s),
    ]


def largest_frequency_hz(config: WeaveConfig, bounds: Iterable[Bound]) -> float:
    """The largest frequency at this amplitude that every bound allows, rounded down to 0.01 Hz."""
    ratios = [math.pow(b.allowed / b.needed, 1.0 / b.power) for b in bounds if b.needed > 0.0]
    most = min([config.frequency_hz * ratio for ratio in ratios] + [LARGEST_HZ])
    return math.floor(100.0 * most + 1e-9) / 100.0


def check_weave(config: WeaveConfig, bounds: Iterable[Bound]) -> None:
    """Check a weave against limits of tool and arm.

    Raises:
        WeaveError: it needs more, with the largest frequency at this amplitude.
    """
    bounds = list(bounds)
    # 1e-6: the largest frequency itself, after its rounding, is accepted
    if all(b.needed <= b.allowed * (1.0 + 1e-6) for b in bounds):
        return
    raise WeaveError(
        f"A {config.shape} weave of {1e3 * config.amplitude_m:g} mm at {config.frequency_hz:g} Hz is more than tool and"
        f" arm can do: set frequency_hz to {largest_frequency_hz(config, bounds):g} at most, or lower amplitude_mm."
    )


class Learnt(NamedTuple):
    """What the servo has learnt of the arm's answer to the weave: by how much it is late, s, and smaller, a share."""

    late_s: float = 0.0
    loss: float = 0.0


def learn(learnt: Learnt, config: WeaveConfig, wanted: Swing, off_m: float, dt: float) -> Learnt:
    """Follow the arm's delay and gain at the weave, so that the feedback of the torch's error does not change it.

    Args:
        wanted: the swing that is expected now; off_m: the torch off it, to the side.
        dt: tick in s.

    Source: least mean squares (Widrow and Stearns, Adaptive Signal Processing, 1985), normalised.
    """
    step = _LEARNT_PER_SWING / config.period_s * dt * off_m
    speed = config.peak_speed_m_s
    return Learnt(
        clip(learnt.late_s - 2.0 * step * wanted.side_rate / speed**2, -_MOST_LATE_S, _MOST_LATE_S),
        clip(learnt.loss - 2.0 * step * wanted.side / config.amplitude_m**2, -_MOST_GAIN, _MOST_GAIN),
    )
