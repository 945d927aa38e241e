"""Read the points of a PLY file after its header has been checked against the length of its body."""

import re
import struct
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.cloud_files.body import (
    CloudError,
    check_points,
    cloud_stream,
    column_values,
    converted,
    sensor_width,
    text_columns,
    text_lines,
)
from weldcal.models.arrays import Array

_LETTERS = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
_CELLS = re.compile(rb"\x00{1,65536}|(?:\x01.{4}){1,4096}", re.DOTALL)  # of a range_grid with a byte and a 4-byte index

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8",
    "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_COUNTS = [name for name, kind in _TYPES.items() if kind[0] != "f"]
_LONGEST_HEADER = 65536
_GRID = "range_grid"
_SIDES = ("num_cols", "num_rows")


@dataclass
class Element:
    """An element of the header: its count, and (name, type, type of a list's count or "") of each property."""

    name: str
    count: int
    properties: list[tuple[str, str, str]]

    @property
    def size(self) -> int | None:
        """Bytes of one record; None where it holds a list."""
        return None if any(n for _, _, n in self.properties) else self.least

    @property
    def least(self) -> int:
        """Least bytes of one record: a list may be empty, but its count is there."""
        return sum(int((n or t)[1]) for _, t, n in self.properties)


def layout(path: Path, order: str, e: Element, content: bytes) -> tuple[int, list[int]] | None:
    """Bytes of a record and the place of each property in it, where all records are alike; None where they are not."""
    if e.count == 0:
        return 0, [0] * len(e.properties)
    offsets, at = [], 0
    counted: list[tuple[int, str, int]] = []
    for _, kind, counter in e.properties:
        offsets.append(at)
        if not counter:
            at += int(kind[1])
            continue
        if at + int(counter[1]) > len(content):
            return None
        number = int(np.frombuffer(content, order + counter, 1, at)[0])
        _check_entries(path, e, number)
        counted.append((at, counter, number))
        at += int(counter[1]) + number * int(kind[1])
    if counted and (at * e.count > len(content) or at == 0):
        return None
    for place, counter, number in counted:
        if not (np.ndarray(e.count, order + counter, content, place, strides=(at,)) == number).all():
            return None
    return at, offsets


def walked(path: Path, order: str, e: Element, content: bytes) -> tuple[NDArray[np.int64], int]:
    """Return the places (n, properties), in bytes, of each property of each record, and the bytes of all records.

    The records follow one after the other.
    """
    places = np.empty((e.count, len(e.properties)), dtype=np.int64)
    formats = [(int(t[1]), int(n[1]) if n else 0, _LETTERS[n] if n else "") for _, t, n in e.properties]
    at = 0
    for row in places:
        for k, (size, counter_size, letter) in enumerate(formats):
            row[k] = at
            if not letter:
                at += size
                continue
            if at + counter_size > len(content):
                raise CloudError(f"The file {path.name} is truncated: its element {e.name} is not whole.")
            number = struct.unpack_from((order or "<") + letter, content, at)[0]
            _check_entries(path, e, int(number))
            at += counter_size + int(number) * size
    if at > len(content):
        raise CloudError(f"The file {path.name} is truncated: its element {e.name} is not whole.")
    return places, at


def cells(path: Path, order: str, e: Element, content: bytes) -> tuple[NDArray[np.int64], int]:
    """Return the index of the point of each cell of a range_grid, -1 for an empty cell, and the bytes of all cells."""
    damaged = CloudError(f"The file {path.name} is damaged: a cell of its range_grid holds more than one point.")
    if len(e.properties) != 1 or e.properties[0][1][0] == "f":
        raise damaged
    _, kind, counter = e.properties[0]
    out = np.full(e.count, -1, dtype=np.int64)
    if counter == "u1" and kind in ("i4", "u4"):
        found = at = 0
        while found < e.count:
            run = _CELLS.match(content, at)
            if run is None:
                raise damaged
            number = min(len(run[0]) if run[0][0] == 0 else len(run[0]) // 5, e.count - found)
            if run[0][0] == 1:
                out[found : found + number] = np.ndarray(number, order + kind, run[0], 1, strides=(5,))
            at += number if run[0][0] == 0 else 5 * number
            found += number
        return out, at
    places, used = walked(path, order, e, content)
    ends = np.append(places[1:, 0], used)
    filled = ends - places[:, 0] > int(counter[1])
    if (ends - places[:, 0] > int(counter[1]) + int(kind[1])).any():
        raise damaged
    for k in np.flatnonzero(filled):
        out[k] = np.frombuffer(content, order + kind, 1, int(places[k, 0]) + int(counter[1]))[0]
    return out, used


def text_cells(path: Path, e: Element, words: list[bytes], columns: list[int]) -> list[bytes]:
    """Return the words of some properties of a record in text."""
    places, at = [], 0
    for _, _, counter in e.properties:
        places.append(at)
        count = words[at] if at < len(words) else b""
        if counter and not (count.isdigit() and len(count) < 10):
            raise CloudError(
                f"The file {path.name} is damaged: '{count.decode('latin-1')[:40]}' is no count of a list of its"
                " points."
            )
        at += 1 + int(count) if counter else 1
    if at != len(words):
        raise CloudError(
            f"The file {path.name} is damaged: a point has {len(words)} numbers instead of the {at} of its header and"
            " lists."
        )
    return [words[places[c]] for c in columns]


def _check_entries(path: Path, e: Element, entries: int) -> None:
    """A face of fewer than three corners is what remains of points that were counted wrongly."""
    if entries < (3 if e.name == "face" else 0):
        raise CloudError(f"The file {path.name} is damaged: a list of its element {e.name} has {entries} entries.")


@dataclass(frozen=True, kw_only=True)
class _Header:
    """What the header says.

    Attributes:
        order: byte order of a binary body, empty for text.
        elements: the elements in the order of the file.
        begin: where the body begins, bytes.
        sides: columns and rows that obj_info states; 0 where it does not.
    """

    order: str
    elements: list[Element]
    begin: int
    sides: tuple[int, int]

    @property
    def at(self) -> int:
        """Which element holds the points."""
        return next(k for k, e in enumerate(self.elements) if e.name == "vertex")


def read_ply(path: Path) -> Array:
    """Points of the vertices in the file's unit; coordinates of any type.

    Organised are files with an element range_grid (a cell holds the index of its point, or nothing), and those whose
    `obj_info num_cols` and `num_rows` are as many cells as there are points.

    Returns:
        (N, 3), or (H, W, 3) with NaN in the empty cells of a range_grid.

    Raises:
        CloudError: no PLY, a header that contradicts itself or the body's length, coordinates that are missing.
        InputError: the file cannot be opened.
    """
    with cloud_stream(path) as (stream, size):
        h = _header(path, stream.read(min(size, _LONGEST_HEADER)))
        vertex = h.elements[h.at]
        check_points(path, vertex.count, size)
        names = [name for name, _, _ in vertex.properties]
        missing = [c for c in "xyz" if c not in names or vertex.properties[names.index(c)][2]]
        if missing:
            raise CloudError(f"The file {path.name} has no coordinate {missing[0]}; export x, y and z.")
        stream.seek(h.begin)
        columns = [names.index(c) for c in "xyz"]
        points, of_cells = (_text if h.order == "" else _binary)(path, h, columns, stream, size - h.begin)
    if of_cells is not None:
        check_points(path, len(of_cells), size)
        return _placed(path, points, of_cells, h.sides)
    cols, rows = h.sides
    if min(cols, rows) > 1 and cols * rows == len(points):
        # some programs exchange rows and columns: neighbours tell which is which
        sums = points.sum(axis=1)
        width = sensor_width(points, np.isfinite(sums) & (sums != 0.0), tuple({cols, rows}))
        return points if width is None else points.reshape(-1, width, 3)
    return points


def _header(path: Path, begin: bytes) -> _Header:
    if not begin.strip():
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    if begin.split(None, 1)[0] != b"ply":
        raise CloudError(f"The file {path.name} is not a PLY file: it does not begin with 'ply'.")
    order: str | None = None
    elements: list[Element] = []
    sides = dict.fromkeys(_SIDES, 0)
    at = 0
    while True:
        end = begin.find(b"\n", at)
        if end < 0:
            raise CloudError(f"The file {path.name} is not a PLY file: its header has no end.")
        words, at = begin[at:end].decode("latin-1").split(), end + 1
        if words[:1] == ["obj_info"] and len(words) == 3 and words[1] in sides:
            sides[words[1]] = int(words[2]) if words[2].isdecimal() and len(words[2]) < 16 else 0
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        if words == ["end_header"]:
            break
        if words[0] == "format" and len(words) == 3 and words[1] in _FORMATS and order is None:
            order = _FORMATS[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 16:
            elements.append(Element(words[1], int(words[2]), []))
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in _TYPES:
            elements[-1].properties.append((words[2], _TYPES[words[1]], ""))
        elif (
            words[:2] == ["property", "list"]
            and elements
            and len(words) == 5
            and words[2] in _COUNTS
            and words[3] in _TYPES
        ):
            elements[-1].properties.append((words[4], _TYPES[words[3]], _TYPES[words[2]]))
        else:
            raise CloudError(f"The file {path.name} is damaged: '{' '.join(words)[:60]}' is no line of a PLY header.")
    if order is None:
        raise CloudError(f"The file {path.name} is not a PLY file: its header has no format line.")
    _check_elements(path, elements)
    return _Header(order=order, elements=elements, begin=at, sides=(sides["num_cols"], sides["num_rows"]))


def _check_elements(path: Path, elements: list[Element]) -> None:
    """Refuses a header without vertices, or with anything twice, or with lists before the vertices."""
    places = [k for k, e in enumerate(elements) if e.name == "vertex"]
    if not places:
        raise CloudError(f"The file {path.name} is not a PLY file: its header has no vertex element.")
    names = [name for name, _, _ in elements[places[0]].properties]
    if len(places) > 1 or len(set(names)) < len(names):
        raise CloudError(f"The file {path.name} is damaged: its header has the same element or property twice.")
    if any(e.size is None and e.count for e in elements[: places[0]]):
        raise CloudError(f"The file {path.name} has lists before its points; export the points only.")


def _text(
    path: Path, h: _Header, columns: list[int], stream: BinaryIO, there: int
) -> tuple[Array, NDArray[np.int64] | None]:
    """Return the points of a text body, and the point of each cell of its range_grid."""
    before, vertex = sum(e.count for e in h.elements[: h.at]), h.elements[h.at]
    lines = sum(e.count for e in h.elements)
    if vertex.size is not None:
        points = text_columns(path, stream, columns, len(vertex.properties), before, vertex.count, lines)
    else:
        # the lists of a point are cut out of its line; where lines are missing, the reader without lists says so
        text_columns(path, stream, [], None, before, vertex.count, lines)
        stream.seek(h.begin)
        rows = islice(text_lines(path, stream), before, before + vertex.count)
        points = converted(path, [text_cells(path, vertex, row.split(), columns) for row in rows])
    grid = next((k for k, e in enumerate(h.elements) if e.name == _GRID and k > h.at), None)
    if grid is None:
        return points, None
    stream.seek(h.begin)
    first = sum(e.count for e in h.elements[:grid])
    out = []
    for line in islice(text_lines(path, stream), first, first + h.elements[grid].count):
        words = line.split()
        if words != [b"0"] and not (len(words) == 2 and words[0] == b"1" and words[1].isdigit() and len(words[1]) < 16):
            raise CloudError(f"The file {path.name} is damaged: a cell of its range_grid holds more than one point.")
        out.append(-1 if len(words) == 1 else int(words[1]))
    return points, np.array(out, dtype=np.int64)


def _binary(
    path: Path, h: _Header, columns: list[int], stream: BinaryIO, there: int
) -> tuple[Array, NDArray[np.int64] | None]:
    """The points of a binary body, and the point of each cell of its range_grid; refuses a body of another length."""
    skip = sum((e.size or 0) * e.count for e in h.elements[: h.at])
    vertex, after = h.elements[h.at], h.elements[h.at + 1 :]
    least = there - skip - sum(e.least * e.count for e in after)
    points_there = max(there - skip, 0) // max(vertex.least, 1)
    if points_there < vertex.count:
        raise CloudError(
            f"The file {path.name} is truncated: its header promises {vertex.count} points and {points_there} are"
            " there."
        )
    if least < vertex.least * vertex.count:
        missing = vertex.least * vertex.count - least
        raise CloudError(f"The file {path.name} is truncated: {missing} bytes are missing at its end.")
    stream.seek(h.begin + skip)
    left = there - skip
    content = stream.read(left if vertex.size is None else vertex.size * vertex.count)
    points, used = _vertices(path, h.order, vertex, columns, content)
    stream.seek(h.begin + skip + used)
    left -= used
    of_cells = None
    for e in after:
        if e.size is not None:
            stream.seek(e.size * e.count, 1)
            left -= e.size * e.count
            continue
        rest = stream.read(left)
        if e.name == _GRID:
            of_cells, used = cells(path, h.order, e, rest)
        else:
            record = layout(path, h.order, e, rest)
            used = walked(path, h.order, e, rest)[1] if record is None else record[0] * e.count
        stream.seek(used - left, 1)
        left -= used
    if not 0 <= left <= 1:  # a last newline is no contradiction
        raise CloudError(
            f"The body of {path.name} does not end where its header with {vertex.count} points says; export it again."
        )
    return points, of_cells


def _vertices(path: Path, order: str, e: Element, columns: list[int], content: bytes) -> tuple[Array, int]:
    """Coordinates (n, 3) and the bytes of all vertices."""
    record = layout(path, order, e, content)
    kinds = [f"{order}{e.properties[k][1]}" for k in columns]
    if record is not None:
        size, offsets = record
        wanted = [(offsets[k], kind) for k, kind in zip(columns, kinds, strict=True)]
        return column_values(path, content, e.count, size, wanted), size * e.count
    places, used = walked(path, order, e, content)
    raw = np.frombuffer(content, np.uint8)
    out = np.empty((e.count, 3))
    for k, (column, kind) in enumerate(zip(columns, kinds, strict=True)):
        span = np.arange(np.dtype(kind).itemsize)
        if int(places[:, column].max()) + len(span) > len(raw):
            raise CloudError(f"The file {path.name} is truncated: its points are not whole.")
        out[:, k] = raw[places[:, column, None] + span].view(kind)[:, 0]
    return out, used


def _placed(path: Path, points: Array, of_cells: NDArray[np.int64], sides: tuple[int, int]) -> Array:
    """Return the points (H, W, 3) in the cells of a range_grid, NaN in empty ones.

    (N, 3) where no grid of two sides is stated.
    """
    some = of_cells[of_cells >= 0]
    if len(some) and int(some.max()) >= len(points):
        raise CloudError(f"The file {path.name} is damaged: its range_grid names point {int(some.max())}.")
    if len(np.unique(some)) < len(some):
        raise CloudError(f"The file {path.name} is damaged: its range_grid names a point twice.")
    cols, rows = sides
    if cols * rows not in (0, len(of_cells)):
        raise CloudError(
            f"The header of {path.name} contradicts itself: num_cols {cols} times num_rows {rows} is not the"
            f" {len(of_cells)} cells of its range_grid."
        )
    out = np.full((len(of_cells), 3), np.nan)
    out[of_cells >= 0] = points[some]
    return out.reshape(rows, cols, 3) if min(cols, rows) > 1 else out
