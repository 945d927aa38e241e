"""`weldcal verify RESULT --touch CSV`: judges a calibration by points that the robot's tip touched."""

from pathlib import Path

from weldcal.calibration.data.results import load_result
from weldcal.calibration.data.scanner_correction import correction_from_document
from weldcal.calibration.touch.judge import judge_touches
from weldcal.calibration.touch.table import read_touches
from weldcal.models.errors import InputError
from weldcal.tools.report.files import csv_text, write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.touch import TouchReport, touch_page


def verify_touches(result: Path, touches: Path, out: Path) -> TouchReport:
    """Judge a calibration (its folder or calibration.yaml) by a table of touches; write report.html, touch_errors.csv and touch.json to ``out``.

    Raises:
        InputError: the result, the table or the output folder cannot be used; nothing is written.
    """
    out, result = Path(out), Path(result)
    if out.exists() and not out.is_dir():
        raise InputError(f"'{out}' is a file. Give a folder for the verification.")
    calibration = load_result(result)
    read = read_touches(Path(touches), correction_from_document(calibration.scanner_correction))
    folder = result if result.is_dir() else result.parent
    kinematics = folder / calibration.kinematics_file if calibration.kinematics_file else None
    report = TouchReport(judge_touches(calibration, read, kinematics), out, calibration)
    f = report.found
    rows = [
        (f.ids[k], f.features[k], f"{1e3 * f.error_m[k]:.4f}", f"{1e3 * f.limit_m[k]:.4f}", int(f.inside[k]), f"{1e3 * f.relative_m[k]:.4f}")
        for k in range(len(f.ids))
    ]  # fmt: skip
    write_atomic(
        out / "touch_errors.csv", csv_text(("id", "feature", "error_mm", "limit_mm", "inside", "relative_mm"), rows)
    )
    write_atomic(out / "report.html", touch_page(report, touches.name))
    write_json(out / "touch.json", report.summary())
    return report
