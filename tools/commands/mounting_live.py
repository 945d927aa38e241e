"""Runs a scenario that calibrates in any mounting, and `weldcal calibrate` on its recorded scans."""

import json
import time
from hashlib import sha256
from pathlib import Path

import numpy as np

from weldcal.calibration.hand_eye.exports import Provenance, export_hand_eye
from weldcal.calibration.recorded_carried import calibrate_carried
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import scenario_text
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.run import JobRun, run_job, save_scans
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.mounting import MountingReport, mounting_report, station_picture
from weldcal.tools.report.render import csv_text, write_atomic
from weldcal.tools.report.run import RunOptions


def calibrate_recorded(
    folder: Path,
    out: Path,
    *,
    robot: str | None = None,
    flange: str | None = None,
    poses: str | None = None,
    limit_mm: float | None = None,
    progress: Progress = no_progress,
) -> MountingReport:
    """Calibrate a scanner that an arm carries from scans at rest, see ``calibrate_carried``; write it to ``out``."""
    started = time.monotonic()
    check_limit(limit_mm)
    made = calibrate_carried(folder, robot=robot, flange=flange, poses=poses, tell=progress)
    report = MountingReport(
        scene=made.scene,
        status=made.found,
        folder=out,
        seconds=time.monotonic() - started,
        limit=(limit_mm, "--limit-mm"),
        description=f"Recorded scans: {folder.name}.",
        source=("dataset.yaml", made.hashes),
    )
    write_mounting(report)
    return report


def run_mounting_live(scenario: Scenario, options: RunOptions, progress: Progress) -> MountingReport:
    """Build and run the cell and write the results.

    Raises:
        InputError, UnreachableScanner, RobotRefused: see run_job; nothing has been written or moved.
    """
    start = time.monotonic()
    finished = run_job(scenario, options, progress, "mounting")
    progress("write", 0.9)
    report = live_report(finished, options.out, start)
    write_mounting(report, finished)
    return report


def live_report(finished: JobRun, folder: Path, start: float) -> MountingReport:
    """Return the report of a run that began at ``start`` (s, monotonic); its result gets its held-out errors."""
    scenario, job = finished.cell.scenario, finished.cell.job
    status = job.status(finished.run.root)
    return MountingReport(
        scene=job.scene,
        status=status if status.result is None else status.cross_validated(job.scene),
        folder=folder,
        seconds=time.monotonic() - start,
        limit=(scenario.calibration.required_error_mm, "calibration.required_error_mm"),
        description=scenario.description,
        source=("scenario.yaml", scenario_text(scenario)),
        robot=finished.robot,
        run=finished.run,
    )


def write_mounting(report: MountingReport, finished: JobRun | None = None) -> None:
    """Write hand_eye.yaml with its exports, sightings.csv, summary.txt and report.html.

    Of a live run also scenario.yaml, scans/ (a dataset for `weldcal calibrate`), station.png and recording.html.
    """
    folder, picture, (source, words) = report.folder, station_picture(report), report.source
    if report.result is not None:
        export_hand_eye(report.result, report.mounting, folder, Provenance(source, sha256(words.encode()).hexdigest()))
    write_atomic(folder / "sightings.csv", _observations(report))
    poses = [f"{name}: {text}" for pose in report.first.poses for name, text in pose.rows().items()]
    write_atomic(folder / "summary.txt", "\n".join([report.text(), "", *poses, ""]))
    if picture is not None:
        write_atomic(folder / "station.png", picture)
    if finished is not None:
        write_atomic(folder / source, words)
        X_BF = {s.label: s.observation.X_BF for s in report.status.seen}
        joints = {s.label: s.pose.joints for s in report.status.seen}
        save_scans(finished.run, folder / "scans", finished.cell.job.header, X_BF, joints)
        finished.write_recording(folder)
    write_atomic(folder / "report.html", mounting_report(report, picture))


def _observations(report: MountingReport) -> str:
    """List the rows of sightings.csv: joints (deg), centre (mm), normal in the camera frame, visible edge share."""
    two = report.scene.two
    joints = [f"q{i}_deg" for i in range(1, 7)] + ([f"second_q{i}_deg" for i in range(1, 7)] if two else [])
    columns = ["id", *joints, *(f"centre_{a}_mm" for a in "xyz"), *(f"normal_{a}" for a in "xyz"), "coverage"]
    rows = []
    for s in report.status.seen:
        q = np.degrees(s.pose.joints)
        normal = np.zeros(3) if s.observation.n_CM is None else s.observation.n_CM
        values = [*q, *(1e3 * s.observation.p_CM), *normal, s.coverage]
        rows.append([s.label, *(json.dumps(round(float(v), 6)) for v in values)])
    return csv_text(columns, rows)
