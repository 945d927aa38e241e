"""Tables of the weld study for the terminal and the report: targets, turns and laws."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from weldcal.tools.report.render import fixed
from weldcal.tools.studies.output import print_note, print_table
from weldcal.tools.studies.targets import verdict
from weldcal.tools.studies.weld.results import Study
from weldcal.tools.studies.weld.study import CaseResult, RowResult
from weldcal.tools.studies.weld.turns import TurnResult

FIGURE_NAMES = {
    "mean_mm": "torch, mean", "max_mm": "torch, largest", "space_mm": "torch in space, largest", "end_mm": "last chord, largest",
    "gap_mm": "gap and 60 mm after, largest", "cv_percent": "torch speed CV", "time_ratio": "time over L/V",
    "omega_rad_s": "turning rate", "tip_speed_mm_s": "tip speed", "end_step_mm_s": "robot's velocity step",
    "work_deg": "work angle", "travel_error_deg": "travel angle against prediction",
}  # fmt: skip


TURN_HEADER = ("seam", "chord mm", "turn deg", "back-up mm", "for a trailing torch", "what was done")
LAW_HEADER = (
    "weld", "law", "mean mm", "largest mm", "omega rad/s", "speed CV %", "torch mm/s", "outside ±25 % mm", "completed",
)  # fmt: skip


def table_lines(rows: Iterable[RowResult]) -> list[tuple[str, str, str, str, str, str, str]]:
    """The target table as text: what, figure, target, mean, worst, whether met, and the worst run."""
    lines = []
    for row in rows:
        done = f"{row.completed} of {row.runs}"
        lines.append(
            (row.row.label, "completed", "all", done, "", verdict(row.completed == row.runs), _first_stop(row))
        )
        for r in row.reached:
            unit = {"L/V": "", "%": " %"}.get(r.target.unit, f" {r.target.unit}")
            target = f"{r.target.over} ≤ {r.target.limit:g}{unit}"
            name = FIGURE_NAMES.get(r.target.figure, r.target.figure)
            lines.append(("", name, target, fixed(r.mean, 3), fixed(r.worst, 3), verdict(r.met), r.worst_run))
    return lines


def _first_stop(row: RowResult) -> str:
    for c in row.cases:
        for seed, m in zip(c.seeds, c.metrics, strict=True):
            if not m.completed:
                return f"{c.case.name} seed {seed}: {m.reason or m.phase}"
    return ""


def compared_lines(results: Iterable[CaseResult]) -> list[tuple[str, ...]]:
    """The laws in comparison: seam, law, mean, largest, peak turning rate, speed range, weld outside the band, completed."""

    def over_runs(c: CaseResult, name: str, digits: int, statistic: Callable[[np.ndarray], object] = np.max) -> str:
        good = c.figures(name)[np.isfinite(c.figures(name))]
        return fixed(float(statistic(good)) if len(good) else None, digits)  # type: ignore[arg-type]

    return [
        (c.case.name.removesuffix(f"-{c.case.law}"), c.case.law, over_runs(c, "mean_mm", 3, np.mean),
         over_runs(c, "max_mm", 2), over_runs(c, "omega_rad_s", 2), over_runs(c, "cv_percent", 1),
         f"{over_runs(c, 'slowest_mm_s', 1, np.min)} to {over_runs(c, 'fastest_mm_s', 1)}",
         over_runs(c, "outside_mm", 1), f"{c.completed} of {len(c.metrics)}")
        for c in results
    ]  # fmt: skip


def turn_lines(turns: Iterable[TurnResult]) -> list[tuple[str, ...]]:
    """One line per turn and chord."""
    return [
        (t.seam, fixed(t.chord_mm, 0), fixed(t.turn_deg, 0), fixed(t.back_up_mm, 1),
         "possible" if t.possible else "impossible", t.outcome)
        for t in turns
    ]  # fmt: skip


def print_study(study: Study) -> None:
    """Write the tables on stdout."""
    lines = table_lines(study.rows)
    if lines:
        header = ("what", "figure", "target", "mean", "worst", "")
        print_table("Reached against targets", header, [line[:6] for line in lines], text=(0, 1, 2, 5))
        for line in lines:
            if line[5] == "MISSED":
                print_note(f"missed: {line[1]}, target {line[2]}: {line[6]}")
    if study.turns:
        print_table("Turns, U-turns and cusps", TURN_HEADER, turn_lines(study.turns), text=(0, 4, 5))
    if study.compared:
        print_table("Comparison of the laws", LAW_HEADER, compared_lines(study.compared), text=(0, 1, 6))
    print_note(f"written to {study.options.folder}")
