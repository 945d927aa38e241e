"""Verify from files and write the reports: what the command and the Python function share."""

import json
from collections.abc import Mapping
from pathlib import Path

from weldcal.calibration.data.results import export_all, save_result
from weldcal.calibration.verified_pairs import PairsOptions, verify_pairs
from weldcal.calibration.verified_scans import VerifyOptions, verify_scans
from weldcal.tools.console import Progress, plain
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.render import check_folder, write_atomic
from weldcal.tools.report.verify import CORRECTED, VerifyReport, verify_report
from weldcal.tools.report.verify_pairs import PairsReport, verify_pairs_report


def verify_dataset(
    result: Path, dataset: Path, out: Path, asked: VerifyOptions | None = None, progress: Progress | None = None
) -> VerifyReport:
    """Verify a calibration on a dataset folder, see ``verify_scans``; write verification.json and report.html.

    Nothing is written unless at least one scan can be used.

    Raises:
        InputError: the result, the dataset or the output folder cannot be used.
    """
    asked = asked or VerifyOptions()
    tell: Progress = progress or (lambda stage, fraction: None)
    check_limit(asked.limit_mm)
    check_folder(out, "verification")
    found = verify_scans(result, dataset, asked, tell)
    named = {"dataset": str(dataset), "calibration": str(result), "pose": asked.pose or ""}
    report = VerifyReport(**vars(found) | named, out=out)
    tell("writing the report", 0.9)
    if found.corrected is not None:
        export_all(found.corrected, out / CORRECTED)
        save_result(found.corrected, out / CORRECTED)
    _write_verification(out, verify_report(report, dataset=dataset.resolve().name), report.summary())
    tell("done", 1.0)
    return report


def verify_on_pairs(
    result: Path,
    pairs: Path,
    out: Path | None,
    asked: PairsOptions | None = None,
    *,
    limit_mm: float | None = None,
    options: tuple[str, ...] = (),
) -> PairsReport:
    """Judge the pose in a file on pairs, see ``verify_pairs``; write verification.json and report.html to ``out``.

    Args:
        out: None: nothing is written.
        limit_mm: error at the target that the job allows.
        options: further words with which a command reads the pairs, for the next step.

    Raises:
        InputError: a file cannot be read; InconsistentPoses: the pairs contradict each other.
    """
    check_limit(limit_mm)
    asked = asked or PairsOptions()
    found = verify_pairs(result, pairs, asked)
    report = PairsReport(**vars(found), pairs=str(pairs), limit_mm=limit_mm, board=asked.board or "", options=options)
    if out is not None:
        _write_verification(out, verify_pairs_report(report), report.summary())
    return report


def _write_verification(out: Path, page: str, summary: Mapping[str, object]) -> None:
    """Write the page, then verification.json: its presence means that everything else is there."""
    write_atomic(out / "report.html", page)
    write_atomic(out / "verification.json", json.dumps(plain(summary), indent=2, allow_nan=False) + "\n")
