"""Split text exports of profilers into blocks of numbers with their headers, and read those of LMI Gocator."""

import re
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from weldcal.calibration.profiler.motion import Floats
from weldcal.models.errors import InputError
from weldcal.models.files import MOST_CELLS
from weldcal.models.text_tables import cells_of, lines_of, separator_of

_UNIT = re.compile(r"[\[(].{0,6}[\])]|mm|µm|um|m")
_NOTHING = ("", "-", "--", "---", "invalid", "none", "null", "n/a", "na", "fffffff", "-fffffff")

SECTIONS = ("RawProfile", "Profile", "Surface", "Part", "SurfaceSection")
"""Sections that hold profiles, in the order in which they are used."""
_START = re.compile(r"\A\ufeff?\s*Info\b[ ,]*\r?\n", re.IGNORECASE)


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


def number_in(cell: str) -> float | None:
    """Return the number in a cell: NaN where it says that nothing was measured, None where it holds words."""
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return float("nan") if cell.lower() in _NOTHING else None


def blocks_of(text: str, name: str) -> list[NumberRows]:
    """Return the blocks of a text: a blank line, a line of words or another header ends one.

    Raises:
        InputError: rows of a block have different lengths, or the file has more cells than are read.
    """
    lines = list(lines_of(text))
    separator = separator_of([line for _, line in lines])
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

    before = 0
    for number, line in lines:
        if number > before + 1:
            close()
        before = number
        bare = line.lstrip("#%!/ \t") if line.lstrip().startswith(("#", "%", "!", "//")) else line
        glued = re.sub(r"\s+([\[(])", r"\1", bare) if separator == " " else bare
        cells = [c.strip("\"'") for c in cells_of(glued, separator)]
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


@dataclass(frozen=True, eq=False)
class GocatorProfiles:
    """Profiles of one section: points [x, z] (m, 2) mm each, NaN where nothing was measured.

    Names of the columns before the points.
    """

    section: str
    points: tuple[Floats, ...]
    ids: tuple[str, ...]
    times: Floats | None
    columns: tuple[str, ...]


def is_gocator(text: str) -> bool:
    """Return whether a text begins as the export of a Gocator does."""
    return _START.match(text[:200]) is not None


def gocator_profiles(text: str, name: str) -> GocatorProfiles:
    """Return the profiles of an export.

    Raises:
        InputError: no section with profiles, or one that is damaged; the sentence names the sections.
    """
    sections = _sections(text, name)
    known = {re.sub(r"\s", "", key).lower(): key for key in sections}
    for section in SECTIONS:
        key = known.get(section.lower())
        if key is not None:
            rows = sections[key]
            return _frames(rows, key, name) if "profile" in section.lower() else _surface(rows, key, name)
    raise InputError(
        f"'{name}' is a Gocator export with the sections {', '.join(list(sections)[:10])}, none of"
        f" {', '.join(SECTIONS)}. Record in the mode Profile, and export the profiles as CSV."
    )


def _sections(text: str, name: str) -> dict[str, list[list[str]]]:
    found: dict[str, list[list[str]]] = {}
    rows: list[list[str]] | None = None
    cells = 0
    for _, line in lines_of(text):
        row = cells_of(line, ",")
        if not any(row):
            continue
        if rows is None:
            rows = found.setdefault(row[0], [])
        elif row[0].lower() == "end" and not any(row[1:]):
            rows = None
        else:
            rows.append(row)
            cells += len(row)
            if cells > MOST_CELLS:
                raise InputError(f"'{name}' has more than {MOST_CELLS} cells, the most that are read.")
    return found


def _short(row: list[str]) -> list[str]:
    """Return the row without empty cells at its end."""
    return row[: max((k + 1 for k, c in enumerate(row) if c), default=0)]


def _data(rows: list[list[str]], first: str) -> tuple[list[str], list[list[str]]]:
    """Return the header that begins with a word, and the rows below it."""
    for k, row in enumerate(rows):
        if row[0].lower() == first and "axis" in (c.lower() for c in row):
            return _short(row), rows[k + 1 :]
    return [], []


def _frames(rows: list[list[str]], section: str, name: str) -> GocatorProfiles:
    header, data = _data(rows, "frame")
    lower = [h.lower() for h in header]
    if not header or not data:
        raise InputError(
            f"The section {section} of '{name}' has no table with the columns Frame and Axis; export it again."
        )
    axis = lower.index("axis")
    last = len(header) - axis - 1
    count = _column_count(rows)
    if section.lower() == "profile" and count not in (None, last):
        raise InputError(
            f"The section {section} of '{name}' states {count} columns and names {last}: a decimal comma in its header,"
            " or a lost column. Export it again with decimal points."
        )
    even = len({len(row) for row in data}) == 1  # rows that all end with a comma
    place = {word: lower.index(word) for word in ("source", "time") if word in lower}
    frames: dict[str, dict[str, list[str]]] = {}
    order: list[str] = []
    for row in data:
        size = len(row)
        row = _short(row)
        if len(row) <= axis:
            raise InputError(
                f"A row of the section {section} of '{name}' ends before its column Axis: the file is cut off there."
            )
        if len(row) > len(header) or (size > len(header) and not even):
            raise InputError(
                f"A row of the section {section} of '{name}' has {size} cells, and its header {len(header)}; export it"
                " again."
            )
        frame = row[0]
        if frame not in frames:
            frames[frame] = {}
            order.append(frame)
        mark = row[axis].upper()[:1]
        if mark in frames[frame]:
            sources = sorted({r[place["source"]] for r in data if len(r) > axis}) if "source" in place else []
            if len(sources) > 1:
                raise InputError(
                    f"'{name}' holds the profiles of the sources {', '.join(sources[:6])}; export one of them."
                )
            raise InputError(f"Frame {frame[:20]} of '{name}' has two rows {mark}; keep one.")
        frames[frame][mark] = row
    shared = np.array([_number(c, name) for c in header[axis + 1 :]]) if section.lower() == "profile" else None
    points, times = [], []
    for frame in order:
        rows_of = frames[frame]
        z = rows_of.get("Z")
        x = rows_of.get("X")
        if z is None or (x is None and shared is None):
            raise InputError(
                f"Frame {frame[:20]} of '{name}' has the rows {', '.join(rows_of)}; a profile needs"
                f" {'X and Z' if shared is None else 'Z'}."
            )
        at = _values(x, axis, last, name) if x is not None else np.zeros(last) if shared is None else shared
        points.append(np.column_stack([at, _values(z, axis, last, name)]))
        times.append(_number(z[place["time"]], name) if "time" in place else np.nan)
    t = np.array(times)
    return GocatorProfiles(
        section, tuple(points), tuple(order), t if np.isfinite(t).all() else None, tuple(header[: axis + 1])
    )


def _column_count(rows: list[list[str]]) -> int | None:
    """Return the number of columns that a section states."""
    for head, values in pairwise(rows):
        stated = dict(zip((c.lower() for c in head), values, strict=False)).get("column count")
        if stated is not None:
            return int(stated) if stated.isdecimal() else None
    return None


def _surface(rows: list[list[str]], section: str, name: str) -> GocatorProfiles:
    """Return a surface of one frame: x in the first row, y in the first column, heights within."""
    rows = [_short(row) for row in rows]
    widest = max((len(r) for r in rows), default=0)
    begin = next((k for k, r in enumerate(rows) if len(r) == widest and k > 1 and number_in(r[-1]) is not None), None)
    if begin is None or widest < 6 or len(rows) < begin + 2:
        raise InputError(f"The section {section} of '{name}' has no table of heights; export it again.")
    x = np.array([_number(c, name) for c in rows[begin][1:]])
    points = []
    for row in rows[begin + 1 :]:
        z = _values(row, 0, len(x), name)
        points.append(np.column_stack([x, z]))
    ids = tuple(row[0] for row in rows[begin + 1 :])
    return GocatorProfiles(section, tuple(points), ids, None, tuple(rows[0][:9]))


def _values(row: list[str], axis: int, count: int, name: str) -> Floats:
    out = np.full(count, np.nan)
    cells = row[axis + 1 : axis + 1 + count]
    out[: len(cells)] = [_number(c, name) for c in cells]
    return out


def _number(cell: str, name: str) -> float:
    value = number_in(cell)
    if value is None:
        raise InputError(f"'{name}' has a cell that is not a number: '{cell[:20]}'.")
    return value
