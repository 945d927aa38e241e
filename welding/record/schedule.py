"""Compute the set values of the power source along a weld: hot start, run and crater, and by the measured gap."""

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array, clip

VALUES = ("wire_feed_m_min", "voltage_V", "current_A")
"""What a power source is set to; of wire feed and current it takes the one that its mode has."""
LARGEST = {"wire_feed_m_min": 50.0, "voltage_V": 100.0, "current_A": 2000.0}  # a choice: beyond any arc welding source
LARGEST_GAP_MM = 10.0  # a choice: wider joints are not welded in one run
LONGEST_STAGE_S = 10.0  # a choice: as an arc that stands
LEAST_SIGMA_M = 1e-5  # of a gap: a hundredth of what any scan shows
SLOPE = 0.02  # a prior: 3 mm along 150 mm, beyond the gaps that are welded
SMOOTH_M = 0.020  # a choice: two windows of the fit-up; the gap of two plates changes more slowly
BEYOND_SIGMAS = 2.0  # a choice: of the gap's sigma, by which a gap may pass the table's last row


class ScheduleError(InputError):
    """A schedule with invalid values, or a gap that it has no row for."""


class SetValues(NamedTuple):
    """The set values of one moment: wire feed m/min, voltage V, current A; NaN where the schedule has none."""

    wire_feed_m_min: float = math.nan
    voltage_V: float = math.nan
    current_A: float = math.nan


@dataclass(kw_only=True)
class HotStart:
    """The values at the start, where the part is cold; those left out are the run's."""

    wire_feed_m_min: float | None = None
    voltage_V: float | None = None
    current_A: float | None = None
    time_s: float = 0.5  # from the established arc on
    ramp_s: float = 0.2  # then: to the run's values


@dataclass(kw_only=True)
class Crater:
    """The values at the seam's end, while the torch waits there for welding.arc.crater_s."""

    wire_feed_m_min: float | None = None
    voltage_V: float | None = None
    current_A: float | None = None
    ramp_s: float = 0.2  # from the run's values to these


@dataclass(kw_only=True)
class GapRow:
    """The run's values and the speed at one gap; between two rows they are interpolated."""

    gap_mm: float = 0.0
    wire_feed_m_min: float | None = None
    voltage_V: float | None = None
    current_A: float | None = None
    speed_mm_s: float | None = None  # null in all rows: welding.speed_mm_s


@dataclass(kw_only=True)
class WeldSchedule:
    """The set values of the power source along the weld."""

    job: int | None = None  # job, program or memory channel number of the power source
    wire_feed_m_min: float | None = None  # of the run, as voltage and current
    voltage_V: float | None = None
    current_A: float | None = None
    hot_start: HotStart | None = None
    crater: Crater | None = None
    by_gap: list[GapRow] = field(default_factory=list)  # by rising gap_mm, in place of the run's values

    def check(self, crater_s: float = 0.0) -> None:
        """Raise ScheduleError for values that cannot be used; `crater_s`: how long the torch waits at the end."""
        parts: dict[str, Any] = {"": self, "hot_start.": self.hot_start, "crater.": self.crater}
        parts |= {f"by_gap[{k}].": row for k, row in enumerate(self.by_gap)}
        for place, part in parts.items():
            for name in VALUES if part is not None else ():
                _check_value(f"{place}{name}", getattr(part, name), LARGEST[name])
        if self.job is not None and not 0 <= self.job <= 65535:
            raise ScheduleError(f"welding.schedule.job must be from 0 to 65535, not {self.job}.")
        for place, stage in (("hot_start", self.hot_start), ("crater", self.crater)):
            for name in ("time_s", "ramp_s"):
                if stage is not None and not 0.0 <= getattr(stage, name, 0.0) <= LONGEST_STAGE_S:
                    raise ScheduleError(f"welding.schedule.{place}.{name} must be from 0 to {LONGEST_STAGE_S:g}.")
        if self.crater is not None and crater_s < max(self.crater.ramp_s, 1e-3):
            raise ScheduleError(
                "welding.schedule.crater needs a torch that waits at the end at least as long as its ramp: raise"
                " welding.arc.crater_s."
            )
        self._check_rows()
        given = [n for n in VALUES if getattr(self, n) is not None or (self.by_gap and self._rows(n) is not None)]
        missing = [n for part in (self.hot_start, self.crater) if part for n in VALUES if getattr(part, n) is not None]
        for name in missing:
            if name not in given:
                raise ScheduleError(
                    f"welding.schedule.{name} is missing: hot start or crater has one, the run has none."
                )

    def _check_rows(self) -> None:
        rows = self.by_gap
        if not rows:
            return
        if len(rows) < 2 or rows[0].gap_mm < 0.0 or any(not a.gap_mm < b.gap_mm for a, b in pairwise(rows)):
            raise ScheduleError("welding.schedule.by_gap needs two rows or more, by rising gap_mm from 0 on.")
        if rows[-1].gap_mm > LARGEST_GAP_MM:
            raise ScheduleError(f"welding.schedule.by_gap ends at {LARGEST_GAP_MM:g} mm at most.")
        for name in (*VALUES, "speed_mm_s"):
            given = [getattr(row, name) is not None for row in rows]
            if any(given) and not all(given):
                raise ScheduleError(f"welding.schedule.by_gap: write {name} in all rows or in none.")
        for k, row in enumerate(rows):
            _check_value(f"by_gap[{k}].speed_mm_s", row.speed_mm_s, 500.0)
        if not any(getattr(rows[0], name) is not None for name in (*VALUES, "speed_mm_s")):
            raise ScheduleError("welding.schedule.by_gap: its rows have a gap and no value.")

    def _rows(self, name: str) -> list[float] | None:
        """The column of the table of this name; None where it has none."""
        found = [getattr(row, name) for row in self.by_gap]
        return None if not found or found[0] is None else found

    def _by_gap(self, name: str, gap_mm: float) -> float | None:
        column = self._rows(name)
        if column is None or not math.isfinite(gap_mm):
            return None
        return float(np.interp(gap_mm, [row.gap_mm for row in self.by_gap], column))

    def speeds_m_s(self) -> tuple[float, ...]:
        """The table's travel speeds, m/s."""
        return tuple(1e-3 * v for v in self._rows("speed_mm_s") or ())

    def speed_m_s(self, gap_m: float, otherwise: float) -> float:
        """The travel speed at a gap m, m/s; `otherwise` where the table has none."""
        found = self._by_gap("speed_mm_s", 1e3 * gap_m)
        return otherwise if found is None else 1e-3 * found

    def values(self, gap_m: float, arc_s: float = -1.0, crater_s: float = -1.0) -> SetValues:
        """The set values at a gap, at a time after the arc was established and after the torch came to the end.

        Args:
            gap_m: measured gap beside the torch, m; NaN: not known, and the run's own values hold.
            arc_s: since the arc was established, s; negative before, when the values are those of the hot start.
            crater_s: since the torch came to the seam's end, s; negative before.
        """
        return SetValues(*(self._value(name, 1e3 * gap_m, arc_s, crater_s) for name in VALUES))

    def _value(self, name: str, gap_mm: float, arc_s: float, crater_s: float) -> float:
        of_run = self._by_gap(name, gap_mm)
        of_run = getattr(self, name) if of_run is None else of_run
        if of_run is None:
            return math.nan
        value, hot, end = float(of_run), self.hot_start, self.crater
        of_hot = None if hot is None else getattr(hot, name)
        if hot is not None and of_hot is not None:
            value += (1.0 - _share(arc_s - hot.time_s, hot.ramp_s)) * (of_hot - value)
        of_end = None if end is None else getattr(end, name)
        if end is not None and of_end is not None and crater_s >= 0.0:
            value += _share(crater_s, end.ramp_s) * (of_end - value)
        return value

    def extremes(self, name: str) -> tuple[float, ...]:
        """All values that the schedule may set by this name of VALUES; the set value is never beyond them."""
        stages = (self, self.hot_start, self.crater, *self.by_gap)
        return tuple(float(v) for part in stages if part is not None and (v := getattr(part, name)) is not None)


def _share(since_s: float, ramp_s: float) -> float:
    """How much of a ramp is over, 0 to 1."""
    return float(since_s >= 0.0) if ramp_s <= 0.0 else clip(since_s / ramp_s, 0.0, 1.0)


def _check_value(key: str, value: float | None, most: float) -> None:
    if value is not None and not 0.0 < value <= most:
        raise ScheduleError(f"welding.schedule.{key} must be above 0 and at most {most:g}, not {value:g}.")


@dataclass(frozen=True, eq=False)
class GapAlong:
    """The gap along a planned seam, smoothed: places (N,) m, rising, and gaps (N,) m."""

    s_m: Array
    gap_m: Array

    def at(self, s_m: float) -> float:
        """The gap at a place, m; beyond the first and the last place theirs."""
        return float(np.interp(s_m, self.s_m, self.gap_m))


def gap_along(s_m: Array, gap_m: Array | None, sigma_m: Array | None, schedule: WeldSchedule) -> GapAlong:
    """The gap along a seam, for a schedule with a table by gap: lines fitted to the places around each.

    Args:
        s_m: (N,) places along the seam; gap_m, sigma_m: (N,) measured, NaN where the scan does not show it; None:
            nowhere.

    Raises:
        ScheduleError: the scan does not show the gap, or a gap is beyond the table's last row.
    """
    good = np.isfinite(gap_m) if gap_m is not None else np.zeros(len(s_m), dtype=bool)
    if gap_m is None or sigma_m is None or not good.any():
        raise ScheduleError(
            "The scan does not show the joint's gap, which welding.schedule.by_gap follows: scan it from another side,"
            " or remove by_gap."
        )
    last, s = 1e-3 * schedule.by_gap[-1].gap_mm, s_m[good]
    gap, sigma = _smoothed(s, gap_m[good], np.maximum(sigma_m[good], LEAST_SIGMA_M))
    over = gap - last - BEYOND_SIGMAS * sigma
    k = int(np.argmax(over))
    if over[k] > 0.0:
        raise ScheduleError(
            f"At {1e3 * s[k]:.0f} mm of the seam the gap is {1e3 * gap[k]:.2f} mm, and the last row of"
            f" welding.schedule.by_gap is for {1e3 * last:g} mm. Fit the parts anew, or add a row."
        )
    return GapAlong(s, np.maximum(gap, 0.0))


def _smoothed(s: Array, value: Array, sigma: Array) -> tuple[Array, Array]:
    """At each place the line that fits the values (N,) around it best, and its standard deviation (N,)."""
    found = []
    for at in s:
        weight = np.exp(-0.5 * ((s - at) / SMOOTH_M) ** 2) / sigma
        A = np.column_stack([np.ones(len(s)), s - at]) * weight[:, None]
        A = np.vstack([A, [0.0, 1.0 / SLOPE]])
        rows = np.linalg.pinv(A)[0, :-1] * weight  # of the value at this place
        found.append((rows @ value, np.linalg.norm(rows * sigma)))
    gap, spread = np.array(found).T
    return gap, spread
