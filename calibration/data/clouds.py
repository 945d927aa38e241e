"""Reads point clouds from PLY, PCD, NPZ, NPY and text files; refuses damaged ones with a reason."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.cloud_body import CloudError
from weldcal.calibration.data.pcd import read_pcd
from weldcal.calibration.data.ply import read_ply
from weldcal.models.array_files import read_npy, read_npz
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER, LARGEST_TEXT, MOST_POINTS, expansion_limit, file_size, read_text
from weldcal.models.result_files import write_npz

_ROWS = 50_000  # converted at a time
_LINE = re.compile(r"[^\r\n]+")
_COMMA_DECIMAL = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_WHOLE = re.compile(r"[+-]?\d+")
_LONGEST_NUMBER = 100  # characters


def read_text_cloud(path: Path) -> Array:
    """Points (N, 3): the columns that the header names x, y and z, else the first three; # and // begin comments.

    All rows have as many cells. Decimal commas are read where semicolons, tabs or blanks separate the cells. Raises CloudError
    for anything else, with the line's number; InputError: the file cannot be opened, or is not UTF-8.
    """
    text = read_text(path, LARGEST_TEXT)
    rows = _rows(text)
    first = next(rows, None)
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
    return np.concatenate([*blocks, np.array(block, dtype=float).reshape(-1, 3)])


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


__all__ = ["NO_NOTES", "SUFFIXES", "CloudError", "find_cloud", "read_cloud", "save_cloud"]

_TEXT = (".csv", ".txt", ".xyz")
SUFFIXES = (".ply", ".pcd", ".npz", ".npy", *_TEXT)
NO_NOTES = tuple(
    s for s in SUFFIXES if s not in (".csv", ".txt")
)  # such a file beside the clouds is a cloud, not somebody's notes
_MIN_POINTS = 30


def find_cloud(folder: Path, id: str) -> Path:
    """The one cloud file of an id. Raises CloudError when there is none or more than one."""
    found = sorted(p for p in folder.iterdir() if p.stem == id and p.suffix.lower() in SUFFIXES)
    found = [p for p in found if p.suffix.lower() in NO_NOTES] or found
    if not found:
        raise CloudError(f"There is no cloud for this pose; add clouds/{id}.pcd, .ply, .npz, .npy or .csv.")
    if len(found) > 1:
        raise CloudError(f"There is more than one cloud for this pose ({', '.join(p.name for p in found)}); keep one.")
    return found[0]


def read_cloud(path: Path) -> Array:
    """Points (N, 3), or organised (H, W, 3) with NaN where invalid, in the file's unit.

    NPZ: ``points`` (N, 3) or (H, W, 3), or ``depth`` (H, W) with ``intrinsics`` (fx, fy, cx, cy) or ``K`` (3, 3), pixel
    centres at whole numbers; zero or NaN depth is invalid. NPY: such points alone. Text: x, y, z are the first three columns,
    below a header or none. NaN stands for a missing pixel in organised files.
    Raises CloudError: not a regular file, unreadable, truncated, larger than the bounds in models/files.py, empty, NaN in a
    list of points, infinite coordinates.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise CloudError(f"The file {path.name} is no cloud: give {', '.join(SUFFIXES)}.")
    try:
        points = reader(path)
    except CloudError:
        raise
    except InputError as e:
        raise CloudError(str(e)) from e
    except MemoryError:
        raise CloudError(f"The cloud {path.name} needs more memory than there is: give a smaller one.") from None
    flat = points.reshape(-1, 3)
    if len(flat) == 0:
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    if np.isinf(flat).any():
        raise CloudError(f"The cloud {path.name} holds infinite coordinates; export it again.")
    if max(float(np.nanmax(flat, initial=0.0)), -float(np.nanmin(flat, initial=0.0))) > LARGEST_NUMBER:
        raise CloudError(f"The cloud {path.name} holds coordinates beyond {LARGEST_NUMBER:g}; it is damaged.")
    bad = np.isnan(flat).any(axis=1)
    n_bad = int(bad.sum())
    if n_bad == len(flat):
        raise CloudError(f"Every point of {path.name} is NaN: nothing was measured; scan again.")
    if len(flat) - n_bad < _MIN_POINTS:
        raise CloudError(f"The cloud {path.name} has only {len(flat) - n_bad} valid points; scan again.")
    if points.ndim == 3:
        out = points.copy()
        out[bad.reshape(points.shape[:2])] = np.nan
        return out
    if n_bad:
        raise CloudError(
            f"{n_bad} of the {len(flat)} points of {path.name} are NaN; export the cloud without invalid points, or organised."
        )
    return flat


def save_cloud(path: Path, points_C: Array, intrinsics: tuple[float, float, float, float] | None = None) -> None:
    """Write an (N, 3) or (H, W, 3) cloud as NPZ, single precision, metres: what read_cloud reads back.

    With ``intrinsics`` (fx, fy, cx, cy) an organised cloud is written as its depth map, a third of the size.
    """
    if intrinsics is not None and np.ndim(points_C) == 3:
        write_npz(path, depth=np.asarray(points_C[:, :, 2], dtype=np.float32), intrinsics=np.array(intrinsics))
        return
    write_npz(path, points=np.asarray(points_C, dtype=np.float32))


def _read_npy(path: Path) -> Array:
    return _points(path, "The array", read_npy(path))


def _points(path: Path, name: str, value: Any) -> Array:
    points = _numbers(path, name, value)
    if points.ndim not in (2, 3) or points.shape[-1] != 3:
        raise CloudError(f"{name} in {path.name} has the shape {points.shape}; (N, 3) or (H, W, 3) is needed.")
    return points


def _numbers(path: Path, name: str, value: Any) -> Array:
    try:
        return np.asarray(value, dtype=float)
    except ValueError:
        raise CloudError(f"{name} in {path.name} holds words, not numbers.") from None


def _read_npz(path: Path) -> Array:
    data = read_npz(path, ("points", "depth", "K", "intrinsics"))
    if "points" in data:
        return _points(path, "'points'", data["points"])
    if "depth" not in data:
        raise CloudError(f"{path.name} holds neither 'points' nor 'depth'.")
    depth = _numbers(path, "'depth'", data["depth"])
    if depth.ndim != 2:
        raise CloudError(f"'depth' in {path.name} has the shape {depth.shape}; (H, W) is needed.")
    if depth.size > MOST_POINTS or 24 * depth.size > expansion_limit(file_size(path)):
        raise CloudError(f"The depth map in {path.name} has {depth.size} pixels, too many for a file of its size.")
    if "K" in data:
        K = _numbers(path, "'K'", data["K"])
        fx, fy, cx, cy = (
            (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])) if K.shape == (3, 3) else (0.0,) * 4
        )
    elif "intrinsics" in data and np.size(data["intrinsics"]) == 4:
        fx, fy, cx, cy = (float(v) for v in np.ravel(_numbers(path, "'intrinsics'", data["intrinsics"])))
    else:
        raise CloudError(
            f"{path.name} holds a depth map without intrinsics; add 'intrinsics' (fx, fy, cx, cy) or 'K' (3, 3)."
        )
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        raise CloudError(f"The intrinsics in {path.name} are not usable; focal lengths must be positive.")
    points = np.empty((*depth.shape, 3))
    z = points[:, :, 2]
    z[:] = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    # in place: an image of the largest scanner must not be in memory many times over
    np.divide(np.multiply(z, np.arange(depth.shape[1]) - cx, out=points[:, :, 0]), fx, out=points[:, :, 0])
    np.divide(np.multiply(z, (np.arange(depth.shape[0]) - cy)[:, None], out=points[:, :, 1]), fy, out=points[:, :, 1])
    return points


_READERS: dict[str, Callable[[Path], Array]] = {
    ".npz": _read_npz, ".npy": _read_npy, ".ply": read_ply, ".pcd": read_pcd, **dict.fromkeys(_TEXT, read_text_cloud)
}  # fmt: skip
