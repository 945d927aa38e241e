"""Live calibrations with few scans: errors, the Cramer-Rao bound, and repeats with redrawn noise."""

from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from tests.figures.harness import Row, Run, figure
from tests.worlds.light_runs import Redrawn, RedrawnStation, bound_covariance, joined, joints_of, redraw
from tests.worlds.scaled_arms import perfect
from weldcal.models.arrays import Array
from weldcal.systems.cell import build_cell
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.jobs.weld.settings import work_point
from weldcal.systems.runner import Progress, no_progress, run_cell
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.report.pictures import subplots, svg
from weldcal.tools.report.weld import calibration_error

SCENARIO = "calibrate_only"
TARGET_M, TARGET_RAD = 6e-5, float(np.radians(0.01))


@dataclass(frozen=True, kw_only=True)
class LiveRow:
    """One seed: scans used, error at the work point (m) and of the rotation (rad), and what was expected.

    Expected by the estimate (rms), the least that these poses, arm and scanner allow (rms), and the same
    calibration with noise redrawn.
    """

    seed: int
    scans: int
    at_work_m: float
    rotation_rad: float
    expected_m: float
    least_m: float
    least_rad: float
    redrawn: Redrawn


def live_scenario(repeatability_mm: float, scans: int) -> Scenario:
    """Make the scenario with an arm that repeats no better, an undistorted scanner, and exactly so many scans."""
    scenario = perfect(load_scenario(SCENARIO))
    assert isinstance(scenario.robot, SimulatedUr)
    scenario.robot.repeatability_mm = repeatability_mm
    scenario.calibration.minimum_scans = scenario.calibration.maximum_scans = scans
    check_scenario(scenario)
    return scenario


def study_live(
    seeds: int,
    *,
    first: int = 0,
    scans: int = 8,
    repeatability_mm: float = 0.05,
    redraws: int = 0,
    progress: Progress = no_progress,
) -> list[LiveRow]:
    """Calibrate through the whole Diagram once a seed, and ``redraws`` times from the same poses without it.

    Raises InputError for numbers that no cell takes, and RuntimeError where a job was held.
    """
    rows = []
    for k in range(seeds):
        seed = first + k
        progress(f"calibration {k + 1} of {seeds}", k / seeds)
        scenario = live_scenario(repeatability_mm, scans)
        cell = build_cell(scenario, seed)
        with closing(cell.station):
            run = run_cell(cell)
        status, truth = cell.job.calibration_status(run.root), cell.station.truth.X_BC
        if status.estimate is None or truth is None or run.held:
            raise RuntimeError(f"The calibration of seed {seed} did not finish: {run.reason}")
        work = work_point(scenario)
        error = calibration_error(status.estimate.X_BC, truth, work)
        found = status.observations
        joints = joints_of(found, cell.station.arm, np.deg2rad(scenario.home_deg))
        station = RedrawnStation(cell.station.arm, joints, 1e-3 * repeatability_mm, truth, np.asarray(work))
        least = np.diag(bound_covariance(found, station))
        rows.append(
            LiveRow(
                seed=seed,
                scans=len(found),
                at_work_m=error.at_work_m,
                rotation_rad=error.rotation_rad,
                expected_m=status.predicted_error_m,
                least_m=float(np.sqrt(least[3:].sum())),
                least_rad=float(np.sqrt(least[:3].sum())),
                redrawn=redraw(found, station, redraws, seed),
            )
        )
    return rows


def live_picture(rows: list[LiveRow]) -> bytes:
    """Draw the share of calibrations with no larger error: live (steps), noise redrawn, and at the bound."""
    again = joined([r.redrawn for r in rows])
    mm, deg = 1e3, float(np.degrees(1.0))
    figure, axes = subplots(8.2, 3.6, 1, 2, sharey=True)
    panels = (
        (again.at_work_m, again.bound_at_work_m, [r.at_work_m for r in rows], mm, TARGET_M, "at the work point, mm"),
        (
            again.rotation_rad,
            again.bound_rotation_rad,
            [r.rotation_rad for r in rows],
            deg,
            TARGET_RAD,
            "rotation, degrees",
        ),
    )
    for ax, (drawn, least, live, unit, target, name) in zip(axes, panels, strict=True):
        ax.ecdf(unit * least, color="#777", linewidth=1.2, linestyle="--", label="the least possible (Cramer-Rao)")
        ax.ecdf(unit * drawn, color="#1d5f8a", linewidth=1.6, label=f"noise redrawn, {len(drawn)} times")
        ax.ecdf(unit * np.array(live), color="#b08a2e", linewidth=1.2, label=f"live, {len(live)} worlds")
        ax.axvline(unit * target, color="#444", linewidth=1)
        ax.annotate("target", (unit * target, 0.04), xytext=(-4, 0), textcoords="offset points", ha="right", fontsize=9)
        ax.set(xlim=(0.0, 1.25 * unit * target), xlabel=name)
    axes[0].set_ylabel("share of calibrations within")
    axes[0].legend(
        facecolor="white", edgecolor="none", framealpha=1.0, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.15)
    )
    return svg(figure, *axes)


def live_rows(rows: Sequence[LiveRow]) -> Iterable[Row]:
    """Errors beside the Cramer-Rao bound, and with redrawn noise where there is some."""
    again = joined([r.redrawn for r in rows])
    work, least = (1e3 * np.array([getattr(r, k) for r in rows]) for k in ("at_work_m", "least_m"))
    turn, turn_least = (np.degrees([getattr(r, k) for r in rows]) for k in ("rotation_rad", "least_rad"))
    yield "at the work point, mm", *(f"{v:.3f}" for v in (work.mean(), _rms(work), work.max(), _rms(least)))
    yield "rotation, deg", *(f"{v:.4f}" for v in (turn.mean(), _rms(turn), turn.max(), _rms(turn_least)))
    if len(again.at_work_m):
        within, at_bound = again.within(TARGET_M, TARGET_RAD)
        redrawn, turns = _rms(1e3 * again.at_work_m), _rms(np.degrees(again.rotation_rad))
        yield "new noise, at the work point, mm", "", f"{redrawn:.3f}", "", f"{_rms(least):.3f}"
        yield "new noise, rotation, deg", "", f"{turns:.4f}", "", f"{_rms(turn_least):.4f}"
        yield "new noise, both within the targets", "", f"{100 * within:.1f} %", "", f"{100 * at_bound:.1f} %"


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


@figure("flange-live", "the error of the live calibration beside the least that poses, arm and scanner allow")
def live(run: Run) -> None:
    """Calibrate live with eight scans (four in the quick form), and again with new noise."""
    seeds, scans, redraws = run.size((1, 4, 5), (12, 8, 200))
    rows = study_live(seeds, first=run.seed, scans=scans, redraws=redraws, progress=run.progress)
    run.write("live.svg", live_picture(rows))
    run.table("", ("error", "mean", "rms", "worst", "Cramer-Rao, rms"), live_rows(rows))
