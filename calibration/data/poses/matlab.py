"""Read the arrays, cells and structs of MATLAB files of version 5 to 7, bounded in time and memory whatever the bytes are.

Source: MATLAB, "MAT-File Format". SciPy's reader ends the process on some damaged files.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from weldcal.calibration.errors import DatasetError
from weldcal.models.files import DEEPEST, MOST_NODES, expansion_limit

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _NUMERIC = 1, 2, range(6, 16)  # classes of arrays
_HEADER = 128


def matlab_arrays(content: bytes, name: str) -> dict[str, Any]:
    """The variables of a file: arrays without axes of length 1, cells as lists, structs as mappings; texts and objects are left out.

    Raises:
        DatasetError: another version, or a damaged file; the sentence says what to change.
    """
    if content.startswith((b"\x89HDF", b"MATLAB 7.3")):
        raise DatasetError(f"'{name}' is a MATLAB 7.3 file: save it with save('{name}', '-v7').")
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise DatasetError(f"'{name}' is no MATLAB file of version 5 to 7: save it with save('{name}', '-v7').")
    found: dict[str, Any] = {}
    try:
        for kind, body in _elements(content[_HEADER:], order):
            if kind == _COMPRESSED:
                limit = expansion_limit(len(content))
                inflate = zlib.decompressobj()
                plain = inflate.decompress(body, limit)
                if not inflate.eof:
                    raise ValueError("compressed data without an end")
                kind, body = next(_elements(plain, order))
            if kind == _MATRIX:
                key, value = _array(body, order, 0)
                if key and value is not None:
                    found[key] = value
    except (ValueError, KeyError, StopIteration, struct.error, zlib.error) as problem:
        raise DatasetError(
            f"'{name}' cannot be read as a MATLAB file: it is damaged or cut off. Save it again."
        ) from problem
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """The type and the bytes of each element. Raises ValueError where one ends beyond the data."""
    at = 0
    while at + 8 <= len(data):
        first, size = struct.unpack_from(f"{order}2I", data, at)
        begin = at + 8
        if first >> 16:  # up to four bytes in the tag itself
            first, size, begin = first & 0xFFFF, first >> 16, at + 4
        if begin + size > len(data) or (begin == at + 4 and size > 4):
            raise ValueError("an element ends beyond the data")
        yield first, data[begin : begin + size]
        at = at + 8 if begin == at + 4 else begin + size + (0 if first == _COMPRESSED else -size % 8)


def _array(data: bytes, order: str, level: int) -> tuple[str, Any]:
    """The name and the value of an array; None for a text or an object."""
    if level > DEEPEST:
        raise ValueError("too many levels")
    parts = _elements(data, order)
    flags = _numbers(*next(parts), order)
    shape = [int(v) for v in _numbers(*next(parts), order)]
    name = next(parts)[1].decode("latin-1")
    kind, count = int(flags[0]) & 0xFF, math.prod(shape)
    if any(v < 0 for v in shape):
        raise ValueError("a negative length")
    if kind in _NUMERIC:
        values = _numbers(*next(parts), order) if count else np.zeros(0)
        if len(values) != count:
            raise ValueError("another number of values than the shape says")
        return name, np.squeeze(values.reshape(shape, order="F"))
    if kind not in (_CELL, _STRUCT):
        return name, None
    names = [""]
    if kind == _STRUCT:
        length = int(_numbers(*next(parts), order)[0])
        listed = next(parts)[1].decode("latin-1")
        if length < 1:
            raise ValueError("names without letters")
        names = [listed[k : k + length].split("\0")[0] for k in range(0, len(listed), length)]
    if count * len(names) > MOST_NODES:
        raise ValueError("too many values")
    values_of = [_array(next(parts)[1], order, level + 1)[1] for _ in range(count * len(names))]
    if kind == _CELL:
        return name, [v.tolist() if isinstance(v, np.ndarray) else v for v in values_of]
    rows = [dict(zip(names, values_of[k : k + len(names)], strict=True)) for k in range(0, len(values_of), len(names))]
    return name, rows[0] if count == 1 else rows


def _numbers(kind: int, body: bytes, order: str) -> np.ndarray[Any, Any]:
    return np.frombuffer(body, np.dtype(_NUMBERS[kind]).newbyteorder(order)).astype(_NUMBERS[kind])
