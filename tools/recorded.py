"""Calibrate from recorded scans and write the report: what the command and the Python function share."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

from weldcal.calibration.doctor.case import DoctorCase, write_case
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.recorded_flange import FlangeOptions, calibrate_flange
from weldcal.models.errors import WeldcalError
from weldcal.tools.console import Progress
from weldcal.tools.report.calibration import Algorithm1Outcome, CalibrationReport, calibration_report
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.render import check_folder, csv_text, save_all, write_atomic


def calibrate_dataset(
    folder: Path,
    out: Path,
    asked: FlangeOptions | None = None,
    *,
    progress: Progress | None = None,
    centres: bool = False,
    compare: bool = False,
    limit_mm: float | None = None,
) -> CalibrationReport:
    """Calibrate from a dataset folder and write ``calibration.yaml``, exports and ``report.html`` to ``out``.

    Where five scans or more contradict each other only observations.csv is written, for `weldcal doctor`.

    Args:
        asked: see ``calibrate_flange``.
        centres: also write centres.csv (camera frame, metres, uncorrected).
        compare: run the published method on the same scans, for the report.
        limit_mm: the error, at 95 %, that the job allows.

    Raises:
        InputError: the data cannot be used; TooFewPoses: too few scans can be used.
    """
    started = time.monotonic()
    check_limit(limit_mm)
    tell: Progress = progress or (lambda stage, fraction: None)
    check_folder(out)
    found = calibrate_flange(folder, asked, tell, partial(_examine, out))
    algorithm1: Algorithm1Outcome | None = None
    if compare:
        tell("Algorithm 1 for comparison", 0.8)
        from weldcal.tools.algorithm1_comparison import compare_algorithm1

        algorithm1, icp = compare_algorithm1(found)
        found = replace(found, result=replace(found.result, icp=icp))
    seconds = time.monotonic() - started
    report = CalibrationReport(**vars(found), algorithm1=algorithm1, seconds=seconds, out=out, limit_mm=limit_mm)
    tell("writing the report", 0.95)
    write_atomic(out / "report.html", calibration_report(report, dataset=folder.name))
    if centres:
        write_atomic(out / "centres.csv", _centres_csv(found.seen.observations))
    if found.case is not None:
        write_case(out, found.case)
    save_all(found.result, out, found.kinematics)
    tell("done", 1.0)
    return replace(report, seconds=time.monotonic() - started)


def _examine(out: Path, problem: WeldcalError, case: DoctorCase) -> None:
    """Write the case of a refusal, and add its likely cause to the sentence."""
    write_case(out, case)
    from weldcal.tools.report.doctor import name_cause

    name_cause(problem, case)


def _centres_csv(observations: tuple[Observation, ...]) -> str:
    rows = []
    for o in observations:
        normal = ["", "", ""] if o.n_C is None else [f"{v:.9f}" for v in o.n_C]
        rows.append([o.id, *(f"{v:.9f}" for v in o.p_CR), *normal])
    return csv_text(("id", *(f"{what}_{axis}" for what in ("centre", "normal") for axis in "xyz")), rows)
