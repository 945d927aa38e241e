"""Split the lines of text tables into cells: comments, blank lines, separators, decimal commas and quotes."""

import csv
import re
from collections.abc import Iterator, Sequence

_LINE = re.compile(r"([^\r\n]*)(?:\r\n|\r|\n|\Z)")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?")
_SAMPLE = 200  # lines that decide the separator
LONGEST_CELL = 131_072
"""Characters of a cell, a bound."""


def lines_of(text: str, comments: tuple[str, ...] = ()) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each line that is neither blank nor begins with one of ``comments``."""
    for number, match in enumerate(_LINE.finditer(text), start=1):
        line = match[1].strip("\ufeff") if number == 1 else match[1]
        if (bare := line.lstrip()) and not bare.startswith(comments or "\n"):
            yield number, line


def separator_of(lines: Sequence[str]) -> str:
    """Return the mark between the cells of most lines with numbers: semicolon, tab, blank (any number) or comma.

    A comma inside of a cell is a decimal comma, else commas separate the cells.
    """
    for mark in (";", "\t"):  # a first line without commas has no decimal ones either: a header, or whole numbers
        if lines and mark in lines[0].strip() and "," not in lines[0]:
            return mark
    sample = [s for s in lines[:_SAMPLE] if re.search(r"\d", s)] or list(lines[:_SAMPLE])
    for mark in (";", "\t", " "):
        if sample and 2 * sum(_separates(mark, s.strip()) for s in sample) >= len(sample):
            return mark
    return "," if any("," in s for s in sample) else " "


def _separates(mark: str, line: str) -> bool:
    return mark in line and all("," not in c or _DECIMAL_COMMA.fullmatch(c.strip()) for c in line.split(mark))


def cells_of(line: str, separator: str) -> list[str]:
    """Return the stripped cells of a line, with decimal points.

    Blanks separate the numbers of a line without the separator. A quote without an end stays in its cell.
    """
    if separator not in line and all(map(_NUMBER.fullmatch, line.split())):
        separator = " "
    cells = line.split(None if separator == " " else separator)
    if '"' in line:
        try:
            plain = " ".join(cells) if separator == " " else line.strip()
            cells = next(csv.reader([plain], delimiter=separator, skipinitialspace=True, strict=True))
        except csv.Error:
            pass
    cells = [c.strip() for c in cells]
    return cells if separator == "," else [c.replace(",", ".") if is_decimal_comma(c) else c for c in cells]


def is_decimal_comma(cell: str) -> bool:
    """Return whether a cell is one number with a decimal comma."""
    return "," in cell and _DECIMAL_COMMA.fullmatch(cell) is not None
