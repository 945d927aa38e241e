"""Computes the row of a seam in the record of a part: arc values, travel speed, heat input, path, and its limits."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from weldcal.welding.numerics import Array
from weldcal.welding.record.order import RANGES, OrderLimits, WeldOrder
from weldcal.welding.record.weld_log import WeldRecord

STRETCH_M = 0.010  # a choice: two to three times the length of the pool, over which heat and speed act together
LEAST_ROWS = 3  # a choice: two intervals of the servo; a shorter arc has no speed
GAP_S = 0.1  # a choice: rows of one weld are 8 ms apart; a longer gap is a hold, whose time is no time of welding
_AT_REST = 0.1  # of the usual step: slower at its ends, the torch waits for the arc or fills the crater
_ROUNDING = 1e-9  # of the sums; far below the digits of any limit
ANGLES = ("work_angle_deg", "travel_angle_deg")
MEASURED, SET, UNKNOWN = "measured", "set", "unknown"


@dataclass(frozen=True)
class Spread:
    """Least, mean and largest value of a figure along a seam; NaN where it is not known."""

    least: float = math.nan
    mean: float = math.nan
    most: float = math.nan


@dataclass(frozen=True, kw_only=True)
class WeldedSeam:
    """What was measured of one seam while the arc burned.

    Attributes:
        seam, weld_pass: their numbers, from 1; welded_mm, arc_s: length and time of the arc.
        arc_values: measured (by the power source), set (as ordered of it), or unknown.
        figures: by the names of RANGES, over stretches of 10 mm; their means over the seam. The speed is
            without the ordered times of standing, welding.arc.start_s and crater_s.
        path_mm: distance of the torch from the felt seam: mean and largest.
        angles: of the wire against the seam, deg.
        arc_mm: where along the planned seam the arc burned, (from, to) of each stretch.
    """

    seam: int
    weld_pass: int
    welded_mm: float
    arc_s: float
    arc_values: str
    figures: dict[str, Spread]
    path_mm: Spread
    angles: dict[str, Spread] = field(default_factory=dict)
    arc_mm: tuple[tuple[float, float], ...] = ()

    @property
    def name(self) -> str:
        """The number of the seam, with that of a pass after the root."""
        return str(self.seam) if self.weld_pass == 1 else f"{self.seam}, pass {self.weld_pass}"

    def outside(self, limits: OrderLimits) -> tuple[str, ...]:
        """Names of the limits that the seam exceeds, or that nothing is known of."""
        found = []
        for name in RANGES:
            value, limit = self.figures[name], getattr(limits, name)
            if limit is not None and not (limit[0] - _ROUNDING <= value.least and value.most <= limit[1] + _ROUNDING):
                found.append(name)
        if limits.path_mm is not None and not self.path_mm.most <= limits.path_mm:
            found.append("path_mm")
        return tuple(found)


Numbers = tuple[int, int]
"""Of a seam and of its pass, from 0."""


def seam_rows(record: WeldRecord, plans: Sequence[Numbers]) -> Iterator[tuple[Numbers, NDArray[np.bool_]]]:
    """The numbers of each seam's passes and their rows (N,): the tip is brought down once for each plan.

    Args:
        plans: numbers of each plan, in the order of welding; plans of one pass are its pieces.
    """
    touching = record.phase == "TOUCH"
    plan = np.cumsum(touching & ~np.concatenate([[False], touching[:-1]]))
    plan -= plan[0]
    found = [plans[k] if k < len(plans) else (k, 0) for k in range(int(plan[-1]) + 1)]
    for numbers in dict.fromkeys(found):
        yield numbers, np.isin(plan, [k for k, other in enumerate(found) if other == numbers])


def welded_seam(record: WeldRecord, numbers: Numbers, rows: NDArray[np.bool_]) -> WeldedSeam | None:
    """Return the figures of the pass of a seam of these rows (N,); None where its arc did not burn."""
    on = np.flatnonzero(rows & record.arc)
    if len(on) < LEAST_ROWS:
        return None
    time = record["time_s"]
    dt = np.diff(time[on])
    burned = np.split(1e3 * record["s_torch_m"][on], np.flatnonzero(dt > GAP_S) + 1)
    dt = np.where(dt > GAP_S, 0.0, dt)
    length = record["torch_speed_m_s"][on][:-1] * dt
    if record.settings.get("woven"):  # metal is deposited along the seam, not along the swings
        length = np.where(dt > 0.0, np.abs(np.diff(record["s_torch_m"][on])), 0.0)
    current, voltage, source = arc_values(record, on)
    heat = (record.process.k or math.nan) * voltage[:-1] * current[:-1] * dt  # J, EN 1011-1 and ISO/TR 18491
    stretch = np.minimum(np.cumsum(length) // STRETCH_M, max(length.sum() // STRETCH_M - 1.0, 0.0)).astype(int)
    stands = (record.settings.get("start_s", 0.0), record.settings.get("crater_s", 0.0))
    tables = {
        "heat_input_kJ_mm": (1e-6 * heat, length),
        "speed_mm_s": (1e3 * length, np.where(_stands(length, dt, burned, *stands), 0.0, dt)),
        "current_A": (current[:-1] * dt, dt),
        "voltage_V": (voltage[:-1] * dt, dt),
    }
    off = 1e3 * np.hypot(record["e_t_m"][on], record["e_height_m"][on])
    off = off[np.isfinite(off)]
    angles = {name: np.degrees(record[f"{name[:-3]}rad"][on]) for name in ANGLES}
    return WeldedSeam(
        seam=numbers[0] + 1,
        weld_pass=numbers[1] + 1,
        welded_mm=1e3 * float(length.sum()),
        arc_s=float(dt.sum()),
        arc_values=source,
        figures={name: _spread(*table, stretch) for name, table in tables.items()},
        path_mm=Spread(*map(float, (off.min(), off.mean(), off.max()))) if len(off) else Spread(),
        angles={
            name: Spread(float(np.min(v)), float(np.mean(v)), float(np.max(v)))
            for name, v in angles.items()
            if np.isfinite(v).all()
        },
        arc_mm=tuple((float(np.nanmin(s)), float(np.nanmax(s))) for s in burned if np.isfinite(s).any()),
    )


def _stands(length: Array, dt: Array, burns: Sequence[Array], start_s: float, crater_s: float) -> NDArray[np.bool_]:
    """The steps (N,) in which the torch is at rest as ordered, at the start of a burn and at its end."""
    still = length < _AT_REST * np.median(length[length > 0.0]) if length.any() else length < 0.0
    found, k = np.zeros(len(length), dtype=bool), 0
    for burn in burns:
        rows = slice(k, k + len(burn) - 1)
        for turn, ordered_s in ((1, start_s), (-1, crater_s)):
            begun = still[rows][::turn] & (np.cumsum(dt[rows][::turn]) <= ordered_s)
            found[rows] |= begun[::turn]
        k += len(burn)
    return found


def arc_values(record: WeldRecord, rows: NDArray[np.intp]) -> tuple[Array, Array, str]:
    """Current A and voltage V of these rows, and whether they are measured, set or unknown.

    A row without a measurement has the mean of those with one. What the schedule sets counts before the process.
    """
    for prefix, source in (("", MEASURED), ("set_", SET)):
        pair = record[f"{prefix}current_A"][rows], record[f"{prefix}voltage_V"][rows]
        good = np.isfinite(pair[0]) & np.isfinite(pair[1])
        if good.any():
            current, voltage = (np.where(good, values, values[good].mean()) for values in pair)
            return current, voltage, source
    process = record.process
    known = process.current_A is not None and process.voltage_V is not None
    current, voltage = (
        np.full(len(rows), math.nan if v is None else v) for v in (process.current_A, process.voltage_V)
    )
    return current, voltage, SET if known else UNKNOWN


def _spread(above: Array, below: Array, stretch: NDArray[np.int_]) -> Spread:
    """Least and largest quotient of the sums over each stretch, and the quotient over all."""
    sums = [np.bincount(stretch, weights=values) for values in (above, below)]
    with np.errstate(divide="ignore", invalid="ignore"):
        quotients = sums[0] / sums[1]
        mean = float(np.divide(above.sum(), below.sum()))
    return Spread(float(quotients.min()), mean, float(quotients.max()))


_PARTS = ("least", "mean", "most", "from", "to")
RECORD_COLUMNS = (
    *WeldOrder().texts,
    *("written", "seam", "pass", "ended", "welded_mm", "arc_s", "arc_values"),
    *(f"{name}_{part}" for name in RANGES for part in _PARTS),
    *("path_mm_mean", "path_mm_most", "path_mm_to", "within_limits", "outside"),
    *("picture_start", "picture_end", "software", "scenario", "seed"),
)
"""Columns of record.csv, one row a seam; docs/weld_log.md describes them."""


def record_row(found: WeldedSeam, order: WeldOrder, others: dict[str, object]) -> dict[str, object]:
    """A row of record.csv by RECORD_COLUMNS: `others` are its values that are not of the weld; empty: not known."""
    row: dict[str, object] = {**order.texts, **others}
    row |= {
        "seam": found.seam,
        "pass": found.weld_pass,
        "welded_mm": _cell(found.welded_mm),
        "arc_s": _cell(found.arc_s),
    }
    row["arc_values"] = found.arc_values
    for name in RANGES:
        low, high = getattr(order.limits, name) or (math.nan, math.nan)
        value = found.figures[name]
        cells = (value.least, value.mean, value.most, low, high)
        row |= {f"{name}_{part}": _cell(cell) for part, cell in zip(_PARTS, cells, strict=True)}
    outside = found.outside(order.limits)
    limited = order.limits != OrderLimits()
    return row | {
        "path_mm_mean": _cell(found.path_mm.mean),
        "path_mm_most": _cell(found.path_mm.most),
        "path_mm_to": _cell(order.limits.path_mm),
        "within_limits": "" if not limited else "no" if outside else "yes",
        "outside": " ".join(outside),
    }


def _cell(value: float | None) -> float | str:
    """A number of a table, to 4 significant digits; empty where it is not known."""
    return "" if value is None or not math.isfinite(value) else float(f"{value:.4g}")
