"""Lift the tip over tacks: where it leaves the seam before them and comes down after them, and how high it hangs."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array

CLEAR_M = 1e-3  # a choice: between the ball and a tack's top, above the error of a height by eye
BESIDE_M = 3e-3  # a choice: before and after a tack, above what a plan is off along its seam
LIFT_M_S = 15e-3  # a choice: largest speed up and down; with a chord of 60 mm the tool pitches by 14 deg/s
GENTLE_M_S = 8e-3  # a choice: largest speed where there is room: joints of different lag put the torch off by the speed
SLEW_M_S2 = 0.1  # a choice: 9 mm in 0.9 s need 0.07
SETTLING_S = 0.6  # a choice: until the ball is pressed in again, as it takes in simulation
FELT_AFTER_M = 10e-3  # a choice: of points beyond the gap, which give the path its direction there
_PEAK = 1.5  # largest over mean slope of a cubic step
HIGHEST_M = 8e-3  # a choice: the tool pitches by it; a higher one is a bead of its own


class TackError(InputError):
    """A tack that the tip cannot pass."""


@dataclass(frozen=True)
class Tack:
    """Where a tack lies along the seam, m, and how far its top would lift the seated ball, m."""

    start: float
    end: float
    lift: float


class Hop(NamedTuple):
    """A lift of the tip over a tack, or over several near ones.

    Arc lengths m at which it begins, is up, begins to come down, and is down; and the height m over its seat.
    """

    begin: float
    up: float
    down: float
    end: float
    height: float

    def place(self, s: float, before: Array, after: Array) -> tuple[Array, Array]:
        """Place (2,) m of the tip's rest to the left of its seat and above it at an arc length, and its slope.

        Args:
            before, after: (2,) m, where it was pressed, and where it comes down.
        """
        low, way, length = before, s - self.begin, self.up - self.begin
        if s >= self.down:
            low, way, length = after, self.end - s, self.down - self.end
        x = min(max(way / abs(length), 0.0), 1.0)
        rise = np.array((0.0, self.height)) - low
        return low + rise * x * x * (3.0 - 2.0 * x), rise * 6.0 * x * (1.0 - x) / length


def hops(
    tacks: tuple[Tack, ...], speed_m_s: float, pressed_m: float, chord_m: float = 0.0, touch_m: float = 0.0
) -> tuple[Hop, ...]:
    """The lifts over tacks at a speed of the tip along the seam.

    Args:
        pressed_m: the tip's rest below its seat.
        chord_m, touch_m: from torch to tip, and where the tip comes down; where they leave room a lift is slower.
    """
    found: list[Hop] = []
    for tack in sorted(tacks, key=lambda t: t.start):
        height = tack.lift + CLEAR_M
        ramp = _PEAK * (height + pressed_m) / LIFT_M_S * speed_m_s
        up, down = tack.start - BESIDE_M, tack.end + BESIDE_M
        hop = Hop(up - ramp, up, down, down + ramp, height)
        if found and hop.begin < found[-1].end + ramp:  # no room to feel between them
            last = found.pop()
            top = max(last.height, height)
            hop = Hop(min(last.begin, hop.begin), last.up, hop.down, max(last.end, hop.end), top)
        found.append(hop)
    felt = SETTLING_S * speed_m_s + FELT_AFTER_M
    free = [
        *(2.0 * (hop.begin - touch_m) for hop in found[:1]),
        *(b.begin - a.end - felt for a, b in pairwise(found)),
        math.inf,
    ]
    slower = LIFT_M_S / GENTLE_M_S - 1.0
    for k, hop in enumerate(found):
        wanted = slower * (hop.up - hop.begin), slower * (hop.end - hop.down)
        room = chord_m - felt - (hop.end - hop.begin)
        before, after = (max(0.0, min(w, 0.5 * room, 0.5 * f)) for w, f in zip(wanted, free[k : k + 2], strict=True))
        found[k] = hop._replace(begin=hop.begin - before, end=hop.end + after)
    return tuple(found)


def check_tacks(
    tacks: tuple[Tack, ...], found: tuple[Hop, ...], touch_m: float, chord_m: float, speed_m_s: float
) -> None:
    """Check tacks: the tip feels the seam before it leaves it, and again before the torch is there.

    Raises:
        TackError: it names the tack.
    """
    for tack in tacks:
        if not (all(map(math.isfinite, (tack.start, tack.end, tack.lift))) and 0.0 <= tack.start < tack.end):
            raise TackError("A tack needs a start and an end along the seam, the end beyond the start.")
        if tack.lift > HIGHEST_M:
            raise TackError(
                f"The tack at {1e3 * tack.start:g} mm would lift the tip by {1e3 * tack.lift:.1f} mm, and it can be"
                f" lifted by {1e3 * HIGHEST_M:g} mm: grind it."
            )
    for hop in found:
        unfelt_m = hop.end - hop.begin + SETTLING_S * speed_m_s + FELT_AFTER_M
        if unfelt_m > chord_m + 1e-9:
            raise TackError(
                f"About the tack at {1e3 * (hop.up + BESIDE_M):g} mm the tip feels nothing for"
                f" {1e3 * unfelt_m:.0f} mm, and the torch is {1e3 * chord_m:.0f} mm behind it:"
                " weld slower, or grind it."
            )
    if found and found[0].begin < touch_m:
        short = touch_m - found[0].begin
        raise TackError(
            f"The tip comes down at {1e3 * touch_m:g} mm and must leave the seam {1e3 * short:.0f} mm before that, for"
            f" the tack at {1e3 * min(t.start for t in tacks):g} mm: start the seam elsewhere, or weld slower."
        )
