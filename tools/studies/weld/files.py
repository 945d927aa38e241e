"""What the study leaves behind: the table as text and JSON, the figures of every run as CSV, one CSV per kept run."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import fields

import numpy as np

from weldcal.tools.report.render import fixed
from weldcal.tools.studies.weld.metrics import RunMetrics
from weldcal.tools.studies.weld.plant import COLUMNS, PHASES, StudyRun
from weldcal.tools.studies.weld.study import CaseResult, RowResult
from weldcal.tools.studies.weld.turns import TurnResult

FIGURE_NAMES = {
    "mean_mm": "torch, mean", "max_mm": "torch, largest", "space_mm": "torch in space, largest", "end_mm": "last chord, largest",
    "gap_mm": "gap and 60 mm after, largest", "cv_percent": "torch speed CV", "time_ratio": "time over L/V",
    "omega_rad_s": "turning rate", "tip_speed_mm_s": "tip speed", "end_step_mm_s": "robot's velocity step",
    "work_deg": "work angle", "travel_error_deg": "travel angle against prediction",
}  # fmt: skip


def table_lines(rows: Iterable[RowResult]) -> list[tuple[str, str, str, str, str, str, str]]:
    """The target table as text: what, figure, target, mean, worst, whether met, and the worst run."""
    lines = []
    for row in rows:
        done = f"{row.completed} of {row.runs}"
        verdict = "met" if row.completed == row.runs else "MISSED"
        lines.append((row.row.label, "completed", "all", done, "", verdict, _first_stop(row)))
        for r in row.reached:
            unit = {"L/V": "", "%": " %"}.get(r.target.unit, f" {r.target.unit}")
            target = f"{r.target.over} ≤ {r.target.limit:g}{unit}"
            name = FIGURE_NAMES.get(r.target.figure, r.target.figure)
            met = "met" if r.met else "MISSED"
            lines.append(("", name, target, fixed(r.mean, 3), fixed(r.worst, 3), met, r.worst_run))
    return lines


def _first_stop(row: RowResult) -> str:
    for c in row.cases:
        for seed, m in zip(c.seeds, c.metrics, strict=True):
            if not m.completed:
                return f"{c.case.name} seed {seed}: {m.reason or m.phase}"
    return ""


def compared_lines(results: Iterable[CaseResult]) -> list[tuple[str, ...]]:
    """The laws side by side: seam, law, mean, largest, peak turning rate, speed range, weld outside the band, completed."""
    lines: list[tuple[str, ...]] = []
    for c in results:
        with np.errstate(all="ignore"):
            f = {name: c.figures(name) for name in ("mean_mm", "max_mm", "omega_rad_s", "cv_percent", "outside_mm")}
            slow, fast = c.figures("slowest_mm_s"), c.figures("fastest_mm_s")
        seam = c.case.name.removesuffix(f"-{c.case.law}")
        lines.append(
            (seam, c.case.law, fixed(_mean(f["mean_mm"]), 3), fixed(_worst(f["max_mm"]), 2), fixed(_worst(f["omega_rad_s"]), 2),
             fixed(_worst(f["cv_percent"]), 1), f"{fixed(_least(slow), 1)} to {fixed(_worst(fast), 1)}",
             fixed(_worst(f["outside_mm"]), 1), f"{c.completed} of {len(c.metrics)}")
        )  # fmt: skip
    return lines


def _mean(values: np.ndarray) -> float:
    good = values[np.isfinite(values)]
    return float(good.mean()) if len(good) else float("nan")


def _worst(values: np.ndarray) -> float:
    good = values[np.isfinite(values)]
    return float(good.max()) if len(good) else float("nan")


def _least(values: np.ndarray) -> float:
    good = values[np.isfinite(values)]
    return float(good.min()) if len(good) else float("nan")


def row_summary(row: RowResult) -> dict[str, object]:
    """A row for JSON: figures with their targets; what could not be measured is null."""
    return {
        "label": row.row.label,
        "met": row.met,
        "runs": row.runs,
        "completed": row.completed,
        "figures": {
            r.target.figure: {
                "target": r.target.limit, "over": r.target.over, "unit": r.target.unit, "mean": r.mean, "worst": r.worst,
                "met": r.met, "worst_run": r.worst_run,
            }
            for r in row.reached
        },
    }  # fmt: skip


def turn_summary(turn: TurnResult) -> dict[str, object]:
    """A turn for JSON."""
    return {f.name: getattr(turn, f.name) for f in fields(turn)} | {"named": turn.named, "stalled": turn.stalled}


def runs_csv(results: Iterable[CaseResult]) -> str:
    """One line per run: case, seed and every figure."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [f.name for f in fields(RunMetrics)]
    writer.writerow(["case", "seam", "budget", "chord_mm", "speed_mm_s", "law", "seed", *names])
    for c in results:
        for seed, m in zip(c.seeds, c.metrics, strict=True):
            head = [
                c.case.name,
                c.case.seam,
                c.case.budget,
                1e3 * c.case.chord_m,
                1e3 * c.case.speed_m_s,
                c.case.law,
                seed,
            ]
            writer.writerow([*head, *(getattr(m, name) for name in names)])
    return text.getvalue()


def run_csv(run: StudyRun) -> str:
    """One run, a line per servo tick; units in the header's names, positions in m."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    k = COLUMNS.index("phase")
    for row in run.table.tolist():
        row[k] = PHASES[int(row[k])].value
        writer.writerow([v if isinstance(v, str) else f"{v:.7g}" for v in row])
    return text.getvalue()
