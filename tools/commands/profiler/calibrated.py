"""weldcal profiler clock, seam and bead: the offset of a profiler's clock, a V-groove in the base, a bead's section.

The folder of `profiler clock` holds stream.csv, as a recording in motion, and the profiles: profiles.csv with time,x,z,
the export of an instrument, or a folder with one file per profile. Of a profile of many points the feature at the side
is found; one point is the crossing. times.csv gives the time of each profile where the export holds none.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
import typer
from numpy.typing import NDArray

from weldcal.calibration.data.motion_dataset import read_stream
from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.motion.line_clock import LineClock, offset_from_line
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.profiler.depth_sign import WORDS, SignFit, choose_sign, signs_to_try, with_sign
from weldcal.calibration.profiler.edge.features import Kind, extract_edge
from weldcal.calibration.profiler.exports import SECONDS, TABLES, TREES, UNITS, Profiles
from weldcal.calibration.profiler.features.bead import TOE_M, bead_features
from weldcal.calibration.profiler.features.bead_course import BeadCourse, bead_course, bead_volume
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
from weldcal.tools.report.profiler_file import BEAD, ProfilerBead, ProfilerSeam, middle_error_mm, seam_report
from weldcal.tools.report.render import csv_text, write_atomic, write_json

_KINDS = ("bar", "step", "apex")
_STREAM, _TIMES = "stream.csv", "times.csv"
_ALIKE = 3.0  # standard deviations within which two offsets are one
_NEAR_S = 0.5  # offset of the clocks that is searched
# Of the stream that the profiles last at least: seconds that are read as milliseconds last 0.002 of it at most
_SHARE = 0.01
_Extract = Callable[[Array], Array]
_SPREAD = ("mean", "smallest", "smallest_at", "largest", "largest_at", "sigma", "left_out_rms")


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
    extract: _Extract,
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
    fits: dict[str, SignFit], record: ProfilerRecord | None, total: int, what: str, alike: Callable[[], bool]
) -> tuple[str, dict[str, str]]:
    """Return the sign of z and the words on it; the calibration's own where the profiles do not contradict it.

    Raises InputError where they do: X_FS holds for one sign only.
    """
    figures = {} if record is None else record.figures
    own = next((g for g, word in WORDS.items() if word == figures.get("z_grows")), "")
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
    record = load_record(calibration)
    figures, root_mm = map_seam(data, record, folder, call.reading.get("z", ""))
    found = with_warnings(data, figures)
    of = partial(ProfilerSeam, source=file.name, calibration=calibration, out=folder, limit_mm=limit_mm)
    made = of(record=record, found=found, root_mm=root_mm)
    write_atomic(folder / "report.html", seam_report(made))
    return outcome_of(call, found, made)


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


def map_seam(file: Measurements, record: ProfilerRecord, folder: Path, z: str = "") -> tuple[dict[str, Any], Array]:
    """Write a V-groove's features of every profile in the base as seam.csv; return the summary, and the root in mm."""
    features, lost, words = _shown_features(file.profiles, _groove, record, z, "V-groove")
    columns = ["scan", *(f"{n}_{a}_mm" for n in ("edge_1", "root", "edge_2") for a in "xyz"), "rms_mm"]
    number, at, seen = _in_base(file, record, np.array(features)[:, :3], lost)
    at *= 1e3
    rms = 1e3 * np.array(features)[:, 3, :1]
    rows = [[k, *(f"{v:.4f}" for v in row)] for k, row in zip(number, np.hstack([at.reshape(-1, 9), rms]), strict=True)]
    write_atomic(folder / "seam.csv", csv_text(columns, rows))
    figures: dict[str, Any] = {"scans": len(rms) + len(lost), "found": len(rms), "without_groove": lost, **words}
    error_95_mm = middle_error_mm(record, seen.reshape(-1, 3))
    figures |= {"rms_mm": float(np.median(rms)), "error_95_mm": error_95_mm, "method": record.method}
    return figures, at[:, 1]


def _shown_features(
    profiles: Sequence[Array] | None, extract: _Extract, record: ProfilerRecord | None, z: str, what: str
) -> tuple[list[Array], list[int], dict[str, str]]:
    """Return the features of the profiles that show one, the numbers of the others, and the words on the sign of z.

    Raises:
        FeatureNotFound: no profile shows it. InputError: no profiles, or the calibration has the other sign.
    """
    if profiles is None:
        name = what.removeprefix("V-")
        raise InputError(f"The file has no 'profiles' of the {name}. Give (n, m, 2), or 'xz' with the lengths 'n'.")
    found = {grows: with_sign(profiles, extract, grows) for grows in signs_to_try(z)}
    fits = {g: SignFit(shown=len(at), kept=len(at), variance=1.0, freedom=len(at)) for g, (at, _) in found.items()}
    if not any(fit.shown for fit in fits.values()):
        raise FeatureNotFound(
            f"None of the {len(profiles)} profiles shows a {what} with plate on both sides, with z"
            f" {' or '.join(WORDS[g] for g in fits)}. Check the file, its unit{' and --toe-mm' * (what == 'bead')}."
        )
    grows, words = _chosen(fits, record, len(profiles), what.removeprefix("V-"), lambda: False)
    return *found[grows], words


def _groove(profile: Array) -> Array:
    """Rows (4, 2) m: edge, root and edge of a groove, z away from the sensor, and the rms of its samples."""
    f = groove_features(profile)
    return np.vstack([f.points, [f.rms_m, 0.0]])


@command("profiler bead", keys=("robot-form", "set", "trial", "pitch", "z"), short_help="Measure a bead on plates.")
def bead(
    call: Call,
    file: FileArgument,
    calibration: Annotated[
        Path | None, option("--calibration", "FOLDER", "Result folder of edge, sphere or compensate; gives stations.")
    ] = None,
    unit: UnitOption = None,
    poses: PosesOption = None,
    toe_mm: Annotated[float, option("--toe-mm", "MM", "Height over the plates at a toe.", min=0.01)] = 1e3 * TOE_M,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Measure a bead's width, height and area in each profile, and its volume along the seam, as bead.csv."""
    check_limit(limit_mm)
    folder = call.folder("profiler", file.stem)
    data = read_measurements(call, file, unit, poses, posed=calibration is not None)
    record = None if calibration is None else load_record(calibration)
    data = data if calibration is None else _as_calibrated(data, calibration)
    course, figures = measure_bead(data, record, folder, 1e-3 * toe_mm, call.reading.get("z", ""))
    found = with_warnings(data, figures)
    made = ProfilerBead(record=record, found=found, course=course, source=file.name, out=folder, limit_mm=limit_mm)
    write_atomic(folder / "report.html", made.page)
    return outcome_of(call, found, made)


def measure_bead(
    file: Measurements, record: ProfilerRecord | None, folder: Path, toe_m: float, z: str
) -> tuple[BeadCourse, dict[str, Any]]:
    """Write a bead's values of every profile as bead.csv; return them along the seam, and the summary."""
    shown, lost, words = _shown_features(file.profiles, partial(_bead, toe_m), record, z, "bead")
    found, total = np.array(shown), len(shown) + len(lost)
    number, points_B, middle = np.delete(np.arange(total), lost), None, np.full((len(shown), 3), np.nan)
    if record is not None:
        _, points_B, _ = _in_base(file, record, found[:, :4], lost)
        middle = 1e3 * points_B[:, :2].mean(axis=1)
    course = bead_course(found[:, 4:7, 0], found[:, 7:, 0], number, points_B)
    at, scale = course.station * (1.0 if record is None else 1e3), np.array([unit for _, unit in BEAD.values()])
    values, sigmas, left = scale * course.values, scale * course.sigmas, scale * course.left_out
    table = np.column_stack([at, middle, values, sigmas, left])
    rows = [[k, *(f"{v:.4f}" for v in row)] for k, row in zip(number, table, strict=True)]
    columns = ["scan", "profile" if record is None else "station_mm", "x_mm", "y_mm", "z_mm"]
    columns += [f"{key}{end}" for end in ("", "_sigma", "_left_out") for key in BEAD]
    write_atomic(folder / "bead.csv", csv_text(columns, rows))
    figures: dict[str, Any] = {"scans": total, "found": len(at), "without_bead": lost, **words}
    for key, value, sigma, rest in zip(BEAD, values.T, sigmas.T, left.T, strict=True):
        low, high, rms = np.argmin(value), np.argmax(value), np.sqrt(np.mean(rest**2))
        numbers = (value.mean(), value[low], at[low], value[high], at[high], np.median(sigma), rms)
        figures[key] = dict(zip(_SPREAD, map(float, numbers), strict=True))
    figures["unlike_profiles"] = number[course.unlike].tolist()
    if record is not None:
        volume, sigma, length = bead_volume(course, number)
        figures |= {"length_mm": 1e3 * length, "volume_mm3": 1e9 * volume, "volume_sigma_mm3": 1e9 * sigma}
    return course, figures


def _in_base(
    file: Measurements, record: ProfilerRecord, points: Array, lost: list[int]
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the numbers of the profiles that are not lost, and their points (n, k, 2) m in base and flange."""
    poses = record.flange(cast(FlangePoses, file.poses()), file.arrays.get("q"))
    check_number(poses, (len(points) + len(lost),), "profiles")
    number = np.delete(np.arange(len(poses)), lost)
    points_F = record.points_F(points.reshape(-1, 2)).reshape(*points.shape[:2], 3)
    return number, points_F @ poses.rotation[number].transpose(0, 2, 1) + poses.translation[number][:, None], points_F


def _bead(toe_m: float, profile: Array) -> Array:
    """Rows (10, 2): four points [x, z] m, then width m, height m, area m2 and the sigma of each in the first column."""
    f = bead_features(profile, toe_m)
    return np.vstack([f.points, np.outer([*f.values, *f.sigmas], [1.0, 0.0])])
