"""Read YAML, JSON, XML and MATLAB files as a tree, with the matrices of OpenCV FileStorage as arrays.

MATLAB files of version 5 to 7 are read bounded in time and memory whatever their bytes are: SciPy's reader ends the
process on some damaged ones. Source: MATLAB, "MAT-File Format".
"""

import math
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array
from weldcal.models.documents import as_number, parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import DEEPEST, LARGEST_DOCUMENT, MOST_NODES, expansion_limit, read_text

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _NUMERIC = 1, 2, range(6, 16)  # classes of arrays
_HEADER = 128


def read_tree(path: Path) -> Any:
    """The contents of a YAML, JSON or XML file; matrices of OpenCV FileStorage become arrays. Raises DatasetError."""
    try:
        text = read_text(path, LARGEST_DOCUMENT)
        if path.suffix.lower() == ".xml":
            return _matrices(_from_xml(path, text))
        return tree_of_text(text, path.name, "JSON" if path.suffix.lower() == ".json" else "YAML")
    except DatasetError:
        raise
    except InputError as e:
        raise DatasetError(str(e)) from e


def tree_of_text(text: str, name: str, kind: str = "YAML") -> Any:
    """Return the contents of a text of YAML or JSON; several YAML documents, or a JSON object a line, are a list.

    Raises InputError.
    """
    text = text.lstrip("\ufeff")
    if kind == "JSON":
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) > 1 and all(line.lstrip().startswith("{") and line.rstrip().endswith("}") for line in lines):
            return [_matrices(parse_document(name, line, kind)) for line in lines[:MOST_NODES]]
        return _matrices(parse_document(name, text, kind))
    text = re.sub(r"\A%YAML[:\s]\S*\s*?\n", "", text)  # FileStorage writes a directive that YAML does not know
    documents = [one for one in re.split(r"(?m)^(?:---|\.\.\.)[ \t]*\r?$", text) if one.strip()]
    if len(documents) < 2:
        return _matrices(parse_document(name, next(iter(documents), text), kind))
    return [_matrices(parse_document(name, one, kind)) for one in documents]


def array_of(value: Any) -> Array | None:
    """Return nested lists of numbers as an array; None where they are none."""
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return None


def _matrices(tree: Any) -> Any:
    """Return the tree with each FileStorage matrix ({rows, cols, data}) as an array."""
    if isinstance(tree, list):
        return [_matrices(v) for v in tree]
    if not isinstance(tree, Mapping):
        return tree
    if {"rows", "cols", "data"} <= set(tree):
        rows, cols = as_number(tree["rows"]), as_number(tree["cols"])
        data = array_of(tree["data"])
        channels = re.match(r"\d+", str(tree.get("dt", "")))
        depth = int(channels[0]) if channels else 1
        if data is None or not (rows > 0 and cols > 0) or data.size != rows * cols * depth:
            raise DatasetError("A matrix of the file has another number of values than its rows and cols say.")
        return data.reshape((int(rows), int(cols)) if depth == 1 else (int(rows), int(cols), depth))
    return {key: _matrices(value) for key, value in tree.items()}


def _from_xml(path: Path, text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DatasetError(
            f"'{path.name}' declares a document type, which is not read; save it by OpenCV's FileStorage."
        )
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as e:
        raise DatasetError(f"'{path.name}' cannot be read as XML ({e}).") from e
    if sum(1 for _ in root.iter()) > MOST_NODES:
        raise DatasetError(f"'{path.name}' holds more than {MOST_NODES} values.")
    return _element(path, root, 0)


def _element(path: Path, element: ElementTree.Element, level: int) -> Any:
    if level > DEEPEST:
        raise DatasetError(f"'{path.name}' holds more than {DEEPEST} levels.")
    children = list(element)
    if not children:
        words = (element.text or "").split()
        numbers = [as_number(w) for w in words]
        if words and np.isfinite(numbers).all():
            return numbers if len(numbers) > 1 else numbers[0]
        return (element.text or "").strip()
    if all(child.tag == "_" for child in children):
        return [_element(path, child, level + 1) for child in children]
    return {child.tag: _element(path, child, level + 1) for child in children}


def matlab_arrays(content: bytes, name: str) -> dict[str, Any]:
    """Return the variables of a file: arrays without axes of length 1, cells as lists, structs as mappings.

    Texts and objects are left out.

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
                key, value = _variable(body, order, 0)
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


def _variable(data: bytes, order: str, level: int) -> tuple[str, Any]:
    """Return the name and the value of an array; None for a text or an object."""
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
    values_of = [_variable(next(parts)[1], order, level + 1)[1] for _ in range(count * len(names))]
    if kind == _CELL:
        return name, [v.tolist() if isinstance(v, np.ndarray) else v for v in values_of]
    rows = [dict(zip(names, values_of[k : k + len(names)], strict=True)) for k in range(0, len(values_of), len(names))]
    return name, rows[0] if count == 1 else rows


def _numbers(kind: int, body: bytes, order: str) -> np.ndarray[Any, Any]:
    return np.frombuffer(body, f"{order}{_NUMBERS[kind]}").astype(_NUMBERS[kind])
