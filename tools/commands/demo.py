"""The main job: build the cell of a scenario, run it, write what came of it; demo, live calibration and weld are cuts of it."""

from __future__ import annotations

import time
import webbrowser
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams

from weldcal.systems.cell import make_cell, work_point
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.jobs.weld.next_scan import next_scan
from weldcal.systems.messages import CalibrationStatus
from weldcal.systems.runner import Progress, Run, no_progress, run_cell
from weldcal.systems.scenario.schema import PoseConfig, Scenario, check_scenario, load_scenario
from weldcal.tools.commands.outcome import (
    CalibrationError,
    WeldOutcome,
    calibration_error,
    calibration_status,
    heat_input_kJ_mm,
    planned_seam,
    weld_outcome,
)
from weldcal.tools.commands.robots import chosen_robot
from weldcal.tools.commands.run_files import error_summary, weld_record, write_calibration, write_scans, write_weld_log
from weldcal.tools.report.demo import demo_pictures, demo_report
from weldcal.tools.report.render import write_atomic


@dataclass(frozen=True)
class DemoOptions:
    """What a person may choose: scenario by name or path, result folder, seed, whether to open a browser, real time or as fast
    as it goes; the robot (see chosen_robot; None: the scenario's), and how fast the arm's moves are (None: the scenario's)."""

    scenario: str
    out: Path
    seed: int = 0
    browser: bool = False
    realtime: bool = False
    robot: str | None = None
    dry_run: bool = False
    pace: float | None = None
    speed_factor: float | None = None
    recording: bool = True


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What a run came to; figures against the truth exist in simulation only."""

    options: DemoOptions
    run: Run
    status: CalibrationStatus
    calibration: CalibrationError | None
    weld: WeldOutcome | None
    robot: str = "simulated"

    @property
    def folder(self) -> Path:
        """Where everything was written."""
        return self.options.out

    @property
    def state(self) -> str:
        """`done`, or `held` with a reason."""
        return "held" if self.run.held else "done"

    @property
    def n_scans(self) -> int:
        """Scans of the feature that were taken, verification included."""
        return self.status.sequence

    def summary(self) -> dict[str, object]:
        """The JSON object of `demo` and `weld`."""
        found: dict[str, object] = {"state": self.state, "scenario": self.options.scenario, "seed": self.options.seed}
        found["robot"] = self.robot
        if self.run.reason:
            found["reason"] = self.run.reason
        if self.calibration is not None:
            found["X_BC_error_mm"] = 1e3 * self.calibration.translation_m
            found["X_BC_error_deg"] = float(np.degrees(self.calibration.rotation_rad))
            found["X_BC_error_at_work_mm"] = 1e3 * self.calibration.at_work_m
        if self.status.estimate is not None:
            found["X_BC"] = self.status.estimate.X_BC.GetAsMatrix4().tolist()
            found["expected_error_mm"] = 1e3 * self.status.predicted_error_m
            found["held_out_mm"] = error_summary(1e3 * self.status.estimate.held_out.position_m)
            found["verification_mm"] = [1e3 * v.error_m for v in self.status.verifications]
        found["n_scans"] = self.n_scans
        found["refused"] = [{"id": id, "reason": reason} for id, reason in self.status.refused]
        if self.weld is not None and self.weld.error is not None and self.weld.speed is not None:
            distance = 1e3 * np.hypot(self.weld.error.lateral, self.weld.error.height)
            found["torch_mean_mm"], found["torch_max_mm"] = float(distance.mean()), float(distance.max())
            found["torch_lateral_mean_mm"] = 1e3 * self.weld.error.mean_m
            found["torch_lateral_max_mm"] = 1e3 * self.weld.error.max_m
            found["torch_speed_cv"] = self.weld.speed.cv
            found["welded_mm"] = 1e3 * self.weld.speed.welded_m
            heat = heat_input_kJ_mm(self.weld, self.run.cell.scenario.welding.process.process())
            found["heat_input_kJ_mm"] = None if heat is None else float(heat.mean())
        if self.weld is not None:
            if self.weld.plan_error is not None:
                found["plan_mean_mm"] = 1e3 * self.weld.plan_error.mean_m
                found["plan_max_mm"] = 1e3 * self.weld.plan_error.max_m
            plan = planned_seam(self.run.cell, self.run.root)
            if np.isfinite(plan.sigma_m):
                found["plan_sigma_mm"], found["plan_confidence"] = 1e3 * plan.sigma_m, plan.confidence
            found["plan_words"] = plan.words
            found["peak_omega"] = float(np.nanmax(np.abs(self.weld.log.telemetry["omega"])))
        found["simulated_seconds"] = float(self.run.root.get_time())
        found["wall_seconds"] = self.run.wall_seconds
        found["real_time_factor"] = self.run.real_time_factor()
        if self.run.clock is not None:
            found["late_ms"], found["thinking_ms"] = 1e3 * self.run.clock.late_s, 1e3 * self.run.clock.thinking_s
            found["reanchored"] = self.run.clock.reanchored
            if (behind := self.run.clock.sentence()) is not None:
                found["fell_behind"] = behind
        return found

    def calibration_summary(self) -> dict[str, object]:
        """The JSON object of a live `calibrate`: the keys of the offline one beside those of the run."""
        found, estimate = self.summary(), self.status.estimate
        found["seconds"] = self.run.wall_seconds
        if estimate is not None:
            ids = [o.id for o in self.status.observations]
            found |= {
                "n_used": int(estimate.inliers.sum()),
                "covariance": estimate.covariance.tolist(),
                "scanner_correction": None,
                "tilt_deg": error_summary(np.degrees(estimate.held_out.tilt_rad)),
                "outliers": [id for id, used in zip(ids, estimate.inliers, strict=True) if not used],
                "warnings": list(estimate.warnings),
                "unobservable": list(estimate.unobservable),
            }
        advice = next_scan(self.status, self.run.cell.poses, work_point(self.run.cell.scenario))
        found["next_pose"] = None if advice is None else advice.sentence()
        return found


def run_demo(options: DemoOptions, progress: Progress = no_progress) -> DemoResult:
    """The whole story of a scenario.

    Raises:
        InputError, UnreachableScanner: the scenario or the options cannot be done; nothing has been written.
    """
    return run_scenario(load_scenario(options.scenario), options, progress)


def run_calibration_live(options: DemoOptions, progress: Progress = no_progress) -> DemoResult:
    """The calibration of a scenario alone: calibrate, verify, park."""
    scenario = load_scenario(options.scenario)
    scenario.job.calibrate, scenario.job.weld = True, False
    return run_scenario(scenario, options, progress)


def run_weld(options: DemoOptions, progress: Progress = no_progress) -> DemoResult:
    """The weld of a scenario alone, with the scanner where the cell is told it stands."""
    return run_scenario(known_camera(options.scenario), options, progress)


def known_camera(name: str) -> Scenario:
    """A scenario that only welds: the scanner stands exactly where its drawing says, and the cell is told so.

    Raises:
        InputError: the scenario is not one, or has nothing to weld.
    """
    scenario = load_scenario(name)
    scenario.job.calibrate, scenario.job.weld = False, True
    if isinstance(scenario.scanner, RenderedScanner):
        scenario.scanner.mounting_translation_mm = scenario.scanner.mounting_rotation_deg = 0.0
        scenario.job.X_BC = PoseConfig(list(scenario.scanner.xyz_m), list(scenario.scanner.rpy_deg))
    check_scenario(scenario)
    return scenario


def run_scenario(scenario: Scenario, options: DemoOptions, progress: Progress = no_progress) -> DemoResult:
    """Build, run, measure, write.

    Raises:
        InputError, UnreachableScanner, RobotRefused: see chosen_robot and make_cell; nothing has been written or moved.
    """
    if options.speed_factor is not None:
        scenario.job.speed_factor = options.speed_factor
        check_scenario(scenario)
    progress("build the cell", 0.0)
    meshcat = None
    with chosen_robot(options.robot, scenario, dry_run=options.dry_run, pace=options.pace) as robot:
        if options.recording or options.browser:
            meshcat = Meshcat(MeshcatParams(host="localhost", web_url_pattern="http://{host}:{port}"))
        cell = make_cell(scenario, options.seed, meshcat, robot.prepared)
        with closing(cell.station):
            if meshcat is not None:
                _set_the_scene(meshcat)
                if options.browser:
                    webbrowser.open(meshcat.web_url())
                    time.sleep(2.0 if options.realtime else 0.5)  # the page wants a moment before the story begins
            run = run_cell(cell, progress, meshcat, options.realtime)
    progress("measure and write", 0.985)
    result = measure(run, options, robot.title)
    write_result(result, meshcat)
    return result


def measure(run: Run, options: DemoOptions, robot: str = "simulated") -> DemoResult:
    """Hold the run against the truth of its simulation."""
    cell, status = run.cell, calibration_status(run.cell, run.root)
    error = None
    truth = cell.station.truth.X_BC
    if status.estimate is not None and truth is not None:
        error = calibration_error(status.estimate.X_BC, truth, work_point(cell.scenario))
    return DemoResult(options, run, status, error, weld_outcome(cell, run.root), robot)


def write_result(result: DemoResult, meshcat: Meshcat | None) -> None:
    """Write calibration.yaml and its exports, scans/, weld.csv with weld.json, plots/, recording.html, report.html; each whole or not at all."""
    folder, run = result.folder, result.run
    folder.mkdir(parents=True, exist_ok=True)
    write_calibration(run.cell, result.status, result.options.seed, folder)
    write_scans(run, result.status, folder / "scans", result.robot)
    if result.weld is not None:
        record = weld_record(run, result.weld, result.options.seed, result.options.scenario, result.robot)
        write_weld_log(record, folder)
    if meshcat is not None:
        write_atomic(folder / "recording.html", meshcat.StaticHtml())
    pictures = demo_pictures(result)
    for name, picture in pictures.items():
        write_atomic(folder / "plots" / f"{name}.svg", picture)
    write_atomic(folder / "report.html", demo_report(result, pictures, recording=meshcat is not None))


def _set_the_scene(meshcat: Meshcat) -> None:
    """A calm background and a viewer who stands in front of the cell."""
    meshcat.SetProperty("/Background", "top_color", [0.93, 0.95, 0.97])
    meshcat.SetProperty("/Background", "bottom_color", [0.78, 0.82, 0.86])
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetCameraPose(np.array([1.30, -0.68, 0.78]), np.array([0.42, 0.0, 0.42]))
