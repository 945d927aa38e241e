"""Errors of live calibrations with few scans, compared with the Cramer-Rao bound of arm and scanner."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from weldcal.systems.cell import make_cell, work_point
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.runner import Progress, no_progress, run_cell
from weldcal.systems.scenario.schema import Scenario, check_scenario, load_scenario
from weldcal.tools.commands.outcome import calibration_error, calibration_status
from weldcal.tools.report.pictures import svg
from weldcal.tools.studies.flange.live_redraw import Redrawn, Station, bound_covariance, joined, joints_of, redraw

SCENARIO = "calibrate_only"
TARGET_M, TARGET_RAD = 6e-5, float(np.radians(0.01))


@dataclass(frozen=True)
class LiveRow:
    """One seed: scans used, error of a point at the work point (m) and of the rotation (rad), what the estimate expected of the
    former (rms), the least that these poses, arm and scanner allow (rms), and the same calibration with noise redrawn."""

    seed: int
    scans: int
    at_work_m: float
    rotation_rad: float
    expected_m: float
    least_m: float
    least_rad: float
    redrawn: Redrawn


def live_scenario(repeatability_mm: float, scans: int) -> Scenario:
    """The calibration scenario with an arm that repeats no better, and exactly so many scans."""
    scenario = load_scenario(SCENARIO)
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
    """Calibrate live, through the whole Diagram, once for each seed, and ``redraws`` times more from the same poses without it.

    Raises InputError for numbers that no cell takes, and RuntimeError where a job was held.
    """
    rows = []
    for k in range(seeds):
        seed = first + k
        progress(f"calibration {k + 1} of {seeds}", k / seeds)
        scenario = live_scenario(repeatability_mm, scans)
        cell = make_cell(scenario, seed)
        with closing(cell.station):
            run = run_cell(cell)
        status, truth = calibration_status(cell, run.root), cell.station.truth.X_BC
        if status.estimate is None or truth is None or run.held:
            raise RuntimeError(f"The calibration of seed {seed} came to no end: {run.reason}")
        work = work_point(scenario)
        error = calibration_error(status.estimate.X_BC, truth, work)
        found = status.observations
        joints = joints_of(found, cell.station.arm, np.deg2rad(scenario.home_deg))
        station = Station(cell.station.arm, joints, 1e-3 * repeatability_mm, truth, np.asarray(work))
        least = np.diag(bound_covariance(found, station))
        rows.append(
            LiveRow(
                seed,
                len(found),
                error.at_work_m,
                error.rotation_rad,
                status.predicted_error_m,
                float(np.sqrt(least[3:].sum())),
                float(np.sqrt(least[:3].sum())),
                redraw(found, station, redraws, seed),
            )
        )
    return rows


def live_picture(rows: list[LiveRow]) -> bytes:
    """Share of the calibrations whose error is no larger than that: live ones (steps), their noise redrawn, and at the bound."""
    again = joined([r.redrawn for r in rows])
    mm, deg = 1e3, float(np.degrees(1.0))
    figure = Figure(figsize=(8.2, 3.6), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
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
        ax.set_xlim(0.0, 1.25 * unit * target)
        ax.set_xlabel(name)
    axes[0].set_ylabel("share of calibrations within")
    axes[0].legend(
        facecolor="white", edgecolor="none", framealpha=1.0, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.15)
    )
    return svg(figure, *axes)
