"""Runs the weld study: its target table, the turns, the comparison of the laws, and one pictured run of each seam."""

import math
from collections.abc import Callable, Iterable
from dataclasses import astuple, fields

import numpy as np

from tests.figures.harness import Missed, Run, figure
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
from tests.worlds.weld.plant import PHASES, StudyRun
from weldcal.tools.report.plots_weld import WeldTrace, along_the_weld, paths
from weldcal.tools.report.render import csv_text, fixed
from weldcal.welding.record.process import path_error, speed_along
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase


def study(run: Run, names: tuple[str, ...]) -> None:
    """Run the rows of those names (all when none): tables, runs.csv, and two pictures of a run of each seam."""
    rows, seeds = get_rows(names), tuple(run.seeds(1, 10))
    pictured: dict[str, tuple[WeldCase, StudyRun]] = {}

    def keep(case: WeldCase, seed: int, found: StudyRun, figures: RunMetrics) -> None:
        # One run of each seam is drawn: the first seed, ours, nominal, as far as there is one.
        if seed == run.seed and case.law == "guarded" and case.seam not in pictured:
            pictured[case.seam] = (case, found)

    results = run_cases([case for row in rows for case in row.cases], seeds, keep, run.progress)
    measured = [measure_row(row, results) for row in rows] if results else []
    run.table("", ("what", "figure", "target", "mean", "worst", "", "worst run"), table_lines(measured))
    turns: list[TurnResult] = []
    if not names or "turns" in names:
        chords = run.size(CHORDS[1:2], CHORDS)
        turns = [run_turn(name, chord, run.seed) for name in TURNS for chord in chords]
        run.table("Turns, U-turns and cusps", TURN_HEADER, turn_lines(turns))
    compared: dict[WeldCase, CaseResult] = {}
    if not names or "laws" in names:
        compared = run_cases(COMPARED, seeds[:3], keep, run.progress, results)
        run.table("Comparison of the laws", LAW_HEADER, compared_lines(compared.values()))
    run.write("runs.csv", runs_csv([*results.values(), *compared.values()]))
    for case, weld in pictured.values():
        trace = weld_trace(weld, study_config(case))
        run.write(f"{case.name}_paths.svg", paths(trace))
        run.write(f"{case.name}_along.svg", along_the_weld(trace))
    missed = sum(not r.met for r in measured) + sum(not t.named or t.stalled for t in turns)
    if missed:
        raise Missed(f"{missed} rows or turns missed their targets; see the tables.")


@figure("weld", "the weld law in a small kinematic world: every target, turns, the published laws beside it")
def weld(run: Run) -> None:
    """Run all rows; in the quick form one seed of each weld."""
    study(run, ())


@figure("weld-imperfect", "the weld law where time stamps, walls, tip radius, seat and lag have errors")
def weld_imperfect(run: Run) -> None:
    """Run the row of the imperfect world."""
    study(run, ("imperfect",))


@figure("weld-laws", "the steering laws of the paper beside weldcal's")
def weld_laws(run: Run) -> None:
    """Compare the laws."""
    study(run, ("laws",))


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


def verdict(met: bool) -> str:
    """Return the word for a target that is met or missed."""
    return "met" if met else "MISSED"


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
