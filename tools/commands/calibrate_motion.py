"""Run `weldcal calibrate` on a recording in motion: X_BC, the scanner's clock, exports and a report."""

import time
from pathlib import Path

from weldcal.calibration.recorded_motion import RecordedMotion, calibrate_motion
from weldcal.tools.console import Progress
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.motion_calibration import MotionReport, motion_report
from weldcal.tools.report.render import check_folder, csv_text, save_all, write_atomic


def calibrate_recording(
    folder: Path,
    out: Path,
    *,
    robot: str | None = None,
    flange: str | None = None,
    seed: int = 0,
    progress: Progress = lambda stage, fraction: None,
    centres: bool = False,
    limit_mm: float | None = None,
) -> MotionReport:
    """Calibrate, see ``calibrate_motion``, and write ``calibration.yaml``, exports and ``report.html`` to ``out``.

    ``centres`` also writes centres.csv (camera frame, metres, with the capture time). Nothing is written unless the
    calibration succeeded.
    """
    started = time.monotonic()
    check_limit(limit_mm)
    check_folder(out)
    found = calibrate_motion(folder, robot=robot, flange=flange, seed=seed, tell=progress)
    report = MotionReport(**vars(found), seconds=time.monotonic() - started, out=out, limit_mm=limit_mm)
    progress("writing the report", 0.95)
    write_atomic(out / "report.html", motion_report(report, f"Calibration in motion of {folder.name}"))
    if centres:
        write_atomic(out / "centres.csv", _centres_csv(found))
    save_all(report.result, out)
    return report


def _centres_csv(found: RecordedMotion) -> str:
    frames = found.frames
    rows = [
        [id, f"{t:.6f}", *(f"{v:.9f}" for v in (*p, *n))]
        for id, t, p, n in zip(frames.ids, found.estimate.capture, frames.p_C, frames.n_C, strict=True)
    ]
    return csv_text(("id", "capture", *(f"{what}_{axis}" for what in ("centre", "normal") for axis in "xyz")), rows)
