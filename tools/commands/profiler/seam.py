"""weldcal profiler seam: a V-groove mapped into the base with a calibrated profiler, with its report."""

from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np

from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.profiler.features.groove import groove_features
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.record import load_record
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option
from weldcal.tools.commands.profiler.files import Measurements, PosesStated, read_profiler_file
from weldcal.tools.commands.profiler.result import (
    FileArgument,
    FormOption,
    PitchOption,
    PosesOption,
    TrialOption,
    UnitOption,
    check_number,
    outcome_of,
    with_warnings,
)
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.profiler_file import ProfilerSeam, middle_error_mm, seam_report
from weldcal.tools.report.render import write_atomic


@command("profiler seam", short_help="Map a V-groove in the base frame.")
def seam(
    call: Call,
    file: FileArgument,
    calibration: Annotated[Path, option("--calibration", "FOLDER", "Result folder of edge, sphere or compensate.")],
    unit: UnitOption = None,
    trial: TrialOption = None,
    poses: PosesOption = None,
    robot_form: FormOption = "",
    pitch: PitchOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Map both edges and the root of a V-groove from raw profiles into the base frame, as seam.csv."""
    check_limit(limit_mm)
    folder = call.folder("profiler", file.stem)
    data = read_profiler_file(file, unit=unit, trial=trial, stated=PosesStated(poses, robot_form, pitch))
    data = _as_calibrated(data, calibration)
    found = with_warnings(data, map_seam(data, calibration, folder))
    return outcome_of(call, found, finish_seam(found, calibration, file.name, folder, limit_mm))


def _as_calibrated(data: Measurements, calibration: Path) -> Measurements:
    """The measurements with their poses read as those of the calibration were. Raises InputError where several readings
    are left."""
    if len(data.readings) > 1:
        data = data.with_form(str(load_record(calibration).figures.get("robot_form", "")))
    if len(data.readings) > 1:
        one, other = data.readings[:2]
        raise InputError(
            f"A seam does not show how its poses are written: as {one.words}, or as {other.words} ({len(data.readings)}"
            f" readings). State it, for example with --robot-form {one.form} or --robot-form {other.form}."
        )
    return data


def map_seam(file: Measurements, calibration: Path, folder: Path) -> dict[str, Any]:
    """Writes a V-groove's three features of every profile in the base frame as seam.csv; returns the summary."""
    record = load_record(calibration)
    if file.profiles is None:
        raise InputError("The file has no 'profiles' of the groove. Give (n, m, 2), or 'xz' with the lengths 'n'.")
    poses = record.flange(cast(FlangePoses, file.poses()), file.arrays.get("q"))
    check_number(poses, (len(file.profiles),), "profiles")
    columns = ["scan", *(f"{n}_{a}_mm" for n in ("edge_1", "root", "edge_2") for a in "xyz"), "rms_mm"]
    rows, lost, rms, seen = [], [], [], []
    for k, p in enumerate(file.profiles):
        try:
            f = groove_features(p)
        except FeatureNotFound:
            lost.append(k)
            continue
        seen.append(record.points_F(f.points))
        at = seen[-1] @ poses.rotation[k].T + poses.translation[k]
        rows.append([k, *(f"{1e3 * v:.4f}" for v in at.ravel()), f"{1e3 * f.rms_m:.4f}"])
        rms.append(f.rms_m)
    if not rms:
        raise FeatureNotFound(
            "No profile of the file shows a V-groove with plate on both sides. Check the file and its unit."
        )
    write_atomic(folder / "seam.csv", csv_text(columns, rows))
    return {
        "scans": len(poses),
        "found": len(rms),
        "without_groove": lost,
        "rms_mm": 1e3 * float(np.median(rms)),
        "error_95_mm": middle_error_mm(record, np.vstack(seen)),
        "method": record.method,
    }


def finish_seam(
    found: dict[str, Any], calibration: Path, source: str, out: Path, limit_mm: float | None
) -> ProfilerSeam:
    """Write the report of a mapped seam, from the seam.csv beside it."""
    columns = np.genfromtxt(out / "seam.csv", delimiter=",", names=True)
    root = np.column_stack([np.atleast_1d(columns[f"root_{a}_mm"]) for a in "xyz"])
    seam = ProfilerSeam(
        record=load_record(calibration),
        found=found,
        root_mm=root,
        source=source,
        calibration=calibration,
        out=out,
        limit_mm=limit_mm,
    )
    write_atomic(out / "report.html", seam_report(seam))
    return seam
