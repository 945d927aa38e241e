"""Reads CSV tables with any usual separator, decimal commas, comments and headers in any case."""

import csv
import re
from collections.abc import Iterator
from pathlib import Path

from weldcal.models.errors import InputError
from weldcal.models.files import MOST_CELLS, MOST_COLUMNS, read_text

Row = dict[str, str]

_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")


def read_rows(path: Path) -> tuple[list[str], list[Row]]:
    """Names of the columns (lower case) and the rows by name, all stripped; a cell that is missing is empty.

    The separator is the one that the header has most of: comma, semicolon, tab, else blanks. Lines that begin with #,
    empty lines and rows without a value are skipped. Decimal commas become points where the comma separates nothing.
    Raises InputError: no regular file, no UTF-8 text, larger than the bounds in models/files.py, a column named twice,
    a row with more values than columns, a quote that does not end; with the line's number.
    """
    names: list[str] = []
    rows: list[Row] = []
    for k, (line, values) in enumerate(_cells(path)):
        if k == 0:
            names = _names(path, values)
            continue
        if any(values[len(names) :]):
            raise InputError(
                f"'{path.name}', line {line}: {len(values)} cells, and the header names {len(names)} columns; decimal"
                " commas need semicolons or tabs between the columns."
            )
        if any(values):
            rows.append(dict.fromkeys(names, "") | dict(zip(names, values, strict=False)))
        if len(rows) * len(names) > MOST_CELLS:
            raise InputError(f"'{path.name}' has more than {MOST_CELLS} cells, the most that are read.")
    return names, rows


def cut_off(path: Path) -> str | None:
    """A sentence where a CSV file seems to end within its last row, None else: that row has fewer cells than the
    header, or no line break follows it and its last number is shorter than all others of its column. Raises what
    read_rows raises."""
    table = [values for _, values in _cells(path)]
    rows = [row for row in table[1:] if any(row)]
    if not rows:
        return None
    width, last = len(table[0]), rows[-1]
    if len(last) < width:
        return (
            f"The last row of '{path.name}' has {len(last)} of {width} cells: the file is cut off there, and that row"
            " is not used. Copy the file again."
        )
    open_end = not path.read_bytes().endswith((b"\n", b"\r"))
    others = [len(row[width - 1]) for row in rows[:-1] if len(row) >= width and row[width - 1]]
    if open_end and last[width - 1] and len(others) > 1 and len(last[width - 1]) < min(others):
        return (
            f"The last row of '{path.name}' may be cut off within its last number, {last[width - 1]}. Copy the file"
            " again."
        )
    return None


def _cells(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and stripped cells of all rows, the header first, with decimal points.

    Raises InputError as read_rows.
    """
    lines = [
        (number, line)
        for number, line in enumerate(re.split(r"\r\n|\n|\r", read_text(path)), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        return
    begin = lines[0][1]
    separator = max(",;\t", key=begin.count)
    if separator not in begin and len(begin.split()) > 1:
        separator, lines = " ", [(number, " ".join(line.split())) for number, line in lines]
    reader = csv.reader((line for _, line in lines), delimiter=separator, skipinitialspace=True, strict=True)
    line = lines[0][0]
    try:
        for cells in reader:
            line = lines[reader.line_num - 1][0]
            values = [cell.strip() for cell in cells]
            if separator != ",":
                values = [v.replace(",", ".") if _DECIMAL_COMMA.fullmatch(v) else v for v in values]
            yield line, values
    except csv.Error as e:
        number = lines[min(reader.line_num, len(lines) - 1)][0]
        what = "has a cell of more than 131072 characters" if "field larger" in str(e) else f"cannot be read ({e})"
        raise InputError(f"'{path.name}', line {max(line, number)}, {what}.") from e


def _names(path: Path, cells: list[str]) -> list[str]:
    """The columns' names; refuses two of one name."""
    names = [name.lower() for name in cells]
    if len(names) > MOST_COLUMNS:
        raise InputError(f"'{path.name}' has {len(names)} columns, more than {MOST_COLUMNS}, the most that are read.")
    again = next((name for name in names if name and names.count(name) > 1), None)
    if again is not None:
        raise InputError(f"'{path.name}' has two columns '{again[:40]}'; keep one.")
    return names
