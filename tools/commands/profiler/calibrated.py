"""weldcal profiler clock and seam: the offset of a calibrated profiler's clock, and a V-groove mapped into the base.

The folder of `profiler clock` holds stream.csv, as a recording in motion, and the profiles: profiles.csv with time,x,z,
the export of an instrument, or a folder with one file per profile. Of a profile of many points the feature at the side
is found; one point is the crossing. times.csv gives the time of each profile where the export holds none.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
import typer

from weldcal.calibration.data.motion_dataset import read_stream
from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.motion.line_clock import offset_from_line
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.profiler.edge.features import Kind, extract_edge
from weldcal.calibration.profiler.exports import SECONDS, TABLES, TREES, UNITS, Profiles
from weldcal.calibration.profiler.features.groove import groove_features
from weldcal.calibration.profiler.importing import profile_unit, profiles_of
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.record import load_record
from weldcal.calibration.profiler.text_blocks import blocks_of
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import read_text
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
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.profiler_file import ProfilerSeam, middle_error_mm, seam_report
from weldcal.tools.report.render import csv_text, write_atomic, write_json

_KINDS, _SIDES = ("bar", "step", "apex"), ("left", "right")
_STREAM, _TIMES = "stream.csv", "times.csv"
_NEAR_S = 0.5  # offset of the clocks that is searched
# Of the stream that the profiles last at least: seconds that are read as milliseconds last 0.002 of it at most
_SHARE = 0.01


@command("profiler clock", short_help="Find a profiler's clock from a straight edge.")
def clock(
    call: Call,
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="stream.csv of the robot, and the profiles with a time each.")
    ],
    calibration: Annotated[Path, option("--calibration", "RESULT", "Result folder of edge, sphere or compensate.")],
    robot: Annotated[str, option("--arm", "NAME", "The arm of a stream of joint angles.")] = "",
    unit: Annotated[str, option("--unit", "U", "m or mm, of the profiles and of the stream's positions.")] = "m",
    feature: Annotated[
        str, option("--feature", "KIND", "Where a time has many rows, the edge in them: bar, step or apex.")
    ] = "bar",
    side: Annotated[str, option("--side", "S", "End of the near face: left or right.")] = "left",
    pitch: PitchOption = None,
) -> Outcome:
    """Find the offset of a profiler's clock while the arm weaves across one straight edge: capture = stamp - offset."""
    out = call.folder("profiler", folder.resolve().name)
    if unit not in ("m", "mm"):
        raise InputError(f"The unit '{unit}' is not known; write m or mm.")
    if feature not in _KINDS or side not in _SIDES:
        raise InputError(f"The feature is one of {', '.join(_KINDS)}, and the side left or right.")
    record = load_record(calibration)
    source = _source(folder, {calibration.resolve(), out.resolve()})
    stream, said = read_stream(folder / _STREAM, robot=robot, unit=unit)
    profiles = profiles_of(source, pitch)[0]
    motion = ContinuousMotion(stream)
    stamps, time_unit = _stamps(folder, profiles, motion)
    time, points, lost = _crossings(profiles, stamps, UNITS[profile_unit(profiles, unit)], feature, side)
    if record.arm is not None:
        said.append("The calibration corrects the arm's joints; the stream's poses are used as they are.")
    found = offset_from_line(time, record.points_F(points), np.eye(4), motion)
    result: dict[str, object] = {
        "state": "done",
        "clock_offset_ms": 1e3 * found.offset_s,
        "clock_offset_sigma_ms": 1e3 * found.sigma_s,
        "rms_mm": 1e3 * found.rms_m,
        "rms_before_mm": 1e3 * found.before_m,
        "profiles": len(time),
        "reading": {"file": profiles.source, "form": profiles.form, "time_unit": time_unit},
        "without_feature": lost,
        "edge": {"point": found.point.tolist(), "direction": found.direction.tolist()},
        "warnings": said,
    }
    write_json(out / "clock.json", result)
    return Outcome(result | {"written_to": str(out)})


def _source(folder: Path, skip: set[Path]) -> Path:
    """Return the file or folder of the profiles: profiles.csv, or the only other one beside stream.csv."""
    plain = folder / "profiles.csv"
    found = [plain] if plain.exists() else []
    if not found and folder.is_dir():
        found = [
            p
            for p in sorted(folder.iterdir())
            if p.name not in (_STREAM, _TIMES)
            and p.resolve() not in skip
            and not p.name.startswith((".", "_"))
            and (
                p.suffix.lower() in (*TABLES, *TREES)
                if p.is_file()
                else any(q.suffix.lower() in (*TABLES, *TREES) for q in p.iterdir())
            )
        ]
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(p.name for p in found[:4])
        raise InputError(f"'{folder}' holds {names}. Keep one of them beside stream.csv, or name it profiles.csv.")
    raise InputError(
        f"There is no '{plain}'. Give a table with the columns time,x,z, or put an export of the profiler or a folder"
        " of profiles there."
    )


def _stamps(folder: Path, profiles: Profiles, motion: ContinuousMotion) -> tuple[Array, str]:
    """Find the times (n,) s of the profiles and their unit: the stated one, or the one that fits the robot's stream."""
    times, stated = profiles.times, profiles.time_unit
    if (folder / _TIMES).is_file():
        blocks = blocks_of(read_text(folder / _TIMES), _TIMES)
        times, stated = np.concatenate([b.table[:, 0] for b in blocks]) if blocks else np.zeros(0), ""
        if len(times) != len(profiles):
            raise InputError(
                f"'{_TIMES}' holds {len(times)} times and '{profiles.source}' {len(profiles)} profiles. Give one for"
                " each."
            )
    if times is None:
        raise InputError(
            f"'{profiles.source}' ({profiles.form}) holds {len(profiles)} profiles and no time of each. Write their"
            f" times into {_TIMES} in the same folder, a row each in the order of the profiles, or give profiles.csv"
            " with the columns time,x,z."
        )
    if stated:
        return SECONDS[stated] * times, stated
    begin, end = motion.span[0] - _NEAR_S, motion.span[1] + _NEAR_S
    for unit, scale in SECONDS.items():
        inside = np.count_nonzero((scale * times >= begin) & (scale * times <= end)) >= 0.5 * len(times)
        if inside and scale * float(np.nanmax(times) - np.nanmin(times)) >= _SHARE * (end - begin):
            return scale * times, unit
    raise InputError(
        f"The profiles' times run from {np.nanmin(times):.10g} to {np.nanmax(times):.10g}, and the robot's stream from"
        f" {motion.span[0]:.10g} to {motion.span[1]:.10g} s. Bring both to one clock within {_NEAR_S:g} s: add a"
        f" constant to the times, and write them into {_TIMES}, a row for each profile."
    )


def _crossings(profiles: Profiles, stamps: Array, scale: float, feature: str, side: str) -> tuple[Array, Array, int]:
    """Find times (n,) s and points (n, 2) m where profiles cross the edge, and how many do not show it."""
    kept, points, lost = [], [], 0
    for t, found in zip(stamps, profiles.points, strict=True):
        at = scale * found
        try:
            if len(at) > 1:
                at = extract_edge(at, cast(Kind, feature), cast(Literal["left", "right"], side))[0][None]
        except FeatureNotFound:
            lost += 1
            continue
        if np.isfinite(at).all() and np.isfinite(t):
            kept.append(float(t))
            points.append(at[0])
    return np.array(kept), np.array(points).reshape(-1, 2), lost


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
    """Return the measurements with their poses read as those of the calibration were.

    Raises InputError where several readings are left.
    """
    if len(data.readings) > 1:
        data = data.with_form(str(load_record(calibration).figures.get("robot_form", "")))
    if sum(not one.doubted for one in data.readings) > 1:
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
