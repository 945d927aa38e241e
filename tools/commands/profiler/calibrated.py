"""weldcal profiler clock and seam: the offset of a calibrated profiler's clock, and a V-groove mapped into the base.

The folder of `profiler clock` holds stream.csv, as a recording in motion, and the profiles: profiles.csv with time,x,z,
the export of an instrument, or a folder with one file per profile. Of a profile of many points the feature at the side
is found; one point is the crossing. times.csv gives the time of each profile where the export holds none.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
import typer

from weldcal.calibration.data.motion_dataset import read_stream
from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.motion.line_clock import LineClock, offset_from_line
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.profiler.depth_sign import WORDS, SignFit, choose_sign, signs_to_try, with_sign
from weldcal.calibration.profiler.edge.features import Kind, extract_edge
from weldcal.calibration.profiler.exports import SECONDS, TABLES, TREES, UNITS, Profiles
from weldcal.calibration.profiler.features.groove import groove_features
from weldcal.calibration.profiler.importing import profile_unit, profiles_of
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.record import ProfilerRecord, load_record
from weldcal.calibration.profiler.text_blocks import blocks_of
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.files import read_text
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option
from weldcal.tools.commands.profiler.files import Measurements
from weldcal.tools.commands.profiler.result import (
    FileArgument,
    PosesOption,
    UnitOption,
    check_number,
    outcome_of,
    read_measurements,
    with_warnings,
)
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.profiler_file import ProfilerSeam, middle_error_mm, seam_report
from weldcal.tools.report.render import csv_text, write_atomic, write_json

_KINDS = ("bar", "step", "apex")
_STREAM, _TIMES = "stream.csv", "times.csv"
_ALIKE = 3.0  # standard deviations within which two offsets are one
_NEAR_S = 0.5  # offset of the clocks that is searched
# Of the stream that the profiles last at least: seconds that are read as milliseconds last 0.002 of it at most
_SHARE = 0.01


@command("profiler clock", keys=("pitch", "side", "z"), short_help="Find a profiler's clock from a straight edge.")
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
) -> Outcome:
    """Find the offset of a profiler's clock while the arm weaves across one straight edge: capture = stamp - offset."""
    out = call.folder("profiler", folder.resolve().name)
    side, z = call.reading.get("side", "left"), call.reading.get("z", "")
    if unit not in ("m", "mm"):
        raise InputError(f"The unit '{unit}' is not known; write m or mm.")
    if feature not in _KINDS:
        raise InputError(f"The feature is one of {', '.join(_KINDS)}, not '{feature}'.")
    record = load_record(calibration)
    source = _source(folder, {calibration.resolve(), out.resolve()})
    stream, said = read_stream(folder / _STREAM, robot=robot, unit=unit)
    profiles = profiles_of(source, call.reading.get("pitch"))[0]
    motion = ContinuousMotion(stream)
    stamps, time_unit = _stamps(folder, profiles, motion)
    scale = UNITS[profile_unit(profiles, unit)]
    found, time, lost, words = _offset(record, motion, profiles, stamps, scale, partial(_edge, feature, side), z)
    if record.arm is not None:
        said.append("The calibration corrects the arm's joints; the stream's poses are used as they are.")
    result: dict[str, object] = {
        "state": "done",
        "clock_offset_ms": 1e3 * found.offset_s,
        "clock_offset_sigma_ms": 1e3 * found.sigma_s,
        "rms_mm": 1e3 * found.rms_m,
        "rms_before_mm": 1e3 * found.before_m,
        "profiles": len(time),
        **words,
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


def _edge(feature: str, side: str, profile: Array) -> Array:
    """Point (2,) m at which a profile crosses the edge, z away from the sensor; of one point itself."""
    if len(profile) == 1:
        return np.asarray(profile[0])
    return extract_edge(profile, cast(Kind, feature), cast(Literal["left", "right"], side))[0]


def _offset(
    record: ProfilerRecord,
    motion: ContinuousMotion,
    profiles: Profiles,
    stamps: Array,
    scale: float,
    extract: Callable[[Array], Array],
    z: str,
) -> tuple[LineClock, Array, int, dict[str, str]]:
    """Find the clock's offset, the times (n,) s of the crossings, the profiles without one, and the sign of z."""
    fits, found, total = {}, {}, len(profiles)
    for grows in signs_to_try(z):
        at, lost = with_sign([scale * p for p in profiles.points], extract, grows)
        points, time = np.array(at).reshape(-1, 2), np.delete(stamps, lost)
        good = np.isfinite(points).all(axis=1) & np.isfinite(time)
        n = int(good.sum())
        try:
            line = offset_from_line(time[good], record.points_F(points[good]), np.eye(4), motion)
        except WeldcalError as error:
            fits[grows] = SignFit(shown=n, error=error)
            continue
        found[grows] = line, time[good], len(lost)
        fits[grows] = SignFit(shown=n, kept=n, variance=line.rms_m**2, freedom=2 * n - 5)
        if all(len(p) == 1 for p in profiles.points):  # crossings have no feature to seek
            return *found[grows], {}

    def alike() -> bool:
        (a, *_), (b, *_) = found.values()
        return bool(abs(a.offset_s - b.offset_s) < _ALIKE * np.hypot(a.sigma_s, b.sigma_s))

    grows, words = _chosen(fits, record, total, "edge", alike)
    return *found[grows], words


def _chosen(
    fits: dict[str, SignFit], record: ProfilerRecord, total: int, what: str, alike: Callable[[], bool]
) -> tuple[str, dict[str, str]]:
    """Return the sign of z and the words on it; the calibration's own where the profiles do not contradict it.

    Raises InputError where they do: X_FS holds for one sign only.
    """
    own = next((g for g, word in WORDS.items() if word == record.figures.get("z_grows")), "")
    if own in fits and 2 * fits[own].kept >= max(fit.kept for fit in fits.values()) > 0:
        fits = {own: fits[own]}
    grows, reason = choose_sign(fits, total, what, alike)
    if own and grows != own:
        raise InputError(
            f"z grows {WORDS[grows]} in these profiles and {WORDS[own]} in those of the calibration, and X_FS holds for"
            " one of both. Calibrate with profiles of this form."
        )
    return grows, {"z_grows": WORDS[grows], "z_reason": reason}


@command(
    "profiler seam", keys=("robot-form", "set", "trial", "pitch", "z"), short_help="Map a V-groove in the base frame."
)
def seam(
    call: Call,
    file: FileArgument,
    calibration: Annotated[Path, option("--calibration", "FOLDER", "Result folder of edge, sphere or compensate.")],
    unit: UnitOption = None,
    poses: PosesOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Map both edges and the root of a V-groove from raw profiles into the base frame, as seam.csv."""
    check_limit(limit_mm)
    folder = call.folder("profiler", file.stem)
    data = _as_calibrated(read_measurements(call, file, unit, poses), calibration)
    found = with_warnings(data, map_seam(data, calibration, folder, call.reading.get("z", "")))
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
            f" readings). State it, for example with --as robot-form={one.form} or --as robot-form={other.form}."
        )
    return data


def map_seam(file: Measurements, calibration: Path, folder: Path, z: str = "") -> dict[str, Any]:
    """Writes a V-groove's three features of every profile in the base frame as seam.csv; returns the summary."""
    record = load_record(calibration)
    if file.profiles is None:
        raise InputError("The file has no 'profiles' of the groove. Give (n, m, 2), or 'xz' with the lengths 'n'.")
    poses = record.flange(cast(FlangePoses, file.poses()), file.arrays.get("q"))
    check_number(poses, (len(file.profiles),), "profiles")
    columns = ["scan", *(f"{n}_{a}_mm" for n in ("edge_1", "root", "edge_2") for a in "xyz"), "rms_mm"]
    found = {grows: with_sign(file.profiles, _groove, grows) for grows in signs_to_try(z)}
    fits = {g: SignFit(shown=len(at), kept=len(at), variance=1.0, freedom=len(at)) for g, (at, _) in found.items()}
    if not any(fit.shown for fit in fits.values()):
        raise FeatureNotFound(
            f"None of the {len(poses)} profiles shows a V-groove with plate on both sides, with z"
            f" {' or '.join(WORDS[g] for g in fits)}. Check the file and its unit."
        )
    grows, words = _chosen(fits, record, len(poses), "groove", lambda: False)
    features, lost = found[grows]
    rows, rms, seen = [], [], []
    for k, f in zip(np.delete(np.arange(len(poses)), lost), features, strict=True):
        seen.append(record.points_F(f[:3]))
        at = seen[-1] @ poses.rotation[k].T + poses.translation[k]
        rms.append(float(f[3, 0]))
        rows.append([k, *(f"{1e3 * v:.4f}" for v in at.ravel()), f"{1e3 * rms[-1]:.4f}"])
    write_atomic(folder / "seam.csv", csv_text(columns, rows))
    return {
        "scans": len(poses),
        "found": len(rms),
        "without_groove": lost,
        **words,
        "rms_mm": 1e3 * float(np.median(rms)),
        "error_95_mm": middle_error_mm(record, np.vstack(seen)),
        "method": record.method,
    }


def _groove(profile: Array) -> Array:
    """Rows (4, 2) m: edge, root and edge of a groove, z away from the sensor, and the rms of its samples."""
    f = groove_features(profile)
    return np.vstack([f.points, [f.rms_m, 0.0]])


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
