"""Write the record of a welded part: record.html, record.json, record.csv, and the report's section."""

import functools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.results import software_version
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.jobs.weld.welding_velocity_servo import PHASE_CODES
from weldcal.systems.messages import SeamRecord
from weldcal.systems.runner import Run
from weldcal.tools.report.plots_weld import arc_along_seam
from weldcal.tools.report.render import fixed, mappings_csv, render, write_atomic, write_json
from weldcal.tools.report.weld import (
    WeldLog,
    WeldOutcome,
    columns,
    felt_seams,
    ordered_angles,
    ordered_weave,
    weld_numbers,
)
from weldcal.welding.record.order import RANGES, OrderLimits, WeldOrder
from weldcal.welding.record.process import speed_along
from weldcal.welding.record.progress import Progress, Stretch
from weldcal.welding.record.weld_log import CSV_NAME, NO_LOG, WeldRecord, load_weld_log
from weldcal.welding.record.welded_seam import (
    DONE,
    MEASURED,
    RECORD_COLUMNS,
    SET,
    UNKNOWN,
    ArcPiece,
    Spread,
    WeldedSeam,
    arc_pieces,
    evenness,
    ordered,
    record_row,
    seam_rows,
    welded_seam,
    with_overlaps,
)
from weldcal.welding.servo.state import Phase

RECORD_HTML, RECORD_JSON, RECORD_CSV = "record.html", "record.json", "record.csv"
PHASE_NAMES = [str(phase) for phase in Phase]
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
    """The record of a part: its order, the joined log of all runs, the welded seams, and the pieces of all of them.

    `own`: log of the newest run, whose number is `run`; None: it has none. `lost`: a sentence for each stretch without
    a log.
    """

    order: WeldOrder
    log: WeldRecord
    seams: tuple[WeldedSeam, ...]
    plots: dict[tuple[int, int], bytes]  # of the arc, by the numbers of seam and pass from 1
    pieces: Sequence[ArcPiece] = ()
    lost: tuple[str, ...] = ()
    own: WeldRecord | None = None
    run: int = 1

    @property
    def broke_off(self) -> list[str]:
        """A sentence for each piece whose arc went out before its end."""
        found = []
        for k, piece in enumerate(self.pieces):
            if piece.ended == DONE:
                continue
            then = next((p for p in self.pieces[k + 1 :] if p.name == piece.name), None)
            on = "nothing was welded after it"
            if then is not None:
                where = "it" if then.run == piece.run else f"run {then.run}"
                on = f"{where} went on at {then.from_mm:.0f} mm, {then.overlap_mm:.0f} mm over the weld"
            broke = f"the arc broke off at {piece.to_mm:.0f} mm in run {piece.run} ({piece.ended.rstrip('.')})"
            found.append(f"Seam {piece.name}: {broke}; {on}.")
        return found

    @property
    def welded_mm(self) -> float:
        """Length of weld of all seams and passes, what was welded twice once."""
        return sum(seam.welded_mm for seam in self.seams)

    def piece_rows(self) -> list[tuple[str, ...]]:
        """Rows of the pages: seam, run, from, to, how it ended, overlap, start, end."""
        return [
            (
                *(p.name, str(p.run), fixed(p.from_mm, 1), fixed(p.to_mm, 1), p.ended, fixed(p.overlap_mm, 1)),
                *(at.replace("T", " ").partition(".")[0] for at in (p.start, p.end)),
            )
            for p in self.pieces
        ]

    @property
    def outside(self) -> list[str]:
        """A sentence for each limit that a seam exceeds, and for each stretch that nothing is known of."""
        return [*self.lost, *self._outside()]

    def _outside(self) -> list[str]:
        return [
            f"Seam {seam.name}: {_WORDS[name][0]} is {_known(seam, name)}, and the limit is {_limit(self.order, name)}."
            for seam in self.seams
            for name in seam.outside(self.order.limits)
        ]

    def summary(self) -> dict[str, object]:
        """What `--json` holds of the record."""
        order = {} if self.order.empty else {"order": self.order.document(), "outside_limits": self.outside}
        weld = {"torch_speed_cv": evenness(self.log), "welded_mm": self.welded_mm}
        arcs = {"arc_mm": [seam.arc_mm for seam in self.seams], "pieces": [asdict(p) for p in self.pieces]}
        return order | arcs | (weld if self.seams else {})

    def rows(self) -> list[tuple[str, ...]]:
        """Rows of the report: seam, figure, least to largest value, mean, limit, verdict."""
        return [(seam.name, *row) for seam in self.seams for row in self.rows_of(seam)]

    def rows_of(self, seam: WeldedSeam) -> list[tuple[str, ...]]:
        """The same rows of one seam, without its number."""
        found: list[tuple[str, ...]] = []
        outside = seam.outside(self.order.limits)
        for name, (words, unit, digits) in _WORDS.items():
            limit, value = _limit(self.order, name), _spread(seam, name)
            verdict = "" if limit == "–" else "outside" if name in outside else "within"
            if math.isfinite(value.mean) or limit != "–":  # known, or ordered
                found.append(_row(f"{words}, {unit}", value, digits, limit, verdict))
        orders = self.log.settings.get("angles") or []
        order = (orders[seam.seam - 1] if seam.weld_pass == 1 and seam.seam <= len(orders) else None) or {}
        for name, value in seam.angles.items():
            wanted = "–" if order.get(name) is None else " to ".join(f"{v:g}" for v in np.ravel(order[name]))
            found.append(_row(f"{name[:-4].replace('_', ' ')}, deg", value, 1, wanted))
        order = ordered(self.log, (seam.seam - 1, seam.weld_pass - 1))
        if weave := order.get("weave"):
            for key, words in (("amplitude_mm", f"weave ({weave['shape']}), mm"), ("frequency_hz", "weave, Hz")):
                found.append(_row(words, Spread(mean=(seam.weave or {}).get(key, math.nan)), 2, fixed(weave[key], 2)))
        if seam.weld_pass > 1 and order:  # not known of a killed run
            offsets = f"{order['lateral_mm']:g} and {order['vertical_mm']:g}"
            found.append(_row("pass, to the left and up, mm", Spread(), 1, offsets))
        for tack in seam.tacks:
            where = f"tack at {tack['from_mm']:g} to {tack['to_mm']:g} mm"
            found.append(_row(f"{where}: travel angle under the lifted tip, deg", tack["travel_angle_deg"], 1))
            found.append(_row(f"{where}: {_WORDS['path_mm'][0]}, mm", tack["path_mm"], 2))
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
        broke = [(p.name, f"{p.to_mm:.1f}: {p.ended}") for p in self.pieces if p.ended != DONE]
        rows = [
            record_row(
                seam,
                self.order,
                {**common, "written": written, "broke_off": "; ".join(at for n, at in broke if n == seam.name)},
            )
            for seam in self.seams
        ]
        write_atomic(folder / RECORD_CSV, mappings_csv(rows, RECORD_COLUMNS))
        document = {
            "schema": "weldcal weld record",
            "version": 2,
            "written": written,
            **common,
            "order": self.order.document(),
            "outside_limits": self.outside,
            "process": asdict(self.log.process),
            "schedule": self.log.settings.get("schedule"),
            "angles": self.log.settings.get("angles"),
            "ordered": self.log.settings.get("ordered"),
            "pieces": [asdict(piece) for piece in self.pieces],
            "broke_off": self.broke_off,
            "welded_mm": self.welded_mm,
            "seams": [asdict(seam) | {"outside": seam.outside(self.order.limits)} for seam in self.seams],
        }
        write_json(folder / RECORD_JSON, document)
        write_atomic(folder / RECORD_HTML, self.page(written))

    def page(self, written: str) -> str:
        """The record as one self-contained HTML text."""
        ended, seams = str(self.log.settings.get("ended", "")), len({seam.seam for seam in self.seams})
        passes = f" in {len(self.seams)} passes" if len(self.seams) > seams else ""
        what = f"{seams} seam{'' if seams == 1 else 's'} welded{passes}"
        limited = self.order.limits != OrderLimits()
        tone, judged = ("good", "pass, within all limits") if limited else ("plain", "not judged, no limits ordered")
        if self.outside:
            tone, judged = "bad", f"fail, {len(self.outside)} of the limits not met"
        if ended not in ("", DONE) or not seams:
            tone, judged = "bad", "fail, the weld is not complete"
        who = f"Part {self.order.part or 'not named'}, operator {self.order.operator or 'not named'}"
        return render(
            "weld_record.html.j2",
            record=self,
            order=self.order,
            plots=self.plots,
            sources=_SOURCES,
            written=written.replace("T", " ").replace("+00:00", " UTC"),
            simulated=self.log.settings.get("robot") == "simulated",
            tone=tone,
            headline=f"{who}: {judged}; {what}",
            sentence=" ".join([*([] if ended in ("", DONE) else [ended]), *self.broke_off]),
        )


def weld_record(
    run: Run[WeldJob], weld: WeldOutcome, seed: int, scenario: str, robot: str, number: int = 1
) -> WeldRecord:
    """The weld record of the run of this number from the log; it contains no ground truth of the simulation."""
    log, cell, config = weld.log, run.cell, run.cell.job.servo_config
    process = cell.scenario.welding.process
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
    records = cell.job.planned_seam(run.root).records
    table |= dict(zip(("s_seam_m", "left_m", "up_m"), places(log, records, moving), strict=True))
    known = np.where(np.isfinite(arc[:, 1:]), arc[:, 1:], scheduled[:, [3, 2]])  # current and voltage
    table |= {
        "torch_speed_m_s": speed,
        "travel_speed_m_s": travel_speed,
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
        "law": "guarded",  # the only one; older logs may name another
        "start_s": cell.scenario.welding.arc.start_s,
        "crater_s": cell.scenario.welding.arc.crater_s,
        "woven": bool(config.weave.amplitude_m),
        "felt": felt_seams(run),
        "plans": [(plan.seam, plan.weld_pass) for plan in records],
        "arcs": burned_arcs(run, log, number),
        "ordered": ordered_passes(run),
        "ended": run.reason or "done",
        "order": cell.scenario.welding.order.document(),
        "angles": ordered_angles(run),
        "schedule": None if cell.scenario.welding.schedule is None else asdict(cell.scenario.welding.schedule),
    }
    phase = np.array([PHASE_NAMES[int(k)] for k in named["phase"]], dtype=np.str_)
    return WeldRecord(table, phase, process, settings)


def places(log: WeldLog, records: Sequence[SeamRecord], moving: NDArray[np.bool_]) -> Array:
    """Where the torch is along the whole seam, left of and above the planned line (3, N), m; NaN before it moves."""
    found, number = np.full((3, len(log.time)), np.nan), weld_numbers(log.telemetry["phase"])
    for k, plan in enumerate(records):
        rows = np.flatnonzero(moving & (number == k))
        if plan.line is None or not len(rows):
            continue
        at, guess, s = 0.0, log.telemetry["s_torch"][rows], np.empty(len(rows))
        for i, row in enumerate(rows):
            s[i] = at = plan.line.nearest(log.p_BW[row], at if math.isnan(guess[i]) else guess[i])
        gap = log.p_BW[rows] - plan.line.position(s)
        beside = [np.sum(gap * axis(s), axis=1) for axis in (plan.line.normal, plan.line.up)]
        found[:, rows] = (plan.place(s), *beside)
    return found


def burned_arcs(run: Run[WeldJob], log: WeldLog, number: int) -> list[dict[str, object]]:
    """Of each arc of the log: the run's number, when it was lit and went out, and how it ended."""
    lit = np.flatnonzero(log.torch_on & ~np.concatenate([[False], log.torch_on[:-1]]))
    found: list[dict[str, object]] = []
    for row in lit:
        arc = min(run.arcs, key=lambda one: abs(one.on_s - log.time[row]))
        ended = f"held by an operator ({arc.held_by})" if arc.held_by else DONE
        found.append({"run": number, "start": arc.start, "end": arc.end, "ended": ended})
    phases = [name for name, _, _ in run.phases if name != "held"]
    finished = log.telemetry["phase"][-1] == PHASE_CODES[Phase.FINISH] and not log.torch_on[-1]
    if found and run.held and phases[-1:] == ["weld"] and not finished and found[-1]["ended"] == DONE:
        found[-1]["ended"] = run.reason or "the job was held"
    return found


def ordered_passes(run: Run[WeldJob]) -> list[dict[str, Any]]:
    """What is ordered of each pass of each seam, numbers from 1."""
    welding, config = run.cell.scenario.welding, run.cell.job.servo_config
    weave = None
    if config.weave.amplitude_m:
        weave = ordered_weave(config.weave) | {"period_s": config.weave.period_s}
    found = []
    for seam in sorted(run.cell.job.travel.order):
        tacks = [asdict(tack) for tack in welding.tacks if tack.seam == seam + 1]
        root = {"seam": seam + 1, "pass": 1, "speed_mm_s": welding.speed_mm_s, "weave": weave, "tacks": tacks}
        found.append(root)
        for k, order in enumerate(welding.passes, start=2):
            found.append(
                root | asdict(order) | {"pass": k, "speed_mm_s": order.speed_mm_s or welding.speed_mm_s, "tacks": []}
            )
    return found


def part_record(
    order: WeldOrder, log: WeldRecord | None, progress: Progress | None = None, folder: Path | None = None
) -> PartRecord:
    """The record of a weld from the log of its newest run; without a seam where no arc burned.

    `progress`: of all its runs, whose logs are in `folder`; without a log of the newest one it is the record of a run
    that was killed.
    """
    own, logs, lost, run = log, [], [], 1
    if progress is not None and folder is not None:
        run = len(progress.ends)
        for k in range(run - (own is not None)):
            try:
                logs.append(load_weld_log(run_log(folder, k + 1), whole=False))
            except InputError:
                lost += [one for one in progress.stretches if one.run == k]
    logs += [] if own is None else [own]
    joined = functools.reduce(lambda earlier, later: later.after(earlier), logs) if logs else NO_LOG
    if own is None and progress is not None:
        joined = replace(joined, settings={**joined.settings, "ended": progress.ends[-1]})
    plans: list[tuple[int, int]] = [(seam, number) for seam, number in joined.settings.get("plans", ())]
    pieces = [_lost_piece(one, lost, progress.ends) for one in lost] if progress is not None else []
    pieces = with_overlaps(sorted([*pieces, *arc_pieces(joined, plans)], key=lambda piece: piece.run))
    of_seam = dict(seam_rows(joined, plans))
    for piece in pieces:
        of_seam.setdefault((piece.seam - 1, piece.weld_pass - 1), np.zeros(len(joined), dtype=bool))
    seams = [
        welded_seam(joined, (n, m), rows) or WeldedSeam(seam=n + 1, weld_pass=m + 1)
        for (n, m), rows in sorted(of_seam.items())
    ]
    plots = {(n + 1, m + 1): arc_along_seam(joined, rows, order.limits) for (n, m), rows in of_seam.items()}
    return PartRecord(
        order=order,
        log=joined,
        seams=tuple(found for seam in seams if (found := seam.joined(pieces)).arc_mm),
        plots={numbers: plot for numbers, plot in plots.items() if plot is not None},
        pieces=pieces,
        lost=tuple(
            f"Seam {one.seam + 1}: {1e3 * one.from_m:.0f} to {1e3 * one.to_m:.0f} mm were welded in run {one.run + 1},"
            " whose log is lost."
            for one in lost
        ),
        own=own,
        run=run,
    )


def run_log(folder: Path, number: int) -> Path:
    """The table of one run of a weld that broke off, by its number from 1."""
    return folder / CSV_NAME.replace(".", f"-{number}.")


def _lost_piece(one: Stretch, lost: Sequence[Stretch], ends: Sequence[str]) -> ArcPiece:
    last = one is [other for other in lost if other.run == one.run][-1]
    return ArcPiece(
        seam=one.seam + 1,
        weld_pass=one.weld_pass + 1,
        run=one.run + 1,
        from_mm=1e3 * one.from_m,
        to_mm=1e3 * one.to_m,
        start=one.begun,
        end=one.time,
        ended=ends[one.run] if last and not one.done else DONE,
    )


def _row(words: str, value: Spread, digits: int, wanted: str = "–", verdict: str = "") -> tuple[str, ...]:
    """A row of the pages: the figure, least to largest value, mean, what was ordered, verdict."""
    between = f"{fixed(value.least, digits)} to {fixed(value.most, digits)}" if math.isfinite(value.least) else "–"
    return words, between, fixed(value.mean, digits), wanted, verdict


def _spread(seam: WeldedSeam, name: str) -> Spread:
    return seam.figures[name] if name in RANGES else seam.path_mm


def _known(seam: WeldedSeam, name: str) -> str:
    value, (_, unit, digits) = _spread(seam, name), _WORDS[name]
    between = f"{fixed(value.least, digits + 2)} to {fixed(value.most, digits + 2)} {unit}"
    return between if math.isfinite(value.mean) else "not known"


def _limit(order: WeldOrder, name: str) -> str:
    limit, digits = getattr(order.limits, name), _WORDS[name][2]
    if limit is None:
        return "–"
    return f"{limit[0]:g} to {limit[1]:g}" if name in RANGES else f"at most {fixed(limit, digits)}"
