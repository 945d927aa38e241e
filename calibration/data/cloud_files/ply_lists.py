"""Walks the elements of a PLY file whose records hold lists: where each property lies, and the cells of a
range_grid."""

import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.cloud_files.body import CloudError

_LETTERS = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
_CELLS = re.compile(rb"\x00{1,65536}|(?:\x01.{4}){1,4096}", re.DOTALL)  # of a range_grid with a byte and a 4-byte index


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
    """Places (n, properties) of each property of each record, bytes, and the bytes of all records, one after the
    other."""
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
    """The index of the point of each cell of a range_grid, -1 for an empty cell, and the bytes of all cells."""
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
    """The words of some properties of a record in text."""
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
