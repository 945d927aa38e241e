"""weldcal profiler clock: the offset of a profiler's clock from profiles of one straight edge, taken while the arm moves."""

from pathlib import Path
from typing import Annotated, Literal, cast

import numpy as np
import typer

from weldcal.calibration.data.motion_dataset import read_stream
from weldcal.calibration.data.tables import read_rows
from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.motion.line_clock import offset_from_line
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.profiler.edge.features import Kind, extract_edge
from weldcal.calibration.profiler.record import load_record
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.files import write_json

_COLUMNS = ("time", "x", "z")
_KINDS, _SIDES = ("bar", "step", "apex"), ("left", "right")
_UNITS = {"m": 1.0, "mm": 1e-3}


@command("profiler clock", short_help="Find a profiler's clock from a straight edge.")
def clock(
    call: Call,
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="stream.csv of the robot and profiles.csv (time,x,z).")
    ],
    calibration: Annotated[Path, option("--calibration", "RESULT", "Result folder of edge, sphere or compensate.")],
    robot: Annotated[str, option("--arm", "NAME", "The arm of a stream of joint angles.")] = "",
    unit: Annotated[str, option("--unit", "U", "m or mm, of the profiles and of the stream's positions.")] = "m",
    feature: Annotated[
        str, option("--feature", "KIND", "Where a time has many rows, the edge in them: bar, step or apex.")
    ] = "bar",
    side: Annotated[str, option("--side", "S", "End of the near face: left or right.")] = "left",
) -> Outcome:
    """Find the offset of a profiler's clock while the arm weaves across one straight edge: capture = stamp - offset."""
    out = call.folder("profiler", folder.resolve().name)
    return Outcome(find_clock(folder, calibration, out, robot=robot, unit=unit, feature=feature, side=side))


def find_clock(
    folder: Path, calibration: Path, out: Path, *, robot: str = "", unit: str = "m", feature: str = "bar", side: str = "left"
) -> dict[str, object]:  # fmt: skip
    """Find the offset of a profiler's clock and write clock.json to ``out``.

    ``folder`` holds stream.csv (as a recording in motion) and profiles.csv with time,x,z: one row per time is the point at which the
    profile crosses the edge, many rows are a raw profile, in which the ``feature`` at the ``side`` is found.
    Raises InputError: the files cannot be used; TooFewPoses, UndeterminedPoses: the motion does not show the offset.
    """
    if unit not in _UNITS:
        raise InputError(f"The unit '{unit}' is not known; write m or mm.")
    if feature not in _KINDS or side not in _SIDES:
        raise InputError(f"The feature is one of {', '.join(_KINDS)}, and the side left or right.")
    record = load_record(calibration)
    stream, said = read_stream(folder / "stream.csv", robot=robot, unit=unit)
    time, points, lost = _crossings(folder / "profiles.csv", _UNITS[unit], feature, side)
    if record.arm is not None:
        said.append("The calibration corrects the arm's joints; the stream's poses are used as they are.")
    found = offset_from_line(time, record.points_F(points), np.eye(4), ContinuousMotion(stream))
    result: dict[str, object] = {
        "state": "done",
        "clock_offset_ms": 1e3 * found.offset_s,
        "clock_offset_sigma_ms": 1e3 * found.sigma_s,
        "rms_mm": 1e3 * found.rms_m,
        "rms_before_mm": 1e3 * found.before_m,
        "profiles": len(time),
        "without_feature": lost,
        "edge": {"point": found.point.tolist(), "direction": found.direction.tolist()},
        "warnings": said,
    }
    write_json(out / "clock.json", result)
    return result | {"written_to": str(out)}


def _crossings(path: Path, scale: float, feature: str, side: str) -> tuple[Array, Array, int]:
    """Times (n,) s, points (n, 2) m at which the profiles cross the edge, and the number of profiles that do not show it."""
    if not path.is_file():
        raise InputError(f"There is no '{path}'; give a table with the columns {','.join(_COLUMNS)}.")
    names, rows = read_rows(path)
    if not set(_COLUMNS) <= set(names):
        raise InputError(f"'{path.name}' has the columns {','.join(names)[:80]}; it needs {','.join(_COLUMNS)}.")
    try:
        table = np.array([[float(row[c] or "nan") for c in _COLUMNS] for row in rows]).reshape(-1, 3)
    except ValueError:
        raise InputError(f"'{path.name}' holds words where numbers are needed; correct it.") from None
    table = table[np.isfinite(table[:, 0])]
    table = table[np.argsort(table[:, 0], kind="stable")]
    times, first, counts = np.unique(table[:, 0], return_index=True, return_counts=True)
    kept, points, lost = [], [], 0
    for t, begin, n in zip(times, first, counts, strict=True):
        profile = scale * table[begin : begin + n, 1:]
        try:
            at = (
                profile[0]
                if n == 1
                else extract_edge(profile, cast(Kind, feature), cast(Literal["left", "right"], side))[0]
            )
        except FeatureNotFound:
            lost += 1
            continue
        if np.isfinite(at).all():
            kept.append(float(t))
            points.append(at)
    return np.array(kept), np.array(points).reshape(-1, 2), lost
