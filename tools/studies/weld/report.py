"""Tables and report page of the weld study: targets, turns, pictures of every seam, and the laws."""

from collections.abc import Callable, Iterable

import numpy as np

from weldcal.tools.report.plots_weld import along_the_weld, paths
from weldcal.tools.report.render import fixed, render
from weldcal.tools.studies.output import print_note, print_table
from weldcal.tools.studies.targets import verdict
from weldcal.tools.studies.weld.plots import weld_trace
from weldcal.tools.studies.weld.results import Study
from weldcal.tools.studies.weld.study import CaseResult, RowResult
from weldcal.tools.studies.weld.turns import TurnResult
from weldcal.tools.worlds.weld.case import study_config

FIGURE_NAMES = {
    "mean_mm": "torch, mean", "max_mm": "torch, largest", "space_mm": "torch in space, largest",
    "height_mm": "torch height, largest", "end_mm": "last chord, largest",
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


TITLES = {
    "straight": "Straight", "s_r60": "S of radius 60 mm", "l_r20_convex": "Corner of 20 mm, convex",
    "l_r20_concave": "Corner of 20 mm, concave", "l_r5_convex": "Corner of 5 mm, convex", "l_r5_concave": "Corner of 5 mm, concave",
    "l_r1_convex": "Corner of 1 mm, convex", "l_r1_concave": "Corner of 1 mm, concave", "arc_r60_end": "Ending on an arc of 60 mm",
}  # fmt: skip
_CARDS = (
    ("imperfect", "mean_mm"),
    ("imperfect", "max_mm"),
    ("imperfect", "height_mm"),
    ("imperfect_corners", "max_mm"),
)


def study_report(study: Study) -> str:
    """The whole report as one self-contained HTML text."""
    lines = table_lines(study.rows)
    missed = sum(line[5] != "met" for line in lines) + sum(not t.named or t.stalled for t in study.turns)
    total = len(lines) + len(study.turns)
    seams = [
        {
            "title": TITLES.get(case.seam, case.seam.replace("_", " ")),
            "sentence": f"{case.name}, seed {study.options.first_seed}: mean {fixed(m.mean_mm, 3)} mm, largest "
            f"{fixed(m.max_mm, 3)} mm, torch speed CV {fixed(m.cv_percent, 1)} %, turning rate up to {fixed(m.omega_rad_s, 2)} rad/s.",
            "paths": paths(trace),
            "along": along_the_weld(trace),
            "bent": trace.work is not None,
        }
        for case, trace, m in ((case, weld_trace(run, study_config(case)), m) for case, run, m in study.pictured)
    ]
    usual = any(row.row.key == key for row in study.rows for key, _ in _CARDS)
    cards = [
        (row.row.label, FIGURE_NAMES[r.target.figure], r)
        for row in study.rows
        for r in row.reached
        if ((row.row.key, r.target.figure) in _CARDS if usual else r == row.reached[0])
    ]
    return render(
        "weld_study.html.j2",
        cards=cards,
        study=study,
        lines=lines,
        missed=missed,
        total=total,
        seams=seams,
        turns=turn_lines(study.turns),
        compared=compared_lines(study.compared),
    )
