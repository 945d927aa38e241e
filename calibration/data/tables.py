"""Reads CSV tables with any usual separator, decimal commas, comments and headers in any case."""

import csv
import re
from pathlib import Path

from weldcal.models.errors import InputError

Row = dict[str, str]

_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")


def read_rows(path: Path) -> tuple[list[str], list[Row]]:
    """Names of the columns (lower case) and the rows by name, all stripped; a cell that is missing is empty.

    The separator is the one that the header has most of: comma, semicolon, tab, else blanks. Lines that begin with #, empty
    lines and rows without a value are skipped. Decimal commas become points where the comma separates nothing. Raises
    InputError: no such file, no text.
    """
    table, separator = _cells(path)
    if not table:
        return [], []
    names, rows = [name.lower() for name in table[0]], []
    for values in table[1:]:
        if separator != ",":
            values = [v.replace(",", ".") if _DECIMAL_COMMA.fullmatch(v) else v for v in values]
        if any(values):
            rows.append(dict.fromkeys(names, "") | dict(zip(names, values, strict=False)))
    return names, rows


def cut_off(path: Path) -> str | None:
    """A sentence where a CSV file seems to end within its last row, None else: that row has fewer cells than the header, or no
    line break follows it and its last number is shorter than all others of its column. Raises what read_rows raises."""
    table, _ = _cells(path)
    rows = [row for row in table[1:] if any(row)]
    if not rows:
        return None
    width, last = len(table[0]), rows[-1]
    if len(last) < width:
        return (
            f"The last row of '{path.name}' has {len(last)} of {width} cells: the file is cut off there, and that row is not used. "
            "Copy the file again."
        )
    open_end = not path.read_bytes().endswith((b"\n", b"\r"))
    others = [len(row[width - 1]) for row in rows[:-1] if len(row) >= width and row[width - 1]]
    if open_end and last[width - 1] and len(others) > 1 and len(last[width - 1]) < min(others):
        return f"The last row of '{path.name}' may be cut off within its last number, {last[width - 1]}. Copy the file again."
    return None


def _cells(path: Path) -> tuple[list[list[str]], str]:
    """All rows as stripped cells, the header first, and the separator."""
    if not path.is_file():
        raise InputError(f"There is no file '{path}'.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as e:
        raise InputError(f"'{path.name}' is not a CSV text file.") from e
    if "\0" in text:
        raise InputError(f"'{path.name}' is not a CSV text file.")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        return [], ","
    separator = max(",;\t", key=lines[0].count)
    if separator not in lines[0] and len(lines[0].split()) > 1:
        separator, lines = " ", [" ".join(line.split()) for line in lines]
    return [
        [cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator, skipinitialspace=True)
    ], separator
