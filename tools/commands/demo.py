"""Runs the weld job of a scenario and writes its results; for `demo`, live calibration and `weld`."""

from weldcal.models.result_files import whole_result
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.runner import Progress, Run, no_progress
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import PoseConfig, Scenario
from weldcal.tools.commands.run import JobRun, run_job
from weldcal.tools.commands.run_files import SCANS, SUMMARY, weld_record, write_calibration, write_scans, write_weld_log
from weldcal.tools.report.demo import DemoResult, demo_pictures, demo_report
from weldcal.tools.report.files import write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.weld import live_calibration_error, weld_outcome


def run_demo(options: RunOptions, progress: Progress = no_progress) -> DemoResult:
    """Run all parts of a scenario's job.

    Raises:
        InputError, UnreachableScanner: the scenario or the options cannot be run; nothing has been written.
    """
    return run_scenario(load_scenario(options.scenario), options, progress)


def run_calibration_live(options: RunOptions, progress: Progress = no_progress) -> DemoResult:
    """Run only the calibration of a scenario: calibrate, verify, park."""
    scenario = load_scenario(options.scenario)
    scenario.job.calibrate, scenario.job.weld = True, False
    return run_scenario(scenario, options, progress)


def run_weld(options: RunOptions, progress: Progress = no_progress) -> DemoResult:
    """Run only the weld of a scenario, with the scanner at its known pose."""
    return run_scenario(known_camera(options.scenario), options, progress)


def known_camera(name: str) -> Scenario:
    """Load a scenario that only welds: the scanner is exactly at its nominal pose, which the cell uses.

    Raises:
        InputError: the scenario cannot be loaded, or has nothing to weld.
    """
    scenario = load_scenario(name)
    scenario.job.calibrate, scenario.job.weld = False, True
    if isinstance(scenario.scanner, RenderedScanner):
        scenario.scanner.mounting_translation_mm = scenario.scanner.mounting_rotation_deg = 0.0
        scenario.job.X_BC = PoseConfig(list(scenario.scanner.xyz_m), list(scenario.scanner.rpy_deg))
    check_scenario(scenario)
    return scenario


def run_scenario(scenario: Scenario, options: RunOptions, progress: Progress = no_progress) -> DemoResult:
    """Build and run the cell, evaluate the run and write its results.

    Raises:
        InputError, UnreachableScanner, RobotRefused: see run_job; nothing has been written or moved.
    """
    finished = run_job(scenario, options, progress, "")
    progress("measure and write", 0.985)
    result = measure(finished.run, options, finished.robot)
    write_result(result, finished)
    return result


def measure(run: Run[WeldJob], options: RunOptions, robot: str = "simulated") -> DemoResult:
    """Compare the run with the ground truth of its simulation."""
    cell, status = run.cell, run.cell.job.calibration_status(run.root)
    error = (
        None
        if status.estimate is None
        else live_calibration_error(cell, status.estimate, status.arm_or(cell.station.arm))
    )
    return DemoResult(
        options=options, run=run, status=status, calibration=error, weld=weld_outcome(cell, run.root), robot=robot
    )


def write_result(result: DemoResult, finished: JobRun) -> None:
    """Write calibration.yaml and its exports, scans/, weld.csv with weld.json, plots/, recording.html, summary.json, report.html."""
    folder, run = result.folder, result.run
    with whole_result(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_calibration(run.cell, result.status, result.options.seed, folder)
        write_scans(run, result.status, folder / SCANS, result.robot)
        if result.weld is not None:
            record = weld_record(run, result.weld, result.options.seed, result.options.scenario, result.robot)
            write_weld_log(record, folder)
        finished.write_recording(folder)
        pictures = demo_pictures(result)
        for name, picture in pictures.items():
            write_atomic(folder / "plots" / f"{name}.svg", picture)
        write_json(folder / SUMMARY, result.summary())
        write_atomic(folder / "report.html", demo_report(result, pictures, recording=finished.meshcat is not None))
