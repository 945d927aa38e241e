"""Runs `weldcal hand-eye live`: a calibration in any mounting, with files and report, compared with the ground truth."""

import json
import time
from hashlib import sha256
from typing import Annotated

import numpy as np
import typer
from pydrake.common.yaml import yaml_dump_typed

from weldcal.calibration.hand_eye.exports import Provenance, export_hand_eye
from weldcal.systems.jobs.mounting.calibrator import solve_mounting
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import LIVE, Call, Outcome, RecordOption, command
from weldcal.tools.commands.run import JobRun, run_job, run_options
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.mounting import MountingReport, mounting_report, station_picture
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.run import RunOptions


@command(
    "hand-eye live", short_help="Calibrate a scanner live in any mounting.", options=LIVE, defaults={"browser": False}
)
def hand_eye_live(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="A scenario with a mounting section, by name or path.")
    ] = "eye_in_hand",
    record: RecordOption = False,
) -> Outcome:
    """Calibrate a scanner live in any mounting: it scans the robot's flange, its foot, or a second arm's flange."""
    options = run_options(call, "hand-eye", scenario, recording=record)
    result = run_mounting_live(load_scenario(scenario), options, call.progress)
    return Outcome(result.summary(), text=result.text(), first=result.first)


def run_mounting_live(scenario: Scenario, options: RunOptions, progress: Progress) -> MountingReport:
    """Build and run the cell and write the results.

    Raises:
        InputError, UnreachableScanner, RobotRefused: see run_job; nothing has been written or moved.
    """
    start = time.monotonic()
    finished = run_job(scenario, options, progress, "mounting")
    run, job = finished.run, finished.cell.job
    progress("write", 0.9)
    status, result = job.status(run.root), None
    if status.result is not None:
        result = solve_mounting(job.scene, status.seen, folds=5)
    report = MountingReport(run, result, options.out, time.monotonic() - start, finished.robot)
    write_mounting(report, finished)
    return report


def write_mounting(report: MountingReport, finished: JobRun) -> None:
    """Write hand_eye.yaml with its exports, sightings.csv, summary.txt, station.png, report.html and recording.html."""
    folder = report.folder
    scenario = yaml_dump_typed(report.run.cell.scenario)
    write_atomic(folder / "scenario.yaml", scenario)
    if report.result is not None:
        provenance = Provenance("scenario.yaml", sha256(scenario.encode()).hexdigest())
        export_hand_eye(report.result, report.mounting, folder, provenance)
    write_atomic(folder / "sightings.csv", _observations(report))
    poses = [f"{name}: {text}" for pose in report.first.poses for name, text in pose.rows().items()]
    write_atomic(folder / "summary.txt", "\n".join([report.text(), "", *poses, ""]))
    picture = station_picture(report)
    if picture is not None:
        write_atomic(folder / "station.png", picture)
    finished.write_recording(folder)
    write_atomic(folder / "report.html", mounting_report(report, picture))


def _observations(report: MountingReport) -> str:
    """The rows of sightings.csv, one per scan: joints (deg), centre (mm) and normal in the camera frame, visible share of the edge."""
    two = report.job.scene.two
    joints = [f"q{i}_deg" for i in range(1, 7)] + ([f"second_q{i}_deg" for i in range(1, 7)] if two else [])
    columns = ["id", *joints, *(f"centre_{a}_mm" for a in "xyz"), *(f"normal_{a}" for a in "xyz"), "coverage"]
    rows = []
    for s in report.status.seen:
        q = np.degrees(s.pose.q if s.pose.q_2 is None else np.concatenate([s.pose.q, s.pose.q_2]))
        normal = np.zeros(3) if s.observation.n_CM is None else s.observation.n_CM
        values = [*q, *(1e3 * s.observation.p_CM), *normal, s.coverage]
        rows.append([s.label, *(json.dumps(round(float(v), 6)) for v in values)])
    return csv_text(columns, rows)
