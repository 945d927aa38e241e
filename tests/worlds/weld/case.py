"""One weld of the kinematic world or of the whole cell, and its figures against the true seam."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from tests.worlds.weld.budgets import BUDGETS, Budget
from tests.worlds.weld.laws import steering
from tests.worlds.weld.plant import PHASES, StudyRun, simulate
from tests.worlds.weld.seams import get_seam
from tests.worlds.weld.speed import speed_statistics
from weldcal.systems.cell import Cell
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.jobs.weld.settings import seated_tip
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.weld import true_seam
from weldcal.welding.numerics import Array
from weldcal.welding.record.process import ProcessLogError, path_error
from weldcal.welding.record.welded_seam import evenness
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.seam.feasibility import SeamWindows
from weldcal.welding.servo.settings import TORCH_ABOVE_ROOT_M, ServoConfig, ToolGeometry, TouchOnConfig
from weldcal.welding.servo.state import Phase

_WELDING = [PHASES.index(p) for p in (Phase.TRACK, Phase.COAST, Phase.FINISH)]


@dataclass(frozen=True, kw_only=True)
class RunMetrics:
    """Figures of one run; mm, mm/s, rad/s and degrees, since people read them. NaN where there is none.

    Attributes:
        completed: ended DONE, the arc lit once and burning from one end of the true seam to the other, each within 10
            mm (a plan's error along the seam cannot be felt; start_mm and stop_mm say where), and never 5 mm off it;
            phase, reason: how it ended.
        reached_mm: how far along the true seam the torch came.
        mean_mm, max_mm: torch to true line, sideways, where the arc burned within 0..L of the true seam; height_mm:
            largest.
        end_mm: largest over the last chord; gap_mm: over the gap and the 60 mm after it.
        cv_percent, outside_mm, slowest_mm_s, fastest_mm_s: torch speed where the arc burned, and its +-25 % band.
        time_ratio: time of the weld over its length at the wanted speed.
        omega_rad_s, tip_speed_mm_s: largest commanded; end_step_mm_s: largest step between ticks from the seam's end
            on.
        work_deg: largest lean across the chord against the normal at the torch; travel_deg: largest pitch of the chord
            against the surface at the torch; travel_error_deg: against what the chord map of the plan predicts.
        space_mean_mm, space_mm: mean and largest distance in space; start_mm, stop_mm: where the arc went on and off,
            along the true seam (from its start, and past its end).
        gain: the tag's gain as calibrated.
    """

    completed: bool
    phase: str
    reason: str
    reached_mm: float
    mean_mm: float = math.nan
    max_mm: float = math.nan
    height_mm: float = math.nan
    space_mean_mm: float = math.nan
    space_mm: float = math.nan
    end_mm: float = math.nan
    gap_mm: float = math.nan
    cv_percent: float = math.nan
    outside_mm: float = math.nan
    slowest_mm_s: float = math.nan
    fastest_mm_s: float = math.nan
    time_ratio: float = math.nan
    omega_rad_s: float = math.nan
    tip_speed_mm_s: float = math.nan
    end_step_mm_s: float = math.nan
    work_deg: float = math.nan
    travel_deg: float = math.nan
    travel_error_deg: float = math.nan
    start_mm: float = math.nan
    stop_mm: float = math.nan
    gain: float = math.nan


def judge(
    run: StudyRun,
    weld_speed_m_s: float,
    chord_m: float,
    gaps: tuple[tuple[float, float], ...] = (),
    deflection_m: float = 2.0e-3,
) -> RunMetrics:
    """Return the figures of a run.

    Args:
        weld_speed_m_s: wanted torch speed; chord_m: |d|; gaps: (from, to) m of the true seam; deflection_m: delta_d.
    """
    phase = run.column("phase").astype(int)
    moving = np.isin(phase, _WELDING)
    reason = run.reason or ""
    if moving.sum() < 10:
        return RunMetrics(completed=False, phase=str(run.phase), reason=reason, reached_mm=0.0)
    length = run.torch_line.length
    torch = run.points("torch")[moving]
    error = path_error(torch, run.torch_line)
    burning = run.column("torch_on")[moving] > 0.5
    on_seam = (error.s >= 0.0) & (error.s <= length) & burning
    reached = float(error.s.max())
    omega, speed = run.column("omega_rad_s")[moving], run.column("tip_speed_m_s")[moving]
    extremes = {"omega_rad_s": float(np.max(np.abs(omega))), "tip_speed_mm_s": 1e3 * float(np.max(np.abs(speed)))}
    if not on_seam.any():
        return RunMetrics(completed=False, phase=str(run.phase), reason=reason, reached_mm=1e3 * reached, **extremes)
    s, side, height = error.s[on_seam], np.abs(error.lateral[on_seam]), np.abs(error.height[on_seam])
    figures: dict[str, float] = {
        "mean_mm": 1e3 * float(side.mean()),
        "max_mm": 1e3 * float(side.max()),
        "height_mm": 1e3 * float(height.max()),
        "space_mean_mm": 1e3 * float(np.hypot(side, height).mean()),
        "space_mm": 1e3 * float(np.hypot(side, height).max()),
        "gain": run.state.gain,
        **extremes,
    }
    last = s > length - chord_m
    if last.any():
        figures["end_mm"] = 1e3 * float(side[last].max())
    for low, high in gaps:
        near = (s > low) & (s < high + 0.060)
        if near.any():
            figures["gap_mm"] = 1e3 * float(side[near].max())
    figures |= _speed(run, weld_speed_m_s, error.s, moving)
    figures |= _angles(run, chord_m, deflection_m, error.s, moving)
    finish = np.flatnonzero(phase == PHASES.index(Phase.FINISH))
    if len(finish):
        v = run.points("v")[finish[0] - 1 : finish[-1] + 1]
        figures["end_step_mm_s"] = 1e3 * float(np.linalg.norm(np.diff(v, axis=0), axis=1).max())
    lit = np.flatnonzero(np.diff(burning.astype(int)) == 1)
    whole = len(lit) == 1 and float(error.s[lit[0] + 1]) <= 10e-3 and float(error.s[burning][-1]) >= length - 10e-3
    completed = run.phase == Phase.DONE and whole and figures["max_mm"] < 5.0
    return RunMetrics(completed=completed, phase=str(run.phase), reason=reason, reached_mm=1e3 * reached, **figures)


def _speed(run: StudyRun, weld_speed_m_s: float, s: Array, moving: NDArray[np.bool_]) -> dict[str, float]:
    on = run.column("torch_on") > 0.5
    burning = on[moving]
    found: dict[str, float] = {}
    if burning.any():
        found["start_mm"] = 1e3 * float(s[burning][0])
        found["stop_mm"] = 1e3 * float(s[burning][-1] - run.torch_line.length)
    try:
        speed = speed_statistics(run.column("time_s"), run.points("torch"), on, weld_speed_m_s)
    except ProcessLogError:
        return found
    return found | {
        "cv_percent": 100.0 * speed.cv,
        "outside_mm": 1e3 * speed.outside_m,
        "slowest_mm_s": 1e3 * speed.least,
        "fastest_mm_s": 1e3 * speed.most,
        "time_ratio": speed.seconds * weld_speed_m_s / max(speed.welded_m, 1e-9),
    }


def _angles(
    run: StudyRun, chord_m: float, deflection_m: float, s: Array, moving: NDArray[np.bool_]
) -> dict[str, float]:
    """Work and travel angle against the true surface at the torch, and the travel angle that the true seam predicts."""
    on_seam = (s >= 0.0) & (s <= run.torch_line.length - chord_m)
    if not on_seam.any():
        return {}
    up = run.torch_line.up(s[on_seam])
    lean, pitch = (np.degrees(a) for a in run.angles(np.flatnonzero(moving)[on_seam], up))
    chart = chord_map(run.torch_line, chord_m, 0.008, spacing=1e-3, tip_left=deflection_m)
    predicted = np.degrees(chart.travel_at(s[on_seam]))
    return {
        "work_deg": float(np.abs(lean).max()),
        "travel_deg": float(np.abs(pitch).max()),
        "travel_error_deg": float(np.abs(pitch - predicted).max()),
    }


@dataclass(frozen=True)
class WeldCase:
    """One weld to be repeated over the seeds: seam, budget, chord m, torch speed m/s, gaps (from, to) m, law."""

    seam: str
    budget: str = "nominal"
    chord_m: float = 0.060
    speed_m_s: float = 0.008
    gaps: tuple[tuple[float, float], ...] = ()
    law: str = "guarded"

    @property
    def errors(self) -> Budget:
        """The error budget by its name."""
        return BUDGETS[self.budget]

    @property
    def name(self) -> str:
        """Short and unique: also the name of its CSV files."""
        parts = [self.seam, f"d{1e3 * self.chord_m:.0f}"]
        parts += [f"{1e3 * self.speed_m_s:.0f}mms"] if self.speed_m_s != 0.008 else []
        parts += [f"gap{1e3 * (b - a):.0f}" for a, b in self.gaps]
        return "-".join([*parts, self.budget, *([self.law] if self.law != "guarded" else [])])


def study_config(case: WeldCase) -> ServoConfig:
    """The servo's settings for a case: everything at its default but chord, speed, law and the touch-on calibration.

    The paper's laws watch neither the torch's place nor its angles, so these are set wide open: they are to show what
    they do.
    """
    config = ServoConfig(
        tool=ToolGeometry(torch_offset_m=case.chord_m),
        touch=TouchOnConfig(calibrate_gain=True, zero_frames=30, feel_start=True),
        weld_speed_m_s=case.speed_m_s,
    )
    if case.law == "guarded":
        return config
    open_wide = SeamWindows(travel_rad=math.pi, work_rad=math.pi)
    return replace(
        config,
        torch=replace(config.torch, ignition_error_m=1.0),
        faults=replace(config.faults, torch_error_m=1.0),
        windows=open_wide,
        touch=replace(config.touch, feel_start=False),
    )


def run_case(case: WeldCase, seed: int) -> tuple[StudyRun, RunMetrics]:
    """One weld and its figures."""
    with steering(case.law):
        run = simulate(get_seam(case.seam), case.errors, study_config(case), seed, case.gaps)
    return run, judge(run, case.speed_m_s, case.chord_m, case.gaps)


@dataclass(frozen=True, kw_only=True)
class CellRun:
    """One weld.

    Lengths in mm: seam points sideways and in height against where the tool's numbers say a seated tip is felt (sd
    about a smooth line through themselves, and mean); torch against the true line, sideways and in space; its speed's
    coefficient of variation in %.
    """

    scenario: str
    seed: int
    completed: bool
    reason: str
    point_sd_mm: float = np.nan
    point_offset_mm: float = np.nan
    height_sd_mm: float = np.nan
    height_offset_mm: float = np.nan
    torch_mean_mm: float = np.nan
    torch_max_mm: float = np.nan
    space_max_mm: float = np.nan
    cv_percent: float = np.nan
    real_time_factor: float = np.nan


@dataclass(frozen=True, eq=False)
class FeltSeam:
    """The points (N,) m of the refined seam.

    Arc length on the true seam, and distance to the left of and above the nominal line of a seated tip's measured
    centre.
    """

    s: Array
    lateral: Array
    height: Array


def felt_seam(cell: Cell[WeldJob], root: Context) -> FeltSeam | None:
    """The seam points that the servo measured with the tip, against the ground truth; None where there are none."""
    number = cell.job.command(root).seam
    state, seam = cell.job.servo_report(root).state, true_seam(cell.station.truth, number)
    if state is None or seam is None or len(state.refined) < 10:
        return None
    seat = seated_tip(cell.station, number)
    line = seam.raised(seat.above_m - TORCH_ABOVE_ROOT_M, seat.aside_m)
    found = path_error(state.refined.points, line)
    return FeltSeam(found.s, found.lateral, found.height)


def figures(result: DemoResult, name: str, seed: int) -> CellRun:
    """Return the figures of a finished run, in mm."""
    run, weld = result.run, result.weld
    felt: FeltSeam | None = felt_seam(run.cell, run.root)
    if weld is None or weld.error is None or felt is None or result.record is None:
        return CellRun(scenario=name, seed=seed, completed=False, reason=run.reason or "nothing was welded")
    return CellRun(
        scenario=name,
        seed=seed,
        completed=not run.held,
        reason=run.reason or "",
        point_sd_mm=1e3 * scatter(felt.lateral),
        point_offset_mm=1e3 * float(felt.lateral.mean()),
        height_sd_mm=1e3 * scatter(felt.height),
        height_offset_mm=1e3 * float(felt.height.mean()),
        torch_mean_mm=1e3 * weld.error.mean_m,
        torch_max_mm=1e3 * weld.error.max_m,
        space_max_mm=1e3 * float(np.hypot(weld.error.lateral, weld.error.height).max()),
        cv_percent=1e2 * evenness(result.record.log),
        real_time_factor=run.real_time_factor("weld"),
    )


def scatter(values: Array, window: int = 31) -> float:
    """Standard deviation of a series about a smooth line through itself: quadratics over `window` neighbours."""
    from scipy.signal import savgol_coeffs, savgol_filter

    if len(values) <= window:
        return float(np.std(values))
    gap = values - savgol_filter(values, window, 2)
    # A point pulls its own line towards itself by its weight in it.
    own = savgol_coeffs(window, 2)[window // 2]
    return float(np.sqrt(np.mean(gap**2) / (1.0 - own)))
