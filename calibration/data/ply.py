"""Reads the points of a PLY file after its header has been checked against the length of its body."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from weldcal.calibration.data.cloud_body import CloudError, check_points, column_values, text_columns
from weldcal.models.arrays import Array
from weldcal.models.files import opened

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_LETTERS = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_COUNTS = [name for name, kind in _TYPES.items() if kind[0] != "f"]
_LONGEST_HEADER = 65536


@dataclass
class _Element:
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


def read_ply(path: Path) -> Array:
    """Points (N, 3) of the vertices, in the file's unit; coordinates of any type.

    Raises:
        CloudError: no PLY, a header that contradicts itself or the body's length, coordinates that are missing.
        InputError: the file cannot be opened.
    """
    with opened(path) as stream:
        size = stream.seek(0, 2)
        stream.seek(0)
        head = _header_lines(path, stream.read(min(size, _LONGEST_HEADER)))
        order, elements, begin = head
        before, vertex = _vertex(path, elements)
        check_points(path, vertex.count, size)
        names = [name for name, _, _ in vertex.properties]
        missing = [c for c in "xyz" if c not in names]
        if missing:
            raise CloudError(f"The file {path.name} has no coordinate {missing[0]}; export x, y and z.")
        stream.seek(begin)
        if order == "":
            rows = sum(e.count for e in before), vertex.count, sum(e.count for e in elements)
            return text_columns(path, stream, [names.index(c) for c in "xyz"], len(names), *rows)
        skip = _check_length(path, order, elements, stream, size - begin)
        stream.seek(begin + skip)
        assert vertex.size is not None
        content = stream.read(vertex.size * vertex.count)
        offsets = np.cumsum([0] + [int(t[1]) for _, t, _ in vertex.properties])
        columns = [(int(offsets[k]), f"{order}{vertex.properties[k][1]}") for k in (names.index(c) for c in "xyz")]
        return column_values(path, content, vertex.count, vertex.size, columns)


def _header_lines(path: Path, begin: bytes) -> tuple[str, list[_Element], int]:
    """Byte order ("" for text), the elements, and where the body begins."""
    if not begin.strip():
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    if begin.split(None, 1)[0] != b"ply":
        raise CloudError(f"The file {path.name} is not a PLY file: it does not begin with 'ply'.")
    order: str | None = None
    elements: list[_Element] = []
    at = 0
    while True:
        end = begin.find(b"\n", at)
        if end < 0:
            raise CloudError(f"The file {path.name} is not a PLY file: its header has no end.")
        words, at = begin[at:end].decode("latin-1").split(), end + 1
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        if words == ["end_header"]:
            break
        if words[0] == "format" and len(words) == 3 and words[1] in _FORMATS and order is None:
            order = _FORMATS[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 16:
            elements.append(_Element(words[1], int(words[2]), []))
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
    return order, elements, at


def _vertex(path: Path, elements: list[_Element]) -> tuple[list[_Element], _Element]:
    """The elements before the vertices, and these."""
    places = [k for k, e in enumerate(elements) if e.name == "vertex"]
    if not places:
        raise CloudError(f"The file {path.name} is not a PLY file: its header has no vertex element.")
    names = [name for name, _, _ in elements[places[0]].properties]
    if len(places) > 1 or len(set(names)) < len(names):
        raise CloudError(f"The file {path.name} is damaged: its header has the same element or property twice.")
    before, vertex = elements[: places[0]], elements[places[0]]
    if any(e.size is None and e.count for e in (*before, vertex)):
        raise CloudError(f"The file {path.name} has lists before the end of its points; export the points only.")
    return before, vertex


def _check_length(path: Path, order: str, elements: list[_Element], stream: BinaryIO, there: int) -> int:
    """Refuses a body that is shorter or longer than its header says; returns the bytes before the vertices."""
    k = next(k for k, e in enumerate(elements) if e.name == "vertex")
    skip, vertex = sum((e.size or 0) * e.count for e in elements[:k]), elements[k]
    record = vertex.size or 0
    points = max(there - skip, 0) // max(record, 1)
    if points < vertex.count:
        raise CloudError(
            f"The file {path.name} is truncated: its header promises {vertex.count} points and {points} are there."
        )
    missing = sum(e.least * e.count for e in elements) - there
    if missing > 0:
        raise CloudError(f"The file {path.name} is truncated: {missing} bytes are missing at its end.")
    left = there - skip - record * vertex.count
    stream.seek(skip + record * vertex.count, 1)
    for e in elements[k + 1 :]:
        used = e.count * e.size if e.size is not None else _walked(path, order, e, stream.read(left))
        stream.seek(used - left if e.size is None else used, 1)
        left -= used
    if not 0 <= left <= 1:  # a last newline is no contradiction
        raise CloudError(
            f"The body of {path.name} does not end where its header with {vertex.count} points says; export it again."
        )
    return skip


def _walked(path: Path, order: str, e: _Element, content: bytes) -> int:
    """Bytes of all records of an element with lists."""
    if len(e.properties) == 1:  # faces of as many corners each, which need no walk
        _, kind, counter = e.properties[0]
        if len(content) < int(counter[1]):
            raise CloudError(f"The file {path.name} is truncated: its element {e.name} is not whole.")
        first = np.frombuffer(content, order + counter, 1)
        _check_corners(path, e, int(first[0]))
        record = int(counter[1]) + int(kind[1]) * int(first[0])
        if first[0] > 0 and record * e.count <= len(content):
            counts = np.ndarray(e.count, order + counter, content, strides=(record,))
            if (counts == first[0]).all():
                return record * e.count
    at = 0
    formats = [(int(t[1]), int(n[1]) if n else 0, _LETTERS[n] if n else "") for _, t, n in e.properties]
    for _ in range(e.count):
        for size, counter_size, letter in formats:
            if not letter:
                at += size
                continue
            if at + counter_size > len(content):
                raise CloudError(f"The file {path.name} is truncated: its element {e.name} is not whole.")
            number = struct.unpack_from((order or "<") + letter, content, at)[0]
            _check_corners(path, e, int(number))
            at += counter_size + int(number) * size
    return at


def _check_corners(path: Path, e: _Element, corners: int) -> None:
    """A face of fewer than three corners is what remains of points that were counted wrongly."""
    if corners < (3 if e.name == "face" else 0):
        raise CloudError(f"The file {path.name} is damaged: a list of its element {e.name} has {corners} entries.")
