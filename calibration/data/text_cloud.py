"""Reads points from text: x, y, z in columns of any usual separator; decimal commas only where they cannot be mistaken."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from weldcal.calibration.data.cloud_body import CloudError, cloud_stream
from weldcal.models.arrays import Array
from weldcal.models.files import decoded, read_text
from weldcal.models.limits import LARGEST_TEXT

_ROWS = 50_000  # converted at a time
_LINE = re.compile(r"[^\r\n]+")
_COMMA_DECIMAL = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_WHOLE = re.compile(r"[+-]?\d+")
_LONGEST_NUMBER = 100  # characters


def read_text_cloud(path: Path) -> Array:
    """Points (N, 3): the columns that the header names x, y and z, else the first three; # and // begin comments.

    A first line with one whole number is the number of points, as in .pts files. All rows have as many cells. Decimal commas are
    read where semicolons, tabs or blanks separate the cells.

    Raises:
        CloudError: anything else, with the line's number. InputError: the file cannot be opened, or is not UTF-8.
    """
    rows = _rows(_text(path))
    first = next(rows, None)
    promised = None
    if first is not None and _WHOLE.fullmatch(first[1]) and len(first[1]) < 16:
        promised, first = int(first[1]), next(rows, None)
    if first is None:
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    line, row = first
    separator = _separator(row)
    header = [c.strip().lower() for c in _cells(row, separator)]
    columns, width = [0, 1, 2], len(header)
    pending: list[tuple[int, str]] = []
    headed = _number(header[0], separator) is None
    if headed:
        if {"x", "y", "z"} <= set(header):
            columns = [header.index(c) for c in "xyz"]
        if any(header.count(c) > 1 for c in "xyz"):
            raise CloudError(f"The header of {path.name} names x, y or z twice; keep one.")
        below = next(rows, None)
        if below is None:
            raise CloudError(f"The cloud {path.name} is empty; scan again.")
        pending.append(below)
        if _separator(below[1]) != separator:  # a header of its own kind, such as "x y z" over "1,2,3"
            separator = _separator(below[1])
            width = len(_cells(below[1], separator))
    else:
        pending.append(first)
    if width < 3:
        raise CloudError(f"The file {path.name} has a row of fewer than three numbers; x, y and z are needed.")
    blocks: list[Array] = []
    block: list[list[float]] = []
    # a header that names as many columns as a row has cells says that commas separate them
    whole = separator == "," and not (headed and len(header) == width)
    for line, row in _chain(pending, rows):
        cells = _cells(row, separator)
        if len(cells) != width:
            raise CloudError(_surplus(path, line, len(cells), width))
        whole = whole and _could_be_decimals(cells)
        numbers = [_number(cells[c], separator) for c in columns]
        if None in numbers:
            bad = next(cells[c] for c, v in zip(columns, numbers, strict=True) if v is None)
            raise CloudError(f"The file {path.name}, line {line}: '{bad[:40]}' is not a number.")
        block.append([v for v in numbers if v is not None])
        if len(block) == _ROWS:
            blocks.append(np.array(block))
            block = []
    if whole:
        raise CloudError(
            f"The commas of {path.name} could be separators or decimal commas; write decimal points, or semicolons between the cells."
        )
    points = np.concatenate([*blocks, np.array(block, dtype=float).reshape(-1, 3)])
    if promised is not None and promised != len(points):
        raise CloudError(
            f"The first line of {path.name} promises {promised} points, and {len(points)} are there; export it again."
        )
    return points


def _text(path: Path) -> str:
    if path.suffix.lower() != ".gz":
        return read_text(path, LARGEST_TEXT)
    with cloud_stream(path) as (stream, _):
        return decoded(path, stream.read())


def _rows(text: str) -> Iterator[tuple[int, str]]:
    """Lines with a value, numbered from 1, without comments."""
    number, at = 1, 0
    for match in _LINE.finditer(text):
        number += len(re.findall(r"\r\n|\r|\n", text[at : match.start()]))
        at = match.start()
        row = match.group().strip().rstrip(",;").strip()
        if row and not row.startswith(("#", "//")):
            yield number, row


def _chain(first: list[tuple[int, str]], rest: Iterator[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    yield from first
    yield from rest


def _separator(row: str) -> str:
    """What separates the cells of a row; a blank for any number of blanks, tabs included."""
    if ";" in row:
        return ";"
    if "\t" in row and len(row.split("\t")) > 2:
        return "\t"
    words = row.split()
    if len(words) > 2 and not any(w.startswith(",") or w.endswith(",") for w in words):
        return " "
    return "," if "," in row else " "


def _cells(row: str, separator: str) -> list[str]:
    return row.split() if separator == " " else [cell.strip() for cell in row.split(separator)]


def _number(cell: str, separator: str) -> float | None:
    if "," in cell and separator != "," and _COMMA_DECIMAL.fullmatch(cell):
        cell = cell.replace(",", ".")
    if len(cell) > _LONGEST_NUMBER or "_" in cell:
        return None
    try:
        return float(cell)
    except ValueError:
        return None


def _could_be_decimals(cells: list[str]) -> bool:
    """Whether each two whole numbers of a row could be one with a decimal comma: no sign behind the comma."""
    return (
        len(cells) >= 6
        and len(cells) % 2 == 0
        and all(_WHOLE.fullmatch(c) for c in cells)
        and not any(c.startswith(("+", "-")) for c in cells[1::2])
    )


def _surplus(path: Path, line: int, n: int, width: int) -> str:
    return (
        f"The file {path.name}, line {line}, has {n} cells and the first row {width}: give each row the same, and decimal commas only "
        "with semicolons or tabs between the cells."
    )
