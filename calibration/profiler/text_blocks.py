"""Split the text of a profile export into blocks of numbers, each with its header and the caption before it."""

import re
from dataclasses import dataclass

import numpy as np

from weldcal.calibration.profiler.motion import Floats
from weldcal.models.errors import InputError
from weldcal.models.files import MOST_CELLS

_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")
_UNIT = re.compile(r"[\[(].{0,6}[\])]|mm|µm|um|m")
_NOTHING = ("", "-", "--", "---", "invalid", "none", "null", "n/a", "na", "fffffff", "-fffffff")
_SAMPLE = 200  # lines that decide the separator


@dataclass(frozen=True, eq=False)
class NumberRows:
    """Rows of numbers that follow each other.

    Attributes:
        header: the names of the columns, or empty.
        caption: the line of words before the block, or empty.
        table: (rows, columns), NaN where a cell is empty.
        line: number of the first row's line in the file.
    """

    header: tuple[str, ...]
    caption: str
    table: Floats
    line: int


def separator_of(lines: list[str]) -> str:
    """The mark between the cells of most lines: semicolon, tab, comma, or blanks."""
    sample = [s for s in lines if re.search(r"\d", s)][:_SAMPLE]
    if not sample:
        return ","
    for mark in (";", "\t"):
        if sum(mark in s for s in sample) >= 0.5 * len(sample):
            return mark
    words = [w for s in sample for w in s.split() if "," in w]
    if words and all(_DECIMAL_COMMA.fullmatch(w) for w in words) and any(len(s.split()) > 1 for s in sample):
        return " "
    return "," if any("," in s for s in sample) else " "


def cells_of(line: str, separator: str) -> list[str]:
    """The cells of a line, stripped, with decimal points."""
    plain = re.sub(r"\s+([\[(])", r"\1", line).split() if separator == " " else line.split(separator)
    if separator not in line and len(words := line.split()) > 1 and all(map(_is_number, words)):
        plain = words  # blanks in one line of a table with another mark
    cells = [c.strip().strip("\"'") for c in plain]
    if separator != ",":
        cells = [c.replace(",", ".") if _DECIMAL_COMMA.fullmatch(c) else c for c in cells]
    return cells


def _is_number(word: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?", word) is not None


def number_in(cell: str) -> float | None:
    """The number in a cell: NaN where it says that nothing was measured, None where it holds words."""
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return float("nan") if cell.lower() in _NOTHING else None


def blocks_of(text: str, name: str) -> list[NumberRows]:
    """The blocks of a text: a blank line, a line of words or another header ends one.

    Raises:
        InputError: rows of a block have different lengths, or the file has more cells than are read.
    """
    lines = re.split(r"\r\n|\n|\r", text.lstrip("\ufeff"))
    separator = separator_of(lines)
    found: list[NumberRows] = []
    header: tuple[str, ...] = ()
    caption = ""
    rows: list[list[float]] = []
    worded: set[int] = set()  # columns that hold words in the first row
    first = total = wide = 0

    def close() -> None:
        nonlocal rows, caption
        if rows:
            width = len(header) if header else max(map(len, rows))
            table = np.full((len(rows), width), np.nan)
            for k, row in enumerate(rows):
                if len(row) > width and np.isfinite(row[width:]).any():
                    raise InputError(
                        f"'{name}', line {first + k}: {len(row)} cells, and the header names {width} columns; decimal"
                        " commas need semicolons or tabs between the columns."
                    )
                table[k, : min(len(row), width)] = row[:width]
            found.append(NumberRows(header, caption, table, first))
            rows, caption = [], ""

    for number, line in enumerate(lines, start=1):
        if not line.strip():
            close()
            continue
        bare = line.lstrip("#%!/ \t") if line.lstrip().startswith(("#", "%", "!", "//")) else line
        cells = cells_of(bare, separator)
        size = len(cells)
        while len(cells) > 1 and cells[-1] == "":
            cells.pop()
        values = [number_in(c) for c in cells]
        kept = [float("nan") if v is None else v for v in values]
        numbers = sum(v is not None and c != "" for v, c in zip(values, cells, strict=True))
        if (
            bare is line
            and numbers
            and (
                all(v is not None for v in values)
                or (header and len(cells) == len(header) and numbers >= 1 + (not rows))
            )
        ):
            if not rows:
                first, wide = number, size
                worded = {k for k, v in enumerate(values) if v is None}
            elif any(k in worded and v is not None and np.isfinite(v) for k, v in enumerate(values)):
                raise InputError(f"'{name}', line {first}, holds words where numbers are needed; correct it.")
            if not header and size != wide:
                raise InputError(f"'{name}', line {number}: {size} cells, and {wide} in the rows before it.")
            if rows and any(v is None and k < len(rows[0]) and np.isfinite(rows[0][k]) for k, v in enumerate(values)):
                raise InputError(f"'{name}', line {number}, holds words where numbers are needed; correct it.")
            rows.append(kept)
            total += len(kept)
            if total > MOST_CELLS:
                raise InputError(f"'{name}' has more than {MOST_CELLS} cells, the most that are read.")
            continue
        close()
        words = [c for c, v in zip(cells, values, strict=True) if v is None]
        if header and len(cells) == len(header) and all(_UNIT.fullmatch(c) or not c for c in cells):
            header = tuple(f"{name} {unit}" for name, unit in zip(header, cells, strict=True))
        elif len(cells) > 1 and len(words) >= 0.5 * len(cells):
            header = tuple(cells)
        else:
            caption = " ".join(cells)
    close()
    return found
