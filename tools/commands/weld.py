"""weldcal weld: runs the weld job of a scenario and writes its results; for `demo` and live calibration too."""

import dataclasses as dc
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from weldcal.calibration.data.header import DatasetHeader, Feature, ScannerGuess, placed
from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.eye_on_base.stated_error import estimate_result
from weldcal.models.errors import InputError
from weldcal.models.files import whole_result, write_apart
from weldcal.systems.cell import Cell
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.jobs.weld.progress_keeper import RESTART, ProgressKeeper, sha256_of
from weldcal.systems.jobs.weld.seam_planner import SeamPlanner
from weldcal.systems.jobs.weld.sequencer import JobSequencer
from weldcal.systems.jobs.weld.settings import feature_standard
from weldcal.systems.messages import CalibrationStatus
from weldcal.systems.recording.scenario_files import SCENARIO, packed
from weldcal.systems.runner import Progress, Run, no_progress
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario, use_nominal_scanner
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Replacement
from weldcal.tools.cli.options import Call, Outcome, ScenarioArgument, ScenarioOption, command, option
from weldcal.tools.cli.result_folder import SCANS, SUMMARY, writer
from weldcal.tools.commands.run import RECORDED, JobRun, named_once, run_job, run_options, save_scans
from weldcal.tools.report.demo import DemoResult, demo_pictures, demo_report
from weldcal.tools.report.first_screen import typed
from weldcal.tools.report.render import save_all, write_atomic, write_json
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.weld import fit_up_csv, live_calibration_error, weld_outcome
from weldcal.tools.report.weld_record import part_record, run_log, weld_record
from weldcal.welding.record.progress import KILLED, POWER, ProgressError, load_progress
from weldcal.welding.record.progress import Progress as WeldProgress
from weldcal.welding.record.weld_log import CSV_NAME, HEADER_NAME, WeldRecord, weld_log_texts
from weldcal.welding.seam.restart import Restart

ResumeOption = Annotated[
    Path | None, option("--resume", "FOLDER", "Go on with the broken weld of this result folder, from its crater.")
]
OverlapOption = Annotated[
    float, option("--overlap-mm", "MM", "With --resume: the arc starts so far before the crater.", min=5.0, max=10.0)
]


@dc.dataclass(frozen=True, eq=False)
class BrokenWeld:
    """A broken weld: its progress, its scenario, and the options of the run that goes on with it."""

    progress: WeldProgress
    scenario: Scenario
    options: Mapping[str, Any]


def broken_weld(folder: Path, overlap_mm: float, live: Mapping[str, Any]) -> BrokenWeld:
    """Read a broken weld; `live` are the options of a live run that were given.

    Raises:
        InputError: there is nothing to go on with, its files were changed, or nobody could answer the question.
    """
    progress = load_progress(folder).settled()
    files = {path.name: path.read_bytes() for path in (folder / RESTART).glob("*") if path.is_file()}
    if sha256_of(files) != progress.scenario_sha256:
        raise ProgressError(
            f"The scenario in '{folder / RESTART}' is not that of the broken weld: restore its files, or weld the rest"
            " by hand."
        )
    scenario = load_scenario(str(folder / RESTART / SCENARIO))
    if why := by_hand(scenario):
        raise ProgressError(why)
    if progress.done:
        raise ProgressError(f"The weld in '{folder}' is complete: nothing is left to weld.")
    if not (live.get("browser") or sys.stdin.isatty()):
        raise InputError(
            "The arc of a restart starts only after an operator's yes, and nobody could give it: run the command in a"
            " terminal, or without --no-browser."
        )
    for name in ("record", "dry_run"):
        if live.get(name):
            raise InputError(f"A restart cannot be done with --{name.replace('_', '-')}: omit it.")
    options: dict[str, Any] = {"replace": restarting(progress.restart(1e-3 * overlap_mm))}
    if live.get("robot") is None:
        options["robot"] = progress.robot
    return BrokenWeld(progress, scenario, options)


def by_hand(scenario: Scenario) -> str:
    """Why a broken weld of this scenario cannot go on; empty where it can."""
    if scenario.welding.passes:  # the path that a later pass follows was felt by several runs
        return "A broken weld of several passes cannot go on: weld the rest by hand."
    if scenario.welding.stitch is not None and not scenario.welding.stitch.stitch().middle_out:
        return "A broken weld of stitches can go on only with welding.stitch.order: middle_out: weld the rest by hand."
    return ""


def killed_weld(folder: Path) -> str:
    """Return how far a broken weld came and how to go on, "" for any other folder; write the record of a killed one.

    Raises:
        InputError: the weld still runs.
    """
    try:
        progress = load_progress(folder).settled()
    except ProgressError:  # there is none, or one of another version
        return ""
    if (process := writer(folder)) is not None:
        raise InputError(f"The weld in '{folder}' still runs (process {process}): wait until it has ended.")
    if progress.done:
        return ""
    killed = progress.ends[-1] in (KILLED, POWER)
    scenario, here = load_scenario(str(folder / RESTART / SCENARIO)), "Before its first arc"
    if progress.stretches and killed:
        progress.write(folder)
        part_record(scenario.welding.order, None, progress, folder).write(folder)
    if progress.stretches and progress.stretches[-1].run == len(progress.ends) - 1:
        last = progress.stretches[-1]
        here = f"At {1e3 * last.to_m:.0f} mm of seam {last.seam + 1}" + f", pass {last.weld_pass + 1}," * bool(
            last.weld_pass
        )
    way_on = by_hand(scenario) or f"Go on with {typed('weld --resume', folder)}"
    ended = f"was {progress.ends[-1]}." if killed else f"ended: {progress.ends[-1].rstrip('.')}."
    return f"{here} this run {ended} {way_on}"


def restarting(restart: Restart) -> dict[str, Replacement]:
    """The systems of a weld job that go on with a broken weld, for build_cell."""

    def planner(shipped: Any, station: Station) -> SeamPlanner:
        found: SeamPlanner = shipped.restarted(restart)
        return found

    def sequencer(shipped: Any, station: Station) -> JobSequencer:
        found: JobSequencer = shipped.begun_at(restart.seam, restart.piece)
        return found

    return {"seam_planner": planner, "job_sequencer": sequencer}


def keeper_of(scenario: Scenario, options: RunOptions, earlier: WeldProgress | None = None) -> ProgressKeeper | None:
    """Keeps the progress of a run of this scenario; `earlier`: of the weld that it goes on with.

    None where no file can name the scenario's drivers: such a weld is not resumed.
    """
    try:
        files = packed(scenario)
    except RuntimeError:  # yaml_dump_typed: a driver that was made in Python
        return None
    begun = earlier or WeldProgress(
        scenario=options.scenario, seed=options.seed, robot=options.robot, scenario_sha256="", ends=()
    )
    begun = dc.replace(begun, scenario_sha256=sha256_of(files), ends=(*begun.ends, ""), robot=options.robot)
    return ProgressKeeper(options.out, files, begun)


FIT_UP_CSV: Final = "fit_up.csv"
PRESET: Final = "straight_groove"


@command("weld", options=RECORDED, short_help="Weld a seam in a scenario, without calibrating.")
def weld(
    call: Call,
    name: ScenarioArgument = None,
    scenario: ScenarioOption = PRESET,
    resume: ResumeOption = None,
    overlap_mm: OverlapOption = 8.0,
) -> Outcome:
    """Weld a seam in a scenario, with the scanner's pose taken from the scenario.

    With --resume a broken weld goes on from its crater, and its folder then holds the result of all runs: the part is
    scanned again, and the arc starts after your answer yes, y or g (Go on in the dashboard); no or End refuses.
    """
    if resume is not None:
        if name is not None or scenario != PRESET:
            raise typer.BadParameter("--resume takes the scenario from its folder: give no other")
        if call.out is not None:
            raise typer.BadParameter("--resume writes into its folder: omit --out")
        broken = broken_weld(resume, overlap_mm, call.live)
        call.seed, call.out = broken.progress.seed, resume
        call.keep(resume, goes_on=True)
        options = run_options(call, "weld", broken.progress.scenario, **broken.options)
        found = run_scenario(broken.scenario, options, call.progress, broken.progress)
        return Outcome(found.summary(), first=found.first)
    found = run_weld(run_options(call, "weld", named_once(name, scenario, PRESET)), call.progress)
    return Outcome(found.summary(), first=found.first)


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
    use_nominal_scanner(scenario)
    check_scenario(scenario)
    return scenario


def run_scenario(
    scenario: Scenario, options: RunOptions, progress: Progress = no_progress, earlier: WeldProgress | None = None
) -> DemoResult:
    """Build and run the cell, evaluate the run and write its results; `earlier`: of the weld that it goes on with.

    Raises:
        InputError, UnreachableScanner, RobotRefused: see run_job; nothing has been written or moved.
    """
    keeper = keeper_of(scenario, options, earlier)
    try:
        look = None if options.dry_run or keeper is None else keeper.look
        finished = run_job(scenario, options, progress, "", look)
    except BaseException:
        if keeper is not None:
            keeper.close()
        raise
    if keeper is not None:
        keeper.close(finished.run)
    progress("measure and write", finished.share(0.985))
    result = measure(finished.run, options, finished.robot, None if keeper is None else keeper.progress)
    write_result(result, finished)
    return result


def measure(
    run: Run[WeldJob], options: RunOptions, robot: str = "simulated", progress: WeldProgress | None = None
) -> DemoResult:
    """Compare the run with the ground truth of its simulation; `progress`: how far the weld has come."""
    cell, status = run.cell, run.cell.job.calibration_status(run.root)
    error = (
        None
        if status.estimate is None
        else live_calibration_error(cell, status.estimate, status.arm_or(cell.station.arm))
    )
    weld = weld_outcome(cell, run.root)
    number = 1 if progress is None else len(progress.ends)
    log = None if weld is None else weld_record(run, weld, options.seed, options.scenario, robot, number)
    order, record = run.cell.scenario.welding.order, None
    if log is not None or (progress is not None and progress.stretches):
        record = part_record(order, log, progress, options.out)
    return DemoResult(
        options=options,
        run=run,
        status=status,
        calibration=error,
        weld=weld,
        robot=robot,
        record=record,
        broken=progress is not None and bool(progress.stretches) and not progress.done,
        by_hand=by_hand(run.cell.scenario),
    )


def write_result(result: DemoResult, finished: JobRun) -> None:
    """Write all files of a weld: the calibration and its exports, scans, logs, plots, recording and report."""
    folder, run = result.folder, result.run
    with whole_result(folder):
        folder.mkdir(parents=True, exist_ok=True)
        if (calibrated := live_result(run.cell, result.status, result.options.seed)) is not None:
            refinement = result.status.refinement
            save_all(calibrated, folder, "" if refinement is None else refinement.kinematics)
        write_scans(run, result.status, folder / SCANS, result.robot)
        if result.record is not None:
            if result.record.own is not None and (result.broken or result.record.run > 1):
                table = run_log(folder, result.record.run)
                for path, text in zip(
                    (table, table.with_suffix(".json")), weld_log_texts(result.record.own), strict=True
                ):
                    write_apart(path, text)
            write_weld_log(result.record.log, folder)
            result.record.write(folder)
        if records := run.cell.job.planned_seam(run.root).records:
            write_atomic(folder / FIT_UP_CSV, fit_up_csv(records))
        finished.write_recording(folder)
        pictures = demo_pictures(result)
        for name, picture in pictures.items():
            write_atomic(folder / "plots" / f"{name}.svg", picture)
        write_json(folder / SUMMARY, result.summary())
        write_atomic(folder / "report.html", demo_report(result, pictures, recording=finished.meshcat is not None))


def live_result(cell: Cell[WeldJob], status: CalibrationStatus, seed: int) -> CalibrationResult | None:
    """The live calibration in the form that `weldcal calibrate` writes; None without an estimate."""
    estimate, refinement = status.estimate, status.refinement
    if estimate is None:
        return None
    scanner = cell.scenario.scanner_config()
    return estimate_result(
        estimate,
        status.observations,
        status.refused,
        cell.job.X_FR,
        [q for q, keep in zip(status.joints, estimate.inliers, strict=False) if keep],
        local_field=None if status.local_field is None else status.local_field.document(),
        kinematics="" if refinement is None else refinement.kinematics,
        warnings=estimate.warnings if refinement is None else (*estimate.warnings, refinement.sentence),
        robot=cell.scenario.arm,
        flange=cell.scenario.calibration.feature,
        scanner="" if scanner is None else scanner.scanner().name,
        seed=seed,
        scanner_correction=None if estimate.correction is None else estimate.correction.document(),
        arm_errors=None if refinement is None else refinement.arm_errors,
    )


def write_scans(run: Run[WeldJob], status: CalibrationStatus, folder: Path, robot: str = "simulated") -> Path | None:
    """Write the calibration scans as a dataset folder for `weldcal calibrate`; returns None where there are none.

    `robot` is the name of the robot, for the dataset's note.
    """
    X_FR, scenario, scanner = run.cell.job.X_FR, run.cell.scenario, run.cell.scenario.scanner_config()
    c = scenario.calibration
    header = DatasetHeader(
        robot=scenario.arm,
        flange=feature_standard(scenario).designation,
        scanner="" if scanner is None else scanner.scanner().name,
        configuration="eye_on_base",
        note=f"rendered scans of a run; robot: {robot}",
        feature_in_flange=Feature(**placed(X_FR)),
        scanner_guess=ScannerGuess(**placed(c.mounting_guess.pose()), radius_m=1e-3 * c.guess_radius_mm),
    )
    poses = {o.id: o.X_BR @ X_FR.inverse() for o in status.observations}
    joints = dict(zip(poses, status.joints, strict=False))
    return save_scans(run, folder, header, poses, joints)


def write_weld_log(record: WeldRecord, folder: Path) -> Path:
    """Write weld.csv and weld.json (docs/weld_log.md); the header last, so that it never describes a missing table."""
    table, header = weld_log_texts(record)
    write_atomic(folder / CSV_NAME, table)
    write_atomic(folder / HEADER_NAME, header)
    return folder / CSV_NAME
