"""Read YAML, JSON and XML as a tree, with the matrices of OpenCV FileStorage as arrays."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array
from weldcal.models.documents import as_number, parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import DEEPEST, LARGEST_DOCUMENT, MOST_NODES, read_text


def read_tree(path: Path) -> Any:
    """The contents of a YAML, JSON or XML file; matrices of OpenCV FileStorage become arrays. Raises DatasetError."""
    try:
        text = read_text(path, LARGEST_DOCUMENT)
        if path.suffix.lower() == ".xml":
            return _matrices(_from_xml(path, text))
        text = re.sub(r"\A%YAML[:\s]\S*\s*?\n", "", text)  # FileStorage writes a directive that YAML does not know
        return _matrices(parse_document(path.name, text, "JSON" if path.suffix.lower() == ".json" else "YAML"))
    except DatasetError:
        raise
    except InputError as e:
        raise DatasetError(str(e)) from e


def _array(value: Any) -> Array | None:
    """Nested lists of numbers as an array; None where they are none."""
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return None


def _matrices(tree: Any) -> Any:
    """The tree with each FileStorage matrix ({rows, cols, data}) as an array."""
    if isinstance(tree, list):
        return [_matrices(v) for v in tree]
    if not isinstance(tree, Mapping):
        return tree
    if {"rows", "cols", "data"} <= set(tree):
        rows, cols = as_number(tree["rows"]), as_number(tree["cols"])
        data = _array(tree["data"])
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
