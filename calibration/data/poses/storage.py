"""Reads poses from YAML, JSON and XML: OpenCV FileStorage, Zivid's pose files, nested lists, and objects with position and rotation."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.columns import column_poses
from weldcal.calibration.data.poses.form import PoseList, matrices, poses_from_array
from weldcal.calibration.data.poses.names import natural
from weldcal.calibration.data.poses.rotations import rotations
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import pose
from weldcal.models.arrays import Array
from weldcal.models.documents import as_number, parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import DEEPEST, LARGEST_DOCUMENT, MOST_NODES, read_text

ENDINGS = (".yml", ".yaml", ".json", ".xml")
_PARTNERS = {"rotation": "translation", "rot": "trans", "rvecs": "tvecs", "rvec": "tvec", "r": "t"}
_ZIVID = ("PoseState", "FloatMatrix")


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


def is_storage(path: Path) -> bool:
    """Whether a file is OpenCV FileStorage (YAML with its directive, XML, or JSON with its matrices)."""
    try:
        text = read_text(path, LARGEST_DOCUMENT)
    except InputError:
        return False
    return text.startswith("%YAML:") or "opencv-matrix" in text[:20_000] or "<opencv_storage>" in text[:1000]


def read_storage(path: Path, form: PoseForm) -> PoseList:
    """The poses of such a file: one matrix, several nodes (in the natural order of their names), or a list of poses.

    Raises:
        DatasetError: it holds no poses, or some whose form is not said.
    """
    tree = read_tree(path)
    found = list(nodes(tree, form, path.name))
    if not found:
        raise DatasetError(
            f"'{path.name}' holds no pose that can be read: a 4 x 4 matrix, a rotation with a translation (R and t), or a list of them."
        )
    if len({len(X) for _, X, _ in found}) > 1 and any(len(X) > 1 for _, X, _ in found):
        longest = max(found, key=lambda f: len(f[1]))
        found = [longest]
    found = sorted(found, key=lambda f: natural(f[0])) if len(found) > 1 else found
    X = np.concatenate([X for _, X, _ in found])
    ids = tuple(name.split("/")[-1] for name, _, _ in found) if len(found) == len(X) > 1 else ()
    ids = () if len(set(ids)) < len(ids) or all(i.isdigit() for i in ids) else ids
    zivid = isinstance(tree, Mapping) and any(key in tree for key in _ZIVID)
    return PoseList(path.name, X, ids, None, "mm" if zivid else "", "Zivid poses (mm)" if zivid else found[0][2])


def nodes(tree: Any, form: PoseForm, where: str, at: str = "") -> Iterator[tuple[str, Array, str]]:
    """Name, poses (n, 4, 4) and what they were read as, of every node of a tree that holds poses."""
    if isinstance(tree, np.ndarray):
        if _shaped(tree):
            yield (at, *poses_from_array(tree, form, where))
        return
    if isinstance(tree, list):
        array = _array(tree)
        if array is not None and _shaped(array):
            yield (at, *poses_from_array(array, form, where))
        elif array is None:
            for k, item in enumerate(tree):
                yield from nodes(item, form, where, f"{at}/{k}")
        return
    if not isinstance(tree, Mapping):
        return
    single = _fields(tree, form, where)
    if single is not None:
        yield at, single[0], single[1]
        return
    used: set[str] = set()
    for key in tree:
        t = _partner(str(key), tree)
        if t is not None:
            R = _joined(tree[key], tree[t], where)
            if R is not None:
                used |= {str(key), t}
                yield str(key), R, "rotations and translations"
    for key, value in tree.items():
        if str(key) not in used:
            yield from nodes(value, form, where, f"{at}/{key}")


def _shaped(a: Array) -> bool:
    """Whether an array has a shape that only poses have (so not that of an image's matrix or a list of points)."""
    if a.ndim == 1:
        return a.size in (6, 7, 12, 16)
    if a.ndim == 2:
        return (
            a.shape in ((4, 4), (3, 4))
            or a.shape[1] in (6, 7, 12, 16)
            or (a.shape[1] == 4 and len(a) % 4 == 0)
            or (a.shape in ((6, 1), (7, 1), (16, 1)))
        )
    return a.ndim == 3 and (a.shape[1:] in ((4, 4), (3, 4)) or a.shape[1:] in ((1, 6), (1, 7)))


def _partner(key: str, siblings: Mapping[Any, Any]) -> str | None:
    """The key of the translation that belongs to a rotation's key: t_gripper2base to R_gripper2base."""
    for word, other in _PARTNERS.items():
        if key.lower().startswith(word) and (rest := key[len(word) :]) is not None:
            for candidate in siblings:
                if str(candidate) != key and str(candidate).lower() == (other + rest).lower():
                    return str(candidate)
    return None


def _joined(R: Any, t: Any, where: str) -> Array | None:
    """Poses from rotations (n, 3, 3), (3 n, 3) or vectors (n, 3), and translations (n, 3) or (3 n, 1)."""
    turn, at = (v if isinstance(v, np.ndarray) else _array(v) for v in (R, t))
    if turn is None or at is None or at.size % 3 or turn.size % 3 or at.size == 0:
        return None
    p = at.reshape(-1, 3)
    if turn.size == 9 * len(p):
        return matrices(np.concatenate([turn.reshape(-1, 3, 3), p[:, :, None]], axis=2), where)
    if turn.size == 3 * len(p):
        return pose(rotations(turn.reshape(-1, 3), "rotation_vector", "", where), p)
    return None


def _fields(d: Mapping[Any, Any], form: PoseForm, where: str) -> tuple[Array, str] | None:
    """One pose from an object such as {position: {x, y, z}, orientation: {x, y, z, w}}; None where it is none."""
    flat: dict[str, float] = {}
    for key, value in d.items():
        name = str(key).lower()
        if isinstance(value, Mapping):
            inner = {
                "position": "position",
                "translation": "translation",
                "rotation": "rotation",
                "orientation": "orientation",
            }
            if name in ("pose", "transform") and (found := _fields(value, form, where)) is not None:
                return found
            flat |= {f"{inner.get(name, name)}.{k}".lower(): as_number(v) for k, v in value.items()}
            continue
        numbers = value.ravel() if isinstance(value, np.ndarray) else _array(value) if isinstance(value, list) else None
        if numbers is None or numbers.ndim > 1:
            flat |= {name: as_number(value)} if not isinstance(value, list | np.ndarray) else {}
        elif name in ("position", "translation", "xyz", "p", "t") and numbers.size == 3:
            flat |= dict(zip("xyz", map(float, numbers), strict=True))
        elif (order := re.search("(wxyz|xyzw)$", name)) and numbers.size == 4:
            flat |= dict(zip((f"q{c}" for c in order[1]), map(float, numbers), strict=True))
        elif name in ("rotation_vector", "rotvec", "rvec", "rxyz") and numbers.size == 3:
            flat |= dict(zip(("rx", "ry", "rz"), map(float, numbers), strict=True))
        elif name in ("rotation", "orientation", "quaternion", "q") and numbers.size == 4:
            flat |= dict(zip(("q0", "q1", "q2", "q3"), map(float, numbers), strict=True))
    names = [n for n, v in flat.items() if np.isfinite(v)]
    if not any(n in ("x", "position.x", "translation.x") for n in names) or len(names) < 6:
        return None
    X, said, _ = column_poses(names, np.array([[flat[n] for n in names]]), form, where)
    return X, said


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
