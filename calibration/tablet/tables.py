"""CSV tables as people and spreadsheets write them: comma, semicolon or tab, decimal comma, any case and blanks in the header."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from weldcal.calibration.tablet.errors import TabletDataError

Row = dict[str, str]


def read_table(path: Path, columns: Sequence[str]) -> list[Row]:
    """Rows of a CSV file that has at least these columns (lower case), names and values stripped; empty rows are left out.

    Raises TabletDataError: no such file, no text, a column missing, a row that is too short.
    """
    if not path.is_file():
        raise TabletDataError(f"There is no file '{path}'.")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise TabletDataError(f"'{path.name}' is no CSV text.") from error
    lines = [line for line in lines if line.strip()]
    header = lines[0] if lines else ""
    delimiter = max(",;\t", key=header.count)
    names = [name.strip().lower() for name in next(csv.reader([header], delimiter=delimiter), [])]
    missing = [c for c in columns if c not in names]
    if missing:
        raise TabletDataError(f"'{path.name}' lacks the column{'s' if len(missing) > 1 else ''} {', '.join(missing)}.")
    rows = []
    for values in csv.reader(lines[1:], delimiter=delimiter):
        row = {name: value.strip() for name, value in zip(names, values, strict=False)}
        if not any(row.values()):
            continue
        if any(c not in row for c in columns):
            raise TabletDataError(f"'{path.name}' has a row with too few columns.")
        if delimiter != ",":
            row = {name: value.replace(",", ".") for name, value in row.items()}
        rows.append(row)
    return rows


def number(row: Row, column: str, path: Path) -> float:
    """The finite number of a column; raises TabletDataError."""
    try:
        value = float(row[column])
    except ValueError:
        value = float("nan")
    if not math.isfinite(value):
        raise TabletDataError(f"'{path.name}': '{row[column]}' in the column {column} is no number.")
    return value


def landmark(row: Row, path: Path) -> int:
    """The landmark's number, from 0; raises TabletDataError."""
    value = number(row, "landmark", path)
    if value < 0.0 or value != int(value):
        raise TabletDataError(f"'{path.name}': landmarks are whole numbers from 0, not '{row['landmark']}'.")
    return int(value)
