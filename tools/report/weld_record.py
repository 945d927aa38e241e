"""Write the record of a welded part: record.html, record.json, record.csv, pictures, and the report's section."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.results import software_version
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.jobs.weld.welding_velocity_servo import PHASE_CODES
from weldcal.systems.runner import Run
from weldcal.tools.report.pictures import GREY, OURS, TORCH, plain, subplots, svg
from weldcal.tools.report.render import fixed, mappings_csv, render, write_atomic, write_json
from weldcal.tools.report.weld import WeldOutcome, columns, felt_seams, ordered_angles
from weldcal.welding.record.order import RANGES, OrderLimits, WeldOrder
from weldcal.welding.record.process import speed_along
from weldcal.welding.record.progress import Progress
from weldcal.welding.record.weld_log import WeldRecord, load_weld_log
from weldcal.welding.record.welded_seam import (
    MEASURED,
    RECORD_COLUMNS,
    SET,
    UNKNOWN,
    Spread,
    WeldedSeam,
    record_row,
    seam_rows,
    welded_seam,
)
from weldcal.welding.servo.state import Phase

_SMALL = 8
_INCH = 1.35  # height of one curve
_SMOOTH_S = 0.2  # a choice: a reader's eye takes the mean of a pulsed or noisy arc


def arc_over_time(record: WeldRecord, rows: NDArray[np.bool_], limits: OrderLimits) -> bytes | None:
    """Draw current, voltage, wire feed, travel speed and gap while the arc of these rows (N,) burns; None without one.

    Measured values are lines, set values dashed, limits grey bands.
    """
    on = np.flatnonzero(rows & record.arc)
    if len(on) < 3:
        return None
    t = record["time_s"][on] - record["time_s"][on[0]]
    curves = [
        ("current, A", record["current_A"][on], record["set_current_A"][on], limits.current_A),
        ("voltage, V", record["voltage_V"][on], record["set_voltage_V"][on], limits.voltage_V),
        ("wire feed,\nm/min", None, record["set_wire_feed_m_min"][on], None),
        ("travel speed,\nmm/s", 1e3 * record["torch_speed_m_s"][on], None, limits.speed_mm_s),
        ("gap, mm", 1e3 * record["gap_m"][on], None, None),
    ]
    shown = [c for c in curves if any(v is not None and np.isfinite(v).any() for v in c[1:3])]
    figure, axes = subplots(8.2, _INCH * len(shown) + 0.3, len(shown), 1, sharex=True, squeeze=False)
    for ax, (name, measured, wanted, limit) in zip(axes[:, 0], shown, strict=True):
        if limit is not None:
            ax.axhspan(*limit, color=GREY, alpha=0.18, lw=0, label="limits")
        if measured is not None and np.isfinite(measured).any():
            ax.plot(t, measured, color=GREY, lw=0.5)
            ax.plot(t, _smooth(t, measured), color=OURS, lw=1.3, label="measured")
        if wanted is not None and np.isfinite(wanted).any():
            ax.plot(t, wanted, color=TORCH, lw=1.2, ls="--", label="set")
        low, high = ax.get_ylim()
        ax.set_ylim(min(low, 0.0) if name.startswith(("travel", "gap")) else low, high)
        ax.legend(frameon=False, fontsize=_SMALL, ncols=3, loc="lower center")
        plain(ax, "", name)
    axes[-1, 0].set_xlabel("time from the established arc, s")
    return svg(figure, *axes[:, 0])


def _smooth(t: Array, value: Array) -> Array:
    """The running mean (N,) over _SMOOTH_S."""
    known = np.nan_to_num(value)
    total = np.concatenate([[0.0], np.cumsum(known)])
    first = np.searchsorted(t, t - 0.5 * _SMOOTH_S)
    last = np.searchsorted(t, t + 0.5 * _SMOOTH_S, side="right")
    return np.asarray((total[last] - total[first]) / (last - first))


RECORD_HTML, RECORD_JSON, RECORD_CSV, PICTURES = "record.html", "record.json", "record.csv", "pictures"
PHASE_NAMES = [str(phase) for phase in Phase]
ENDS = ("start", "end")
_PICTURE_KEYS = tuple(f"picture_{end}" for end in ENDS)
_WORDS = {
    "heat_input_kJ_mm": ("heat input", "kJ/mm", 2),
    "speed_mm_s": ("travel speed", "mm/s", 1),
    "current_A": ("current", "A", 0),
    "voltage_V": ("voltage", "V", 1),
    "path_mm": ("torch off the felt seam", "mm", 2),
}
_SOURCES = {
    MEASURED: "as measured by the power source",
    SET: "as set at the power source, not measured",
    UNKNOWN: "not known",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class PartRecord:
    """The record of a part: its order, its weld log, the welded seams, and PNG pictures by name.

    `stretches`: rows of what was welded without a break; `lost`: a sentence for each stretch without a log.
    """

    order: WeldOrder
    log: WeldRecord
    seams: tuple[WeldedSeam, ...]
    pictures: dict[str, bytes]
    plots: dict[tuple[int, int], bytes]  # of the arc, by the numbers of seam and pass from 1
    stretches: Sequence[dict[str, object]] = ()
    lost: tuple[str, ...] = ()

    @property
    def outside(self) -> list[str]:
        """A sentence for each limit that a seam exceeds, and for each stretch that nothing is known of."""
        return [*self.lost, *self._outside()]

    def _outside(self) -> list[str]:
        return [
            f"Seam {seam.name}: {_WORDS[name][0]} is {_known(seam, name, 2)}, and the limit is"
            f" {_limit(self.order, name)}."
            for seam in self.seams
            for name in seam.outside(self.order.limits)
        ]

    def summary(self) -> dict[str, object]:
        """What `--json` holds of the record; empty without an order."""
        return {} if self.order.empty else {"order": self.order.document(), "outside_limits": self.outside}

    def rows(self) -> list[tuple[str, ...]]:
        """Rows of the report: seam, figure, least to largest value, mean, limit, verdict."""
        return [(seam.name, *row) for seam in self.seams for row in self.rows_of(seam)]

    def rows_of(self, seam: WeldedSeam) -> list[tuple[str, ...]]:
        """The same rows of one seam, without its number."""
        found: list[tuple[str, ...]] = []
        outside = seam.outside(self.order.limits)
        for name, (words, unit, digits) in _WORDS.items():
            limit = _limit(self.order, name)
            verdict = "" if limit == "–" else "outside" if name in outside else "within"
            mean = fixed(_spread(seam, name).mean, digits)
            if mean == limit == "–":  # neither known nor ordered
                continue
            found.append((f"{words}, {unit}", _range(seam, name), mean, limit, verdict))
        orders = self.log.settings.get("angles") or []
        order = (orders[seam.seam - 1] if seam.weld_pass == 1 and seam.seam <= len(orders) else None) or {}
        for name, value in seam.angles.items():
            wanted = "–" if order.get(name) is None else " to ".join(f"{v:g}" for v in np.ravel(order[name]))
            between = f"{fixed(value.least, 1)} to {fixed(value.most, 1)}"
            found.append((f"{name[:-4].replace('_', ' ')}, deg", between, fixed(value.mean, 1), wanted, ""))
        return found

    def facts(self) -> list[tuple[str, str]]:
        """The order's texts, the arc as it was set, and where the arc values come from."""
        found = [(name.replace("_", " "), text) for name, text in self.order.texts.items() if text]
        process, sources = self.log.process, {seam.arc_values for seam in self.seams}
        if process.missing is None:
            name, k = process.name or "not named", process.k
            found.append(("process", f"{name}, {process.current_A:g} A, {process.voltage_V:g} V as set; k = {k:g}"))
        elif UNKNOWN in sources or not sources:
            return [*found, ("heat input", f"not known: {process.missing}")]
        else:
            found.append(("process", f"{process.name or 'not named'}; k = {fixed(process.k, 2)}"))
        return [*found, ("arc values", "; ".join(_SOURCES[source] for source in sorted(sources)))]

    def write(self, folder: Path) -> None:
        """Write the files of the record into the result folder."""
        written = datetime.now(UTC).isoformat(timespec="seconds")
        common = {name: self.log.settings.get(name, "") for name in ("software", "scenario", "seed", "ended")}
        rows = []
        for seam in self.seams:
            names = [f"seam_{seam.seam}_{end}" for end in ENDS]
            files = [f"{PICTURES}/{name}.png" if name in self.pictures else "" for name in names]
            rows.append(
                record_row(
                    seam, self.order, {**common, "written": written, **dict(zip(_PICTURE_KEYS, files, strict=True))}
                )
            )
        for name, picture in self.pictures.items():
            write_atomic(folder / PICTURES / f"{name}.png", picture)
        write_atomic(folder / RECORD_CSV, mappings_csv(rows, RECORD_COLUMNS))
        document = {
            "schema": "weldcal weld record",
            "version": 1,
            "written": written,
            **common,
            "order": self.order.document(),
            "outside_limits": self.outside,
            "process": asdict(self.log.process),
            "schedule": self.log.settings.get("schedule"),
            "angles": self.log.settings.get("angles"),
            "stretches": list(self.stretches),
            "seams": [
                asdict(seam) | {"outside": seam.outside(self.order.limits)} | {key: row[key] for key in _PICTURE_KEYS}
                for seam, row in zip(self.seams, rows, strict=True)
            ],
        }
        write_json(folder / RECORD_JSON, document)
        write_atomic(folder / RECORD_HTML, self.page(written))

    def _ends_of(self, seam: int) -> bytes | None:
        """The pictures of a seam's start and end side by side, PNG; None without them."""
        names = [f"seam_{seam}_{end}" for end in ENDS]
        grey = [cv2.imdecode(np.frombuffer(self.pictures[n], np.uint8), 0) for n in names if n in self.pictures]
        found = [np.pad(one, ((0, 0), (0, 8)), constant_values=255) for one in grey if one is not None]
        tall = max((len(one) for one in found), default=0)
        row = [np.pad(one, ((0, tall - len(one)), (0, 0)), constant_values=255) for one in found]
        return cv2.imencode(".png", np.hstack(row))[1].tobytes() if row else None

    def page(self, written: str) -> str:
        """The record as one self-contained HTML text."""
        ended, seams = str(self.log.settings.get("ended", "")), len({seam.seam for seam in self.seams})
        passes = f" in {len(self.seams)} passes" if len(self.seams) > seams else ""
        limited, what = self.order.limits != OrderLimits(), f"{seams} seam{'' if seams == 1 else 's'} welded{passes}"
        tone, headline = ("good", f"{what}, within all limits") if limited else ("plain", f"{what}, no limits ordered")
        if self.outside:
            tone, headline = "bad", f"{what}, {len(self.outside)} of the limits exceeded"
        if ended not in ("", "done") or not seams:
            tone, headline = "bad", f"{what}; the job was held"
        cards = [
            (f"Seam {seam.name}, heat input", fixed(seam.figures["heat_input_kJ_mm"].mean, 2), "kJ/mm", words)
            for seam in self.seams
            for words in [f"{seam.welded_mm:.0f} mm in {seam.arc_s:.1f} s; arc values {_SOURCES[seam.arc_values]}"]
        ]
        return render(
            "weld_record.html.j2",
            record=self,
            order=self.order,
            plots=self.plots,
            pictures={seam.seam: picture for seam in self.seams if (picture := self._ends_of(seam.seam)) is not None},
            cards=cards,
            written=written.replace("T", " ").replace("+00:00", " UTC"),
            simulated=self.log.settings.get("robot") == "simulated",
            tone=tone,
            headline=headline,
            sentence=ended if tone == "bad" and ended not in ("", "done") else "",
        )


def weld_record(run: Run[WeldJob], weld: WeldOutcome, seed: int, scenario: str, robot: str) -> WeldRecord:
    """The weld record from the log; it contains no ground truth of the simulation."""
    log, cell, config = weld.log, run.cell, run.cell.job.servo_config
    process = cell.scenario.welding.process.process()
    speed = travel_speed = speed_along(log.time, log.p_BW)
    if config.weave.amplitude_m:  # metal is deposited along the seam, not along the swings
        travel_speed = speed_along(log.time, np.outer(log.telemetry["s_torch"], [1.0, 0.0, 0.0]))
    moving = log.telemetry["phase"] != PHASE_CODES[Phase.TOUCH]
    named = log.telemetry
    table = {"time_s": log.time, "torch_on": log.torch_on.astype(float), "sigma_min": log.sigma_min}
    table |= {f"{name}_m": named[name] for name in ("s_tip", "s_torch", "delta_n", "delta_axial", "e_t", "e_height")}
    table |= {name: named[name] for name in ("n_d_dot_n_t", "conditioning", "gain", "n_points")}
    table |= {f"q_B{frame}_{axis}": named[f"q_BT_{axis}"] for frame in "TW" for axis in "wxyz"}
    tip, target = columns(named, "tip"), columns(named, "target")
    vectors = {"p_BW": log.p_BW, "p_BT": log.p_BRobot, "deflection": log.deflection_T, "p_BTip": tip, "p_BSeam": target}
    table |= {f"{name}_{axis}_m": v[:, k] for name, v in vectors.items() for k, axis in enumerate("xyz")}
    arc = np.full((len(log.time), 3), np.nan) if log.arc is None else log.arc
    table |= {name: arc[:, k] for k, name in enumerate(("arc", "current_A", "voltage_V"))}
    scheduled = np.full((len(log.time), 5), np.nan) if log.scheduled is None else log.scheduled
    names = ("set_wire_feed_m_min", "set_voltage_V", "set_current_A", "gap_m")
    table |= {name: scheduled[:, k] for k, name in enumerate(names, start=1)}
    known = np.where(np.isfinite(arc[:, 1:]), arc[:, 1:], scheduled[:, [3, 2]])  # current and voltage
    table |= {
        "torch_speed_m_s": speed,
        "torch_speed_commanded_m_s": named["torch_speed"],
        "tip_speed_m_s": named["tip_speed"],
        "omega_rad_s": named["omega"],
        "work_angle_rad": np.where(moving, log.work, np.nan),
        "travel_angle_rad": np.where(moving, log.travel, np.nan),
        "heat_input_J_m": process.heat_input(np.where(log.torch_on, travel_speed, np.nan), known[:, 0], known[:, 1]),
    }
    settings = {
        "software": software_version(),
        "scenario": scenario,
        "seed": seed,
        "robot": robot,
        "servo_period_s": config.period_s,
        "weld_speed_m_s": config.weld_speed_m_s,
        "delta_d_m": config.deflection.delta_d_m,
        "axial_d_m": config.deflection.axial_d_m,
        "omega_max_rad_s": config.limits.omega_max_rad_s,
        "chord_m": config.tool.torch_offset_m,
        "law": config.law,
        "start_s": cell.scenario.welding.arc.start_s,
        "crater_s": cell.scenario.welding.arc.crater_s,
        "woven": bool(config.weave.amplitude_m),
        "felt": felt_seams(run),
        "plans": [(plan.seam, plan.weld_pass) for plan in cell.job.planned_seam(run.root).records],
        "ended": run.reason or "done",
        "order": cell.scenario.welding.order.document(),
        "angles": ordered_angles(run),
        "schedule": None if cell.scenario.welding.schedule is None else asdict(cell.scenario.welding.schedule),
    }
    phase = np.array([PHASE_NAMES[int(k)] for k in named["phase"]], dtype=np.str_)
    return WeldRecord(table, phase, process, settings)


def part_record(run: Run[WeldJob], log: WeldRecord, progress: Progress | None = None) -> PartRecord:
    """The record of a finished run from its weld log; without a seam where no arc burned.

    `progress`: where the run went on with a broken weld, the record joins the logs of all its runs.
    """
    lost: list[str] = []
    if progress is not None:
        log, lost = with_earlier_logs(log, progress)
    plans: list[tuple[int, int]] = [(seam, number) for seam, number in log.settings["plans"]]
    order, of_seam = run.cell.scenario.welding.order, list(seam_rows(log, plans))
    seams = [welded_seam(log, numbers, rows) for numbers, rows in of_seam]
    plots = {numbers: arc_over_time(log, rows, order.limits) for numbers, rows in of_seam}
    pictures = {
        f"seam_{seam + 1}_{end}": cv2.imencode(".png", image.pixels)[1].tobytes()
        for seam, images in run.seam_pictures.items()
        for end, image in zip(ENDS, images, strict=False)
        if image.pixels.size
    }
    return PartRecord(
        order=order,
        log=log,
        seams=tuple(seam for seam in seams if seam is not None),
        pictures=pictures,
        plots={(seam + 1, number + 1): plot for (seam, number), plot in plots.items() if plot is not None},
        stretches=[] if progress is None else stretch_rows(progress),
        lost=tuple(lost),
    )


def with_earlier_logs(log: WeldRecord, progress: Progress) -> tuple[WeldRecord, list[str]]:
    """The weld log behind those of the earlier runs of a broken weld, and a sentence for each log that is lost."""
    lost = []
    for k in reversed(range(len(progress.folders) - 1)):
        welded = [one for one in progress.stretches if one.run == k]
        try:
            log = log.after(load_weld_log(Path(progress.folders[k])))
            break  # it holds those before it
        except InputError:
            lost += [
                f"Seam {one.seam + 1}: {1e3 * one.from_m:.0f} to {1e3 * one.to_m:.0f} mm were welded in a run whose log"
                " is lost."
                for one in welded
            ]
    return log, lost


def stretch_rows(progress: Progress) -> list[dict[str, object]]:
    """What record.json holds of each stretch that was welded without a break."""
    return [
        {
            "seam": one.seam + 1,
            "from_mm": round(1e3 * one.from_m, 1),
            "to_mm": round(1e3 * one.to_m, 1),
            "ended": one.time,
            "folder": progress.folders[one.run],
        }
        for one in progress.stretches
    ]


def _spread(seam: WeldedSeam, name: str) -> Spread:
    return seam.figures[name] if name in RANGES else seam.path_mm


def _known(seam: WeldedSeam, name: str, more_digits: int = 0) -> str:
    known = math.isfinite(_spread(seam, name).mean)
    return f"{_range(seam, name, more_digits)} {_WORDS[name][1]}" if known else "not known"


def _range(seam: WeldedSeam, name: str, more_digits: int = 0) -> str:
    value, digits = _spread(seam, name), _WORDS[name][2] + more_digits
    return f"{fixed(value.least, digits)} to {fixed(value.most, digits)}"


def _limit(order: WeldOrder, name: str) -> str:
    limit, digits = getattr(order.limits, name), _WORDS[name][2]
    if limit is None:
        return "–"
    return f"{limit[0]:g} to {limit[1]:g}" if name in RANGES else f"at most {fixed(limit, digits)}"
