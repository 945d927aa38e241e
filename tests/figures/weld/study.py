"""Runs the weld study: its target table, the turns, the comparison of the laws, and one pictured run of each seam."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, astuple, fields
from pathlib import Path
from typing import Annotated

import numpy as np

from tests.figures.harness import RUNS, Figures, Measured, Study, Target, verdict
from tests.figures.weld.rows import (
    CHORDS,
    COMPARED,
    TURNS,
    CaseResult,
    RowResult,
    TurnResult,
    get_rows,
    measure_row,
    run_cases,
    run_turn,
)
from tests.worlds.weld.case import RunMetrics, WeldCase, study_config
from tests.worlds.weld.plant import COLUMNS, PHASES, StudyRun
from weldcal.tools.cli.options import Call, Outcome, command, option, switch
from weldcal.tools.console import Progress
from weldcal.tools.report.plots_weld import WeldTrace, along_the_weld, paths
from weldcal.tools.report.render import csv_text, fixed, write_atomic
from weldcal.welding.record.process import path_error, speed_along
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase

COMPARED_SEEDS = 3


@command("reproduce weld", short_help="Run the weld law in a small kinematic world.")
def weld(
    call: Call,
    seeds: Annotated[int, option("--seeds", "N", "Number of seeds of each weld.", min=1)] = 10,
    rows: Annotated[str, option("--rows", "NAMES", "Only these rows, separated by commas.", show_default="all")] = "",
    quick: Annotated[
        bool, switch("--quick", "Two seeds of each weld, and two for the comparison of the laws.")
    ] = False,
) -> Outcome:
    """Run the weld law in a small kinematic world: every target, the published law for comparison, figures."""
    folder, number = call.folder("reproduce", "weld"), min(seeds, 2) if quick else seeds
    names = tuple(name.strip() for name in rows.split(",") if name.strip())
    return run_study(folder, names, number, call.seed, quick, call.progress).outcome()


def run_study(
    folder: Path, names: tuple[str, ...], count: int, first: int, quick: bool, progress: Progress
) -> Measured:
    """Run the rows of those names (all when none) with ``count`` seeds from ``first`` on.

    Writes the tables, runs.csv, and one CSV and two pictures per pictured run.
    """
    start = time.monotonic()
    everything = not names
    rows = get_rows(names)
    wanted = [case for row in rows for case in row.cases]
    seeds = tuple(range(first, first + count))
    pictured: dict[str, tuple[WeldCase, StudyRun]] = {}

    def keep(case: WeldCase, seed: int, run: StudyRun, figures: RunMetrics) -> None:
        # One run of each seam is drawn: the first seed, ours, nominal, as far as there is one.
        if seed == first and case.law == "guarded" and case.seam not in pictured:
            pictured[case.seam] = (case, run)

    results = run_cases(wanted, seeds, keep, lambda name, share: progress(name, 0.7 * share))
    turns: list[TurnResult] = []
    if everything or "turns" in names:
        chords = CHORDS[1:2] if quick else CHORDS
        pairs = [(name, chord) for name in TURNS for chord in chords]
        for k, (name, chord) in enumerate(pairs):
            progress(name, 0.7 + 0.05 * k / len(pairs))
            turns.append(run_turn(name, chord, first))
    compared: dict[WeldCase, CaseResult] = {}
    if everything or "laws" in names:
        few = seeds[: 1 if quick else COMPARED_SEEDS]
        compared = run_cases(COMPARED, few, keep, lambda name, share: progress(name, 0.75 + 0.25 * share), results)
    measured = [measure_row(row, results) for row in rows] if results else []
    write_atomic(folder / RUNS, runs_csv([*results.values(), *compared.values()]))
    for case, run in pictured.values():
        trace = weld_trace(run, study_config(case))
        write_atomic(folder / "runs" / f"{case.name}.csv", run_csv(run))
        write_atomic(folder / "figures" / f"{case.name}_paths.svg", paths(trace))
        write_atomic(folder / "figures" / f"{case.name}_along.svg", along_the_weld(trace))
    figures = {
        "met": all(r.met for r in measured) and all(t.named and not t.stalled for t in turns),
        "seeds": count,
        "first_seed": first,
        "rows": {r.row.key: _row_summary(r) for r in measured},
        "turns": [asdict(t) | {"named": t.named, "stalled": t.stalled} for t in turns],
        "laws": [
            {"case": c.case.name, "law": c.case.law, "completed": c.completed, "runs": c.metrics}
            for c in compared.values()
        ],
        "wall_seconds": time.monotonic() - start,
        "written_to": folder,
    }
    study = Study(
        name="weld",
        what="The weld law in a small kinematic world: every target, turns, and the published law for comparison.",
        figures=lambda results: figures,
        header=("what", "figure", "target", "mean", "worst", "", "worst run"),
        rows=lambda figures: table_lines(measured),
        others=lambda figures: (
            ("Turns, U-turns and cusps", TURN_HEADER, turn_lines(turns)),
            ("Comparison of the laws", LAW_HEADER, compared_lines(compared.values())),
        ),
        targets=_missed,
        group="reproduce",
    )
    return study.measured({}, folder)


def _missed(figures: Figures) -> list[Target]:
    """Every weld is to be completed, every target met, and every impossible turn refused."""
    bad = [row for row in figures["rows"].values() if not row["met"]]
    bad += [turn for turn in figures["turns"] if not turn["named"] or turn["stalled"]]
    return [Target("rows and turns that missed", "", len(bad), 0.0)]


def _row_summary(row: RowResult) -> dict[str, object]:
    return {
        "label": row.row.label,
        "met": row.met,
        "runs": row.runs,
        "completed": row.completed,
        "figures": {
            r.target.figure: {
                "target": r.target.limit,
                "over": r.target.over,
                "unit": r.target.unit,
                "mean": r.mean,
                "worst": r.worst,
                "met": r.met,
                "worst_run": r.worst_run,
            }
            for r in row.reached
        },
    }


FIGURE_NAMES = {
    "mean_mm": "torch, mean",
    "max_mm": "torch, largest",
    "space_mm": "torch in space, largest",
    "space_mean_mm": "torch in space, mean",
    "height_mm": "torch height, largest",
    "end_mm": "last chord, largest",
    "gap_mm": "gap and 60 mm after, largest",
    "cv_percent": "torch speed CV",
    "time_ratio": "time over L/V",
    "omega_rad_s": "turning rate",
    "tip_speed_mm_s": "tip speed",
    "end_step_mm_s": "robot's velocity step",
    "work_deg": "work angle",
    "travel_error_deg": "travel angle against prediction",
}


TURN_HEADER = ("seam", "chord mm", "turn deg", "back-up mm", "for a trailing torch", "what was done")
LAW_HEADER = (
    "weld",
    "law",
    "mean mm",
    "largest mm",
    "omega rad/s",
    "speed CV %",
    "torch mm/s",
    "outside ±25 % mm",
    "completed",
)


def table_lines(rows: Iterable[RowResult]) -> list[tuple[str, str, str, str, str, str, str]]:
    """Return the target table as text: what, figure, target, mean, worst, whether met, and the worst run."""
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
    """Compare the laws: seam, law, mean, largest, peak turn rate, speed range, weld outside the band, completed."""

    def over_runs(c: CaseResult, name: str, digits: int, statistic: Callable[[np.ndarray], object] = np.max) -> str:
        good = c.figures(name)[np.isfinite(c.figures(name))]
        return fixed(float(statistic(good)) if len(good) else None, digits)  # type: ignore[arg-type]

    return [
        (
            c.case.name.removesuffix(f"-{c.case.law}"),
            c.case.law,
            over_runs(c, "mean_mm", 3, np.mean),
            over_runs(c, "max_mm", 2),
            over_runs(c, "omega_rad_s", 2),
            over_runs(c, "cv_percent", 1),
            f"{over_runs(c, 'slowest_mm_s', 1, np.min)} to {over_runs(c, 'fastest_mm_s', 1)}",
            over_runs(c, "outside_mm", 1),
            f"{c.completed} of {len(c.metrics)}",
        )
        for c in results
    ]


def turn_lines(turns: Iterable[TurnResult]) -> list[tuple[str, ...]]:
    """One line per turn and chord."""
    return [
        (
            t.seam,
            fixed(t.chord_mm, 0),
            fixed(t.turn_deg, 0),
            fixed(t.back_up_mm, 1),
            "possible" if t.possible else "impossible",
            t.outcome,
        )
        for t in turns
    ]


_EVERY = 4  # ticks per plotted point: 0.26 mm at 8 mm/s
_BENT_RAD = math.radians(1.0)  # a surface whose normal turns by less is flat


def weld_trace(run: StudyRun, config: ServoConfig) -> WeldTrace:
    """Return the run for the pictures, over the true seam; angles only where the surface bends."""
    phase = run.column("phase").astype(int)
    moving = np.flatnonzero((phase != PHASES.index(Phase.TOUCH)) & np.isfinite(run.column("n_d_dot_n_t")))
    keep = moving[::_EVERY]
    torch, line = run.points("torch"), run.torch_line
    off = path_error(torch[keep], line)
    on = (off.s >= 0.0) & (off.s <= line.length)
    plan = run.planned.position(np.linspace(0.0, run.planned.length, 400))
    plan_off = path_error(plan, line)
    work = travel = predicted = None
    up = line.up(np.clip(off.s, 0.0, line.length))
    if float(np.min(up @ up[0], initial=1.0)) < math.cos(_BENT_RAD):
        seen = on & (off.s <= line.length - config.tool.torch_offset_m)
        lean, pitch = run.angles(keep, up)
        chart = chord_map(
            line, config.tool.torch_offset_m, config.weld_speed_m_s, spacing=1e-3, tip_left=config.deflection.delta_d_m
        )
        work, travel = (np.where(seen, angle, np.nan) for angle in (lean, pitch))
        predicted = np.where(seen, chart.travel_at(off.s), np.nan)
    speed = speed_along(run.column("time_s")[moving], torch[moving])[::_EVERY]
    return WeldTrace(
        s=off.s,
        torch_on=run.column("torch_on")[keep] > 0.5,
        felt=phase[keep] == PHASES.index(Phase.TRACK),
        tip=run.points("tip")[keep],
        torch=torch[keep],
        robot=run.points("robot")[keep],
        planned=np.asarray(plan),
        true=np.asarray(line.position(np.linspace(0.0, line.length, 400))),
        plan_error=(plan_off.s, plan_off.lateral, plan_off.height),
        torch_error=(off.s[on], off.lateral[on], off.height[on]),
        delta_n=run.column("delta_n_m")[keep],
        delta_axial=run.column("delta_axial_m")[keep],
        speed=speed,
        omega=run.column("omega_rad_s")[keep],
        n_d_dot_n_t=run.column("n_d_dot_n_t")[keep],
        weld_speed=config.weld_speed_m_s,
        delta_d=config.deflection.delta_d_m,
        axial_d=config.deflection.axial_d_m,
        omega_max=config.limits.omega_max_rad_s,
        work=work,
        travel=travel,
        predicted=predicted,
        windows=(config.windows.work_rad, config.windows.travel_rad),
    )


def runs_csv(results: Iterable[CaseResult]) -> str:
    """One line per run: case, seed and every figure."""
    header = ["case", "seam", "budget", "chord_mm", "speed_mm_s", "law", "seed", *(f.name for f in fields(RunMetrics))]
    lines: list[tuple[object, ...]] = []
    for result in results:
        c = result.case
        head = (c.name, c.seam, c.budget, 1e3 * c.chord_m, 1e3 * c.speed_m_s, c.law)
        lines += [(*head, seed, *astuple(m)) for seed, m in zip(result.seeds, result.metrics, strict=True)]
    return csv_text(header, lines)


def run_csv(run: StudyRun) -> str:
    """One run, a line per servo tick; units in the header's names, positions in m."""
    k = COLUMNS.index("phase")
    lines = [[f"{v:.7g}" for v in row] for row in run.table.tolist()]
    for line, phase in zip(lines, run.column("phase"), strict=True):
        line[k] = PHASES[int(phase)].value
    return csv_text(COLUMNS, lines)
