"""Reads the tablet's CSV tables: required columns and numeric cells."""

import math
from collections.abc import Sequence
from pathlib import Path

from weldcal.calibration.data.tables import Row, read_rows
from weldcal.calibration.tablet.errors import TabletDataError
from weldcal.models.errors import InputError
from weldcal.models.limits import LARGEST_NUMBER


def read_table(path: Path, columns: Sequence[str]) -> list[Row]:
    """Rows of a CSV file that has at least these columns (lower case); a cell that is missing is empty.

    Raises TabletDataError: no such file, no text, a column missing.
    """
    try:
        names, rows = read_rows(path)
    except InputError as error:
        raise TabletDataError(str(error)) from error
    missing = [c for c in columns if c not in names]
    if missing:
        raise TabletDataError(f"'{path.name}' lacks the column{'s' if len(missing) > 1 else ''} {', '.join(missing)}.")
    return rows


def number(row: Row, column: str, path: Path) -> float:
    """The finite number of a column; raises TabletDataError."""
    try:
        value = float(row[column])
    except ValueError:
        value = float("nan")
    if not math.isfinite(value):
        raise TabletDataError(f"'{path.name}': '{row[column][:40]}' in the column {column} is not a number.")
    if abs(value) > LARGEST_NUMBER:
        raise TabletDataError(f"'{path.name}': {row[column][:40]} in the column {column} is beyond {LARGEST_NUMBER:g}.")
    return value


def landmark(row: Row, path: Path) -> int:
    """The landmark's number, from 0; raises TabletDataError."""
    value = number(row, "landmark", path)
    if value < 0.0 or value != int(value):
        raise TabletDataError(f"'{path.name}': landmarks are whole numbers from 0, not '{row['landmark'][:40]}'.")
    return int(value)
