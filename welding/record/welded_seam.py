"""Computes the row of a seam in the record of a part: arc values, travel speed, heat input, path, and its limits."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from weldcal.welding.numerics import Array
from weldcal.welding.record.order import RANGES, OrderLimits, WeldOrder
from weldcal.welding.record.process import PathError
from weldcal.welding.record.weave import measure_weave
from weldcal.welding.record.weld_log import WeldRecord

STRETCH_M = 0.010  # a choice: two to three times the length of the pool, over which heat and speed act together
LEAST_ROWS = 3  # a choice: two intervals of the servo; a shorter arc has no speed
GAP_S = 0.1  # a choice: rows of one weld are 8 ms apart; a longer gap is a hold, whose time is no time of welding
_AT_REST = 0.1  # of the usual step: slower at its ends, the torch waits for the arc or fills the crater
_ROUNDING = 1e-9  # of the sums; far below the digits of any limit
ANGLES = ("work_angle_deg", "travel_angle_deg")
MEASURED, SET, UNKNOWN = "measured", "set", "unknown"
DONE = "done"
TACK_NEAR_MM = 15.0  # a choice: the tip is lifted over a tack, and comes down, within that


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
        seam, weld_pass: their numbers, from 1; arc_s: time of the arc.
        arc_values: measured (by the power source), set (as ordered of it), or unknown.
        figures: by the names of RANGES, over stretches of 10 mm; their means over the seam. The speed is
            without the ordered times of standing, welding.arc.start_s and crater_s.
        path_mm: distance of the torch from the felt seam: mean and largest.
        angles: of the wire against the seam, deg.
        welded_mm: of the union of arc_mm, where that is known.
        arc_mm: where along the whole seam the arc burned, (from, to) of each piece.
        tacks: place of each ordered tack, the arc's travel angle while the tip is lifted over it, and the torch's path
            at it.
        weave: mean half width and frequency, as measured of the longest piece; None: not woven, or too short.
    """

    seam: int
    weld_pass: int
    welded_mm: float = math.nan
    arc_s: float = math.nan
    arc_values: str = UNKNOWN
    figures: dict[str, Spread] = field(default_factory=lambda: dict.fromkeys(RANGES, Spread()))
    path_mm: Spread = Spread()
    angles: dict[str, Spread] = field(default_factory=dict)
    arc_mm: tuple[tuple[float, float], ...] = ()
    weave: dict[str, float] | None = None
    tacks: tuple[dict[str, Any], ...] = ()

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

    def joined(self, pieces: "Sequence[ArcPiece]") -> Self:
        """The same with the places of all pieces of its pass; those of lost logs included."""
        where = tuple((p.from_mm, p.to_mm) for p in pieces if (p.seam, p.weld_pass) == (self.seam, self.weld_pass))
        return replace(self, arc_mm=where, welded_mm=length_mm(where))


Numbers = tuple[int, int]
"""Of a seam and of its pass, from 0."""


@dataclass(frozen=True, kw_only=True)
class ArcPiece:
    """A piece of a seam on which the arc burned without a break.

    Attributes:
        seam, weld_pass, run: numbers from 1.
        from_mm, to_mm: along the whole seam, in the direction of travel; NaN: not known.
        start, end: when the arc was lit and went out, ISO 8601; empty: not known.
        ended: DONE, or why the arc went out before its end.
        overlap_mm: of the piece that had been welded before.
    """

    seam: int
    weld_pass: int
    run: int
    from_mm: float
    to_mm: float
    start: str = ""
    end: str = ""
    ended: str = DONE
    overlap_mm: float = 0.0

    @property
    def name(self) -> str:
        """Number of its seam and pass."""
        return str(self.seam) if self.weld_pass == 1 else f"{self.seam}, pass {self.weld_pass}"


def length_mm(pieces: Iterable[tuple[float, float]]) -> float:
    """Length of the union of pieces (from, to), in either direction."""
    total, end = 0.0, -math.inf
    for a, b in sorted((min(p), max(p)) for p in pieces):
        total += max(b - max(a, end), 0.0)
        end = max(end, b)
    return total


def arc_pieces(record: WeldRecord, plans: Sequence[Numbers]) -> list[ArcPiece]:
    """The pieces of a weld log, in the order of time; settings "arcs" hold what the log's columns do not."""
    on = record.torch_on
    number = np.cumsum(on & ~np.concatenate([[False], on[:-1]])) - 1
    place = place_mm(record)
    arcs, found = record.settings.get("arcs", ()), []
    for (seam, weld_pass), rows in seam_rows(record, plans):
        of_pass = burns(record, np.flatnonzero(rows & record.arc))
        for burn, later in zip(of_pass, [*of_pass[1:], None], strict=False):  # without a burn there is no piece
            s, arc = place[burn], arcs[number[burn[0]]] if number[burn[0]] < len(arcs) else {"run": 1}
            if later is not None and number[later[0]] == number[burn[0]]:
                arc = arc | {"ended": "the power source reported no arc"}
            ends = (float(s.min()), float(s.max()))
            back = bool(s[-1] < s[0])
            piece = ArcPiece(seam=seam + 1, weld_pass=weld_pass + 1, from_mm=ends[back], to_mm=ends[not back], **arc)
            found.append((burn[0], piece))
    return [piece for _, piece in sorted(found, key=lambda one: int(one[0]))]


def place_mm(record: WeldRecord) -> Array:
    """Where the torch is along the whole seam, (N,); in a log of before along the planned one."""
    return 1e3 * np.where(np.isfinite(record["s_seam_m"]), record["s_seam_m"], record["s_torch_m"])


def travel_speed(record: WeldRecord) -> Array:
    """Speed along the seam, along which metal is deposited, (N,) m/s; in a log of before that of the wire."""
    return np.where(np.isfinite(record["travel_speed_m_s"]), record["travel_speed_m_s"], record["torch_speed_m_s"])


def evenness(record: WeldRecord) -> float:
    """Standard deviation of the travel speed over its mean, by length; 0 where the torch stood still."""
    v = travel_speed(record)[record.arc]
    total = float(v.sum())
    mean = float(v @ v) / total if total else 0.0
    return float(np.sqrt((v - mean) ** 2 @ v / total)) / mean if mean else 0.0


def with_overlaps(pieces: Sequence[ArcPiece]) -> list[ArcPiece]:
    """The pieces, to the micrometre, with the length of each that was welded before."""
    found: list[ArcPiece] = []
    for piece in pieces:
        before = [(p.from_mm, p.to_mm) for p in found if p.name == piece.name]
        here = (piece.from_mm, piece.to_mm)
        twice = length_mm(before) + length_mm([here]) - length_mm([*before, here])
        a, b, overlap = (round(mm, 3) for mm in (*here, max(twice, 0.0)))
        found.append(replace(piece, from_mm=a, to_mm=b, overlap_mm=overlap))
    return found


def burns(record: WeldRecord, on: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Rows (n,) of the arc, split where it was out."""
    return np.split(on, np.flatnonzero(np.diff(record["time_s"][on]) > GAP_S) + 1) if len(on) else []


def seam_rows(record: WeldRecord, plans: Sequence[Numbers]) -> Iterator[tuple[Numbers, NDArray[np.bool_]]]:
    """The numbers of each seam's passes and their rows (N,): the tip is brought down once for each plan.

    Args:
        plans: numbers of each plan, in the order of welding; plans of one pass are its pieces.
    """
    if not len(record):
        return
    plan = touch_numbers(record.phase == "TOUCH", np.isin(record.phase, ("HELD", "BACK")))
    found = [plans[k] if k < len(plans) else (k, 0) for k in range(int(plan[-1]) + 1)]
    for numbers in dict.fromkeys(found):
        yield numbers, np.isin(plan, [k for k, other in enumerate(found) if other == numbers])


def touch_numbers(touching: NDArray[np.bool_], held: NDArray[np.bool_]) -> NDArray[np.int_]:
    """The number (N,) of each row's weld: one begins where the tip comes down again, and not after a hold of that."""
    last = np.maximum.accumulate(np.where(held, 0, np.arange(len(held))))
    down = touching[last]
    number = np.cumsum(down & ~np.concatenate([[False], down[:-1]]))
    return np.asarray(number - number[0])


def welded_seam(record: WeldRecord, numbers: Numbers, rows: NDArray[np.bool_]) -> WeldedSeam | None:
    """Return the figures of the pass of a seam of these rows (N,); None where its arc did not burn."""
    on = np.flatnonzero(rows & record.arc)
    if len(on) < LEAST_ROWS:
        return None
    time = record["time_s"]
    dt = np.diff(time[on])
    of_burns = burns(record, on)
    dt[np.cumsum([len(burn) for burn in of_burns[:-1]], dtype=int) - 1] = 0.0
    length = travel_speed(record)[on][:-1] * dt
    current, voltage, source = arc_values(record, on)
    heat = (record.process.k or math.nan) * voltage[:-1] * current[:-1] * dt  # J, EN 1011-1 and ISO/TR 18491
    stretch = np.minimum(np.cumsum(length) // STRETCH_M, max(length.sum() // STRETCH_M - 1.0, 0.0)).astype(int)
    stands = (record.settings.get("start_s", 0.0), record.settings.get("crater_s", 0.0))
    tables = {
        "heat_input_kJ_mm": (1e-6 * heat, length),
        "speed_mm_s": (1e3 * length, np.where(_stands(length, dt, of_burns, *stands), 0.0, dt)),
        "current_A": (current[:-1] * dt, dt),
        "voltage_V": (voltage[:-1] * dt, dt),
    }
    off = 1e3 * np.hypot(record["e_t_m"][on], record["e_height_m"][on])
    angles = {name: np.degrees(record[f"{name[:-3]}rad"][on]) for name in ANGLES}
    return WeldedSeam(
        seam=numbers[0] + 1,
        weld_pass=numbers[1] + 1,
        welded_mm=1e3 * float(length.sum()),
        arc_s=float(dt.sum()),
        arc_values=source,
        figures={name: _spread(*table, stretch) for name, table in tables.items()},
        path_mm=_extent(off),
        angles={name: _extent(v) for name, v in angles.items() if np.isfinite(v).all()},
        weave=_weave(record, numbers, max(of_burns, key=len)),
        tacks=tuple(_tacks(record, numbers, on)),
    )


def ordered(record: WeldRecord, numbers: Numbers) -> Mapping[str, Any]:
    """What is ordered of the pass of a seam, by its numbers from 0; empty in a log of before."""
    orders = record.settings.get("ordered", ())
    return next((one for one in orders if (one["seam"], one["pass"]) == (numbers[0] + 1, numbers[1] + 1)), {})


def _tacks(record: WeldRecord, numbers: Numbers, on: NDArray[np.intp]) -> Iterator[dict[str, Any]]:
    torch = place_mm(record)[on]
    tip = torch + 1e3 * (record["s_tip_m"] - record["s_torch_m"])[on]  # a chord ahead: a root is welded forwards
    for tack in ordered(record, numbers).get("tacks", ()):
        near, under = (
            on[(place > tack["from_mm"] - TACK_NEAR_MM) & (place < tack["to_mm"] + TACK_NEAR_MM)]
            for place in (torch, tip)
        )
        yield {
            "from_mm": tack["from_mm"],
            "to_mm": tack["to_mm"],
            "travel_angle_deg": _extent(np.degrees(record["travel_angle_rad"][under])),
            "path_mm": _extent(1e3 * np.hypot(record["e_t_m"][near], record["e_height_m"][near])),
        }


def _extent(values: Array) -> Spread:
    known = values[np.isfinite(values)]
    return Spread(*map(float, (known.min(), known.mean(), known.max()))) if len(known) else Spread()


def _weave(record: WeldRecord, numbers: Numbers, burn: NDArray[np.intp]) -> dict[str, float] | None:
    order = ordered(record, numbers).get("weave")
    s = record["s_seam_m"][burn]
    columns = (s * np.sign(s[-1] - s[0]), record["left_m"][burn], record["up_m"][burn])
    if not order or not np.isfinite(columns).all():
        return None
    time = record["time_s"][burn]
    found = measure_weave(time, PathError(*columns), order["period_s"], math.radians(order["plane_deg"]))
    if found is None:
        return None
    return {
        "amplitude_mm": 1e3 * found.amplitude_m,
        "frequency_hz": 1.0 / (found.period_s - sum(order["dwell_s"])),
        "bow_mm": 1e3 * found.bow_m,
        "swings": found.swings,
    }


def _stands(
    length: Array, dt: Array, of_burns: Sequence[NDArray[np.intp]], start_s: float, crater_s: float
) -> NDArray[np.bool_]:
    """The steps (N,) in which the torch is at rest as ordered, at the start of a burn and at its end."""
    still = length < _AT_REST * np.median(length[length > 0.0]) if length.any() else length < 0.0
    found, k = np.zeros(len(length), dtype=bool), 0
    for burn in of_burns:
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


_WEAVE = {"mm": "amplitude_mm", "hz": "frequency_hz"}
_PARTS = ("least", "mean", "most", "from", "to")
RECORD_COLUMNS = (
    *WeldOrder().texts,
    *("written", "seam", "pass", "ended", "welded_mm", "arc_s", "arc_values"),
    *(f"{name}_{part}" for name in RANGES for part in _PARTS),
    *("path_mm_mean", "path_mm_most", "path_mm_to", "within_limits", "outside"),
    *("arc_mm", "broke_off", "weave_mm", "weave_hz", "software", "scenario", "seed"),
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
    row["arc_mm"] = " ".join(f"{a:.1f}-{b:.1f}" for a, b in found.arc_mm)
    row |= {f"weave_{unit}": _cell((found.weave or {}).get(key)) for unit, key in _WEAVE.items()}
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
