"""Write the record of a welded part: record.html, record.json, record.csv, pictures, and the report's section."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np

from weldcal.calibration.data.results import software_version
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.jobs.weld.welding_velocity_servo import PHASE_CODES
from weldcal.systems.runner import Run
from weldcal.tools.report.files import mappings_csv, write_json
from weldcal.tools.report.plots_record import arc_over_time
from weldcal.tools.report.render import fixed, render, write_atomic
from weldcal.tools.report.weld import WeldOutcome, columns, felt_seams
from weldcal.welding.record.order import RANGES, OrderLimits, WeldOrder
from weldcal.welding.record.process import speed_along, torch_angles
from weldcal.welding.record.weld_log import WeldRecord
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
    """The record of a part: its order, its weld log, the welded seams, and PNG pictures by name."""

    order: WeldOrder
    log: WeldRecord
    seams: tuple[WeldedSeam, ...]
    pictures: dict[str, bytes]
    plots: dict[int, bytes]  # of the arc, by the seam's number from 1

    @property
    def outside(self) -> list[str]:
        """A sentence for each limit that a seam exceeds."""
        return [
            f"Seam {seam.seam}: {_WORDS[name][0]} is {_range(seam, name)} {_WORDS[name][1]}, and the limit is"
            f" {_limit(self.order, name)}."
            for seam in self.seams
            for name in seam.outside(self.order.limits)
        ]

    def summary(self) -> dict[str, object]:
        """What `--json` holds of the record; empty without an order."""
        return {} if self.order.empty else {"order": self.order.document(), "outside_limits": self.outside}

    def rows(self) -> list[tuple[str, ...]]:
        """Rows of the report: seam, figure, least to largest value, mean, limit, verdict."""
        return [(str(seam.seam), *row) for seam in self.seams for row in self.rows_of(seam)]

    def rows_of(self, seam: WeldedSeam) -> list[tuple[str, ...]]:
        """The same rows of one seam, without its number."""
        found: list[tuple[str, ...]] = []
        outside = seam.outside(self.order.limits)
        for name, (words, unit, digits) in _WORDS.items():
            limit = _limit(self.order, name)
            verdict = "" if limit == "–" else "outside" if name in outside else "within"
            mean = fixed(_spread(seam, name).mean, digits)
            found.append((f"{words}, {unit}", _range(seam, name), mean, limit, verdict))
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
        ended, seams = str(self.log.settings.get("ended", "")), len(self.seams)
        limited, what = self.order.limits != OrderLimits(), f"{seams} seam{'' if seams == 1 else 's'} welded"
        tone, headline = ("good", f"{what}, within all limits") if limited else ("plain", f"{what}, no limits ordered")
        if self.outside:
            tone, headline = "bad", f"{what}, {len(self.outside)} of the limits exceeded"
        if ended not in ("", "done") or not seams:
            tone, headline = "bad", f"{what}; the job was held"
        cards = [
            (f"Seam {seam.seam}, heat input", fixed(seam.figures["heat_input_kJ_mm"].mean, 2), "kJ/mm", words)
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
    p_BW = log.p_BRobot + log.R_BT @ config.p_TW
    speed = travel_speed = speed_along(log.time, p_BW)
    if config.weave.amplitude_m:  # metal is deposited along the seam, not along the swings
        travel_speed = speed_along(log.time, np.outer(log.telemetry["s_torch"], [1.0, 0.0, 0.0]))
    up = np.full((len(log.time), 3), np.nan)
    if weld.planned is not None:
        up = np.asarray(weld.planned.up(log.telemetry["s_torch"]))
    moving = log.telemetry["phase"] != PHASE_CODES[Phase.TOUCH]
    work, travel = torch_angles(log.R_BT, up, config.torch.work_angle_rad)
    named = log.telemetry
    table = {"time_s": log.time, "torch_on": log.torch_on.astype(float), "sigma_min": log.sigma_min}
    table |= {f"{name}_m": named[name] for name in ("s_tip", "s_torch", "delta_n", "delta_axial", "e_t", "e_height")}
    table |= {name: named[name] for name in ("n_d_dot_n_t", "conditioning", "gain", "n_points")}
    table |= {f"q_B{frame}_{axis}": named[f"q_BT_{axis}"] for frame in "TW" for axis in "wxyz"}
    tip, target = columns(named, "tip"), columns(named, "target")
    vectors = {"p_BW": p_BW, "p_BT": log.p_BRobot, "deflection": log.deflection_T, "p_BTip": tip, "p_BSeam": target}
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
        "work_angle_rad": np.where(moving, work, np.nan),
        "travel_angle_rad": np.where(moving, travel, np.nan),
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
        "woven": bool(config.weave.amplitude_m),
        "felt": felt_seams(run),
        "ended": run.reason or "done",
        "order": cell.scenario.welding.order.document(),
        "schedule": None if cell.scenario.welding.schedule is None else asdict(cell.scenario.welding.schedule),
    }
    phase = np.array([PHASE_NAMES[int(k)] for k in named["phase"]], dtype=np.str_)
    return WeldRecord(table, phase, process, settings)


def part_record(run: Run[WeldJob], log: WeldRecord) -> PartRecord:
    """The record of a finished run from its weld log; without a seam where no arc burned."""
    numbers: Sequence[int] = [plan.seam for plan in run.cell.job.planned_seam(run.root).records]
    order, of_seam = run.cell.scenario.welding.order, list(seam_rows(log, numbers))
    seams = [welded_seam(log, number, rows) for number, rows in of_seam]
    plots = {number + 1: arc_over_time(log, rows, order.limits) for number, rows in of_seam}
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
        plots={number: plot for number, plot in plots.items() if plot is not None},
    )


def _spread(seam: WeldedSeam, name: str) -> Spread:
    return seam.figures[name] if name in RANGES else seam.path_mm


def _range(seam: WeldedSeam, name: str) -> str:
    value, digits = _spread(seam, name), _WORDS[name][2]
    return f"{fixed(value.least, digits)} to {fixed(value.most, digits)}"


def _limit(order: WeldOrder, name: str) -> str:
    limit, digits = getattr(order.limits, name), _WORDS[name][2]
    if limit is None:
        return "–"
    return f"{limit[0]:g} to {limit[1]:g}" if name in RANGES else f"at most {fixed(limit, digits)}"
