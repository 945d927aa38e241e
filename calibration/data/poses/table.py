"""Reads poses from CSV and text: named columns, bare rows of numbers, matrices row by row, and what ROS prints."""

import re
from pathlib import Path

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.columns import IDS, TIMES, column_poses
from weldcal.calibration.data.poses.form import PoseList, poses_from_array
from weldcal.calibration.data.tables import Row, read_rows
from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import read_text

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_NANO = 1e14  # a time above it is in nanoseconds
FLANGES = ("tool0", "flange", "tool0_controller", "wrist_3_link", "ee_link", "link_6", "panda_link8", "fr3_link8")
"""Frames that arms' descriptions call their flange, the likeliest first."""
BASES = ("base", "base_link", "world")


def read_table(path: Path, form: PoseForm) -> PoseList:
    """The poses of a CSV or text file. Raises DatasetError, one sentence that says what to change."""
    try:
        lines = [s for s in re.split(r"\r\n|\n|\r", read_text(path)) if s.strip() and not s.lstrip().startswith("#")]
        if not lines:
            raise DatasetError(f"'{path.name}' is empty.")
        rows = [_words(line) for line in lines]
        if all(_is_number(w) for w in rows[0]) or _bare(rows[0]):
            return _bare_table(path, rows, form)
        names, table = read_rows(path)
    except DatasetError:
        raise
    except InputError as e:
        raise DatasetError(str(e)) from e
    if not table:
        raise DatasetError(f"'{path.name}' holds no poses below its header.")
    return _named_table(path, names, table, form)


def _words(line: str) -> list[str]:
    return [w for w in re.split(r"[\s,;]+", re.sub(r"\bp\[|[\[\]()]", " ", line).strip()) if w]


def _is_number(word: str) -> bool:
    return _NUMBER.fullmatch(word) is not None


def _bare(words: list[str]) -> bool:
    """Whether a line without a header begins with a name, or is a stamped pose as `ros2 topic echo --csv` prints it."""
    numbers = [_is_number(w) for w in words]
    named = len(words) in (7, 8, 13, 17) and not numbers[0] and all(numbers[1:])
    return named or (len(words) == 10 and numbers.count(False) == 1 and not numbers[2])


def _bare_table(path: Path, rows: list[list[str]], form: PoseForm) -> PoseList:
    n = len(rows[0])
    uneven = next((k for k, row in enumerate(rows) if len(row) != n), None)
    if uneven is not None:
        raise DatasetError(
            f"'{path.name}' has {n} numbers in its first line and {len(rows[uneven])} in line {uneven + 1}."
        )
    ids: tuple[str, ...] = ()
    times = None
    if n == 10 and not _is_number(rows[0][2]):  # ROS 2: sec, nanosec, frame, position, orientation x y z w
        table = _numbers(path, [row[:2] + row[3:] for row in rows])
        form = PoseForm(rotation="quaternion_xyzw")
        X, said = poses_from_array(table[:, 2:], form, path.name)
        return PoseList(path.name, X, (), table[:, 0] + 1e-9 * table[:, 1], "m", "stamped ROS poses")
    if not _is_number(rows[0][0]):
        ids, rows, n = tuple(Path(row[0]).stem for row in rows), [row[1:] for row in rows], n - 1
    table = _numbers(path, rows)
    if n in (7, 8, 13, 17) and not ids:
        counted = np.array_equal(table[:, 0] - table[0, 0], np.arange(len(table)))
        unit = abs(float(np.linalg.norm(table[:, -4:], axis=1).mean()) - 1.0) < 1e-2
        if n in (13, 17) or (n == 8) or (counted and not unit):
            times, table = (None if counted else table[:, 0]), table[:, 1:]
    X, said = poses_from_array(table, form, path.name)
    return PoseList(path.name, X, ids, times, "", said)


def _numbers(path: Path, rows: list[list[str]]) -> Array:
    try:
        return np.array([[float(w) for w in row] for row in rows])
    except ValueError as e:
        raise DatasetError(f"'{path.name}' holds something that is not a number: {e}.") from e


def _named_table(path: Path, names: list[str], rows: list[Row], form: PoseForm) -> PoseList:
    child = next((n for n in names if n.endswith("child_frame_id")), None)
    if child is not None:
        rows = _one_transform(path, names, rows, child, form)
    table = np.array([[_cell(row[name]) for name in names] for row in rows])
    X, said, unit = column_poses(names, table, form, path.name)
    ros = any("." in n for n in names)
    id_column = next((n for n in names if n in IDS), None)
    time_column = next((n for n in names if n in TIMES or n.endswith("header.stamp")), None)
    ids = () if id_column is None else tuple(Path(row[id_column]).stem or row[id_column] for row in rows)
    _check_ids(path, ids)
    times = None if time_column is None else table[:, names.index(time_column)]
    if times is not None:
        stamped = next((n for n in names if n.endswith("header.stamp")), time_column)
        times = table[:, names.index(stamped or "")]
        times = times * 1e-9 if float(np.nanmax(times)) > _NANO else times
        if not np.isfinite(times).all():
            times = None
    return PoseList(path.name, X, ids, times, "m" if ros else unit, "ROS poses (x, y, z, w)" if ros else said)


def _check_ids(path: Path, ids: tuple[str, ...]) -> None:
    again = next((i for i in ids if ids.count(i) > 1), None)
    if again is not None:
        raise DatasetError(f"'{path.name}' gives the id '{again}' twice; keep one row for each scan.")
    if "" in ids:
        raise DatasetError(f"'{path.name}' has a row without an id.")


def _cell(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _one_transform(path: Path, names: list[str], rows: list[Row], child: str, form: PoseForm) -> list[Row]:
    """The rows of a table of transforms (tf) that lead to the flange from the base."""
    parent = next((n for n in names if n.endswith("frame_id") and n != child), child)
    found = sorted({(row[parent].strip("/"), row[child].strip("/")) for row in rows})
    flanges = [form.flange_frame] if form.flange_frame else list(FLANGES)
    bases = [form.base_frame] if form.base_frame else [parent for parent, _ in found]
    for flange in flanges:
        for base in sorted(set(bases), key=lambda b: BASES.index(b) if b in BASES else len(BASES)):
            if (base, flange) in found:
                return [r for r in rows if (r[parent].strip("/"), r[child].strip("/")) == (base, flange)]
    pairs = ", ".join(f"{a} to {b}" for a, b in found[:6])
    raise DatasetError(
        f"'{path.name}' holds the transforms {pairs}, none from the base to the flange; set poses.base_frame and poses.flange_frame in "
        "dataset.yaml, or record the pose topic of the driver."
    )
