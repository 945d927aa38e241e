"""Runs the weld study: its target table, the turns, the comparison of the laws, and one pictured run of each seam."""

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import Any

import numpy as np

from tests.figures.harness import Missed, Row, Run, figure
from tests.figures.weld.rows import (
    CHORDS,
    COMPARED,
    TURNS,
    Runs,
    TurnResult,
    get_rows,
    hold_against,
    run_cases,
    run_turn,
)
from tests.worlds.weld.case import WeldCase, study_config
from tests.worlds.weld.plant import PHASES, StudyRun
from weldcal.tools.report.plots_weld import WeldTrace, along_the_weld, paths
from weldcal.tools.report.render import fixed, mappings_csv
from weldcal.welding.record.process import path_error, speed_along
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase


def study(run: Run, names: tuple[str, ...]) -> None:
    """Run the rows of those names (all when none): tables, runs.csv, and two pictures of a run of each seam."""
    rows, seeds = get_rows(names), tuple(run.seeds(1, 10))
    pictured: dict[str, tuple[WeldCase, StudyRun]] = {}

    def keep(case: WeldCase, seed: int, found: StudyRun) -> None:
        # One run of each seam is drawn: the first seed, ours, nominal, as far as there is one.
        if seed == run.seed and case.law == "guarded":
            pictured.setdefault(case.seam, (case, found))

    runs: Runs = {}
    lines, missed = [], 0
    for row in rows:
        of = run_cases(row.cases, seeds, keep, run.progress, runs)
        broken = [
            f"{case.name} seed {s}: {m.reason or m.phase}"
            for case in of
            for s, m in of[case].items()
            if not m.completed
        ]
        whole = len(of) * len(seeds)
        done = f"{whole - len(broken)} of {whole}"
        lines.append((row.label, "completed", "all", done, "", verdict(not broken), "".join(broken[:1])))
        missed += len(broken)
        for r in (hold_against(target, of) for target in row.targets):
            name, unit = FIGURE_NAMES[r.target.figure]
            bound = f"{r.target.over} ≤ {r.target.limit:g}{unit}"
            lines.append(("", name, bound, fixed(r.mean, 3), fixed(r.worst, 3), verdict(r.met), r.worst_run))
            missed += not r.met
    run.table("", ("what", "figure", "target", "mean", "worst", "", "worst run"), lines)
    if not names or "turns" in names:
        chords = run.size(CHORDS[1:2], CHORDS)
        turns = [run_turn(name, chord, run.seed) for name in TURNS for chord in chords]
        run.table("Turns, U-turns and cusps", TURN_HEADER, turn_lines(turns))
        missed += sum(not t.named or t.stalled for t in turns)
    if not names or "laws" in names:
        run.table(
            "Comparison of the laws",
            LAW_HEADER,
            compared_lines(run_cases(run.size(COMPARED[:12], COMPARED), seeds[:3], keep, run.progress, runs)),
        )
    run.write("runs.csv", runs_csv(runs))
    for case, weld in pictured.values():
        trace = weld_trace(weld, study_config(case))
        run.write(f"{case.name}_paths.svg", paths(trace))
        run.write(f"{case.name}_along.svg", along_the_weld(trace))
    if missed:
        raise Missed(f"{missed} figures, welds or turns missed their targets; see the tables.")


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
    "mean_mm": ("torch, mean", " mm"),
    "max_mm": ("torch, largest", " mm"),
    "space_mm": ("torch in space, largest", " mm"),
    "space_mean_mm": ("torch in space, mean", " mm"),
    "height_mm": ("torch height, largest", " mm"),
    "end_mm": ("last chord, largest", " mm"),
    "gap_mm": ("gap and 60 mm after, largest", " mm"),
    "cv_percent": ("torch speed CV", " %"),
    "time_ratio": ("time over L/V", ""),
    "omega_rad_s": ("turning rate", " rad/s"),
    "tip_speed_mm_s": ("tip speed", " mm/s"),
    "end_step_mm_s": ("robot's velocity step", " mm/s"),
    "work_deg": ("work angle", " deg"),
    "travel_error_deg": ("travel angle against prediction", " deg"),
}


def verdict(met: bool) -> str:
    """Return the word for a target that is met or missed."""
    return "met" if met else "MISSED"


TURN_HEADER = ("seam", "chord mm", "turn deg", "back-up mm", "for a trailing torch", "what was done")
LAW_HEADER = (
    *("weld", "law", "mean mm", "largest mm", "omega rad/s", "speed CV %", "torch mm/s"),
    *("outside ±25 % mm", "completed"),
)


def compared_lines(runs: Runs) -> Iterable[Row]:
    """Compare the laws: seam, law, mean, largest, peak turn rate, speed range, weld outside the band, completed."""
    for case, of in runs.items():
        statistics = {
            name: [v for m in of.values() if math.isfinite(v := float(getattr(m, name)))] for name in LAW_FIGURES
        }
        values = {
            name: fixed(float(LAW_FIGURES[name][0](v)) if v else None, LAW_FIGURES[name][1])
            for name, v in statistics.items()
        }
        mean, largest, omega, cv, slowest, fastest, outside = values.values()
        done = f"{sum(m.completed for m in of.values())} of {len(of)}"
        title = case.name.removesuffix(f"-{case.law}")
        yield title, case.law, mean, largest, omega, cv, f"{slowest} to {fastest}", outside, done


LAW_FIGURES: dict[str, tuple[Callable[[list[float]], Any], int]] = {
    "mean_mm": (np.mean, 3),
    "max_mm": (np.max, 2),
    "omega_rad_s": (np.max, 2),
    "cv_percent": (np.max, 1),
    "slowest_mm_s": (np.min, 1),
    "fastest_mm_s": (np.max, 1),
    "outside_mm": (np.max, 1),
}


def turn_lines(turns: Iterable[TurnResult]) -> Iterable[Row]:
    """One line per turn and chord."""
    for t in turns:
        numbers = (fixed(t.chord_mm, 0), fixed(t.turn_deg, 0), fixed(t.back_up_mm, 1))
        yield t.seam, *numbers, "possible" if t.possible else "impossible", t.outcome


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


def runs_csv(runs: Runs) -> str:
    """One line per run: case, seed and every figure."""
    return mappings_csv(
        [
            {"case": case.name, "law": case.law, "seed": seed, **asdict(m)}
            for case in runs
            for seed, m in runs[case].items()
        ]
    )
