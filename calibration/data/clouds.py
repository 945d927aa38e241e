"""Reads point clouds from PLY, PCD, NPZ, NPY and text files and depth images; refuses damaged ones with a reason."""

import re
from collections.abc import Callable
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.cloud_files.body import CloudError, CloudForm, cloud_stream, measured
from weldcal.calibration.data.cloud_files.depth import (
    IMAGES,
    back_projected,
    camera_of,
    check_pixels,
    checked_intrinsics,
    depth_points,
    intrinsics_of,
    is_depth_array,
    read_depth_image,
)
from weldcal.models.array_files import read_npy, read_npz
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER, LARGEST_TEXT, decoded, read_text, write_npz
from weldcal.models.text_tables import cells_of, lines_of, separator_of

__all__ = [
    "NO_NOTES",
    "SUFFIXES",
    "CloudError",
    "CloudForm",
    "cloud_id",
    "ending_of",
    "find_cloud",
    "read_cloud",
    "save_cloud",
]

_MIN_POINTS = 30
_ROWS = 50_000  # converted at a time
_ROWS_TO_SEPARATE = 50
_WHOLE = re.compile(r"[+-]?\d+")
_LONGEST_NUMBER = 100  # characters


def ending_of(path: Path) -> str:
    """Return the ending of a cloud's file, one of SUFFIXES; the name's last one for another file."""
    name = path.name.lower()
    return next((s for s in SUFFIXES if s.endswith(".gz") and name.endswith(s)), path.suffix.lower())


def cloud_id(path: Path) -> str:
    """Return the name of a cloud's file without its ending."""
    return path.name[: len(path.name) - len(ending_of(path))]


def find_cloud(folder: Path, id: str) -> Path:
    """Return the one cloud file of an id. Raises CloudError when there is none or more than one."""
    found = sorted(p for p in folder.iterdir() if ending_of(p) in SUFFIXES and cloud_id(p) == id)
    found = [p for p in found if ending_of(p) in NO_NOTES] or [p for p in found if ending_of(p) not in IMAGES] or found
    if not found:
        raise CloudError(f"There is no cloud for this pose; add clouds/{id}.pcd, .ply, .npz, .npy or .csv.")
    if len(found) > 1:
        raise CloudError(f"There is more than one cloud for this pose ({', '.join(p.name for p in found)}); keep one.")
    return found[0]


def read_cloud(path: Path, form: CloudForm | None = None) -> Array:
    """Points (N, 3), or organised (H, W, 3) with NaN where invalid, in the file's unit.

    NPZ: ``points`` (N, 3) or (H, W, 3), or ``depth`` (H, W) with ``intrinsics`` (fx, fy, cx, cy) or ``K`` (3, 3), pixel
    centres at whole numbers. Zero or NaN depth is invalid. NPY: such points alone, or a depth image. Text: x, y, z are
    the first three columns, below a header or none. Points with NaN or at 0 0 0 were not measured: they are NaN in
    organised clouds and left out of lists. A list in the sensor's order that keeps them becomes organised.

    Args:
        form: what is known of the files beyond their contents.

    Raises:
        CloudError: not a regular file, unreadable, truncated, larger than the bounds in models/files.py, empty,
            infinite coordinates, a depth image without intrinsics, a PCD whose VIEWPOINT has no stated meaning.
    """
    form = form or CloudForm()
    reader = _READERS.get(ending_of(path))
    if reader is None:
        raise CloudError(f"The file {path.name} is no cloud: give {', '.join(SUFFIXES)}.")
    try:
        points = reader(path, form)
    except CloudError:
        raise
    except InputError as e:
        raise CloudError(str(e)) from e
    except MemoryError:
        raise CloudError(f"The cloud {path.name} needs more memory than there is: give a smaller one.") from None
    flat = points.reshape(-1, 3)
    if len(flat) == 0:
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    largest = max(
        float(np.fmax.reduce(flat, axis=None)), -float(np.fmin.reduce(flat, axis=None))
    )  # of all that are no NaN
    if np.isinf(largest):
        raise CloudError(f"The cloud {path.name} holds infinite coordinates; export it again.")
    if largest > LARGEST_NUMBER:
        raise CloudError(f"The cloud {path.name} holds coordinates beyond {LARGEST_NUMBER:g}; it is damaged.")
    points = measured(points, path.name)
    valid = points.size // 3 if points.ndim == 2 else int(np.count_nonzero(~np.isnan(points[:, :, 2])))
    if valid < _MIN_POINTS:
        raise CloudError(f"The cloud {path.name} has only {valid} valid points; scan again.")
    return points


def save_cloud(path: Path, points_C: Array, intrinsics: tuple[float, float, float, float] | None = None) -> None:
    """Write an (N, 3) or (H, W, 3) cloud as NPZ, single precision, metres: what read_cloud reads back.

    With ``intrinsics`` (fx, fy, cx, cy) an organised cloud is written as its depth map, a third of the size.
    """
    if intrinsics is not None and np.ndim(points_C) == 3:
        write_npz(path, depth=np.asarray(points_C[:, :, 2], dtype=np.float32), intrinsics=np.array(intrinsics))
        return
    write_npz(path, points=np.asarray(points_C, dtype=np.float32))


def _read_npy(path: Path, form: CloudForm) -> Array:
    array = read_npy(path)
    return depth_points(path, array, form) if is_depth_array(array) else _points(path, "The array", array)


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


def _read_npz(path: Path, form: CloudForm) -> Array:
    data = read_npz(path, ("points", "depth", "K", "intrinsics"))
    if "points" in data:
        return _points(path, "'points'", data["points"])
    if "depth" not in data:
        raise CloudError(f"{path.name} holds neither 'points' nor 'depth'.")
    depth = _numbers(path, "'depth'", data["depth"])
    if depth.ndim != 2:
        raise CloudError(f"'depth' in {path.name} has the shape {depth.shape}; (H, W) is needed.")
    check_pixels(path, depth.size)
    if "K" in data:
        K = _numbers(path, "'K'", data["K"])
        if K.shape != (3, 3):
            raise CloudError(f"'K' in {path.name} has the shape {K.shape}; (3, 3) is needed.")
        values = checked_intrinsics((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), path.name)
    elif "intrinsics" in data and np.size(data["intrinsics"]) == 4:
        values = checked_intrinsics(
            tuple(float(v) for v in np.ravel(_numbers(path, "'intrinsics'", data["intrinsics"]))), path.name
        )
    else:
        values = intrinsics_of(camera_of(path, form), depth.shape, path.name)
    return back_projected(depth, values)


def read_text_cloud(path: Path, form: CloudForm | None = None) -> Array:
    """Points (N, 3): the columns that the header names x, y and z, else the first three; # and // begin comments.

    A first line with one whole number is the number of points, as in .pts files. All rows have as many cells. Decimal
    commas are read where semicolons, tabs or blanks separate the cells.

    Raises:
        CloudError: anything else, with the line's number. InputError: the file cannot be opened, or is not UTF-8.
    """
    lines = lines_of(_text(path), ("#", "//"))
    rows = ((number, row) for number, line in lines if (row := line.rstrip(",; \t")))
    begin = list(islice(rows, _ROWS_TO_SEPARATE))
    promised = None
    if begin and _WHOLE.fullmatch(begin[0][1].strip()) and len(begin[0][1]) < 16:
        promised = int(begin.pop(0)[1])
    if not begin:
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    separator = separator_of([row for _, row in begin])
    above = begin[0][1]
    header = [c.lower() for c in cells_of(above, separator_of([above]))]
    columns = [0, 1, 2]
    headed = _number(header[0]) is None
    if headed:
        del begin[0]
        if {"x", "y", "z"} <= set(header):
            columns = [header.index(c) for c in "xyz"]
        if any(header.count(c) > 1 for c in "xyz"):
            raise CloudError(f"The header of {path.name} names x, y or z twice; keep one.")
        if not begin:
            raise CloudError(f"The cloud {path.name} is empty; scan again.")
    # a header of its own kind, such as "x y z" over "1,2,3", names no number of cells
    own = headed and separator_of([above]) != separator
    width = len(cells_of(begin[0][1], separator)) if own else len(header)
    if width < 3:
        raise CloudError(f"The file {path.name} has a row of fewer than three numbers; x, y and z are needed.")
    blocks: list[Array] = []
    block: list[list[float]] = []
    # a header that names as many columns as a row has cells says that commas separate them
    whole = separator == "," and not (headed and len(header) == width)
    for line, row in chain(begin, rows):
        cells = cells_of(row, separator)
        if len(cells) != width:
            raise CloudError(_surplus(path, line, len(cells), width))
        whole = whole and _could_be_decimals(cells)
        numbers = [_number(cells[c]) for c in columns]
        if None in numbers:
            bad = next(cells[c] for c, v in zip(columns, numbers, strict=True) if v is None)
            raise CloudError(f"The file {path.name}, line {line}: '{bad[:40]}' is not a number.")
        block.append([v for v in numbers if v is not None])
        if len(block) == _ROWS:
            blocks.append(np.array(block))
            block = []
    if whole:
        raise CloudError(
            f"The commas of {path.name} could be separators or decimal commas; write decimal points, or semicolons"
            " between the cells."
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


def _number(cell: str) -> float | None:
    if len(cell) > _LONGEST_NUMBER or "_" in cell:
        return None
    try:
        return float(cell)
    except ValueError:
        return None


def _could_be_decimals(cells: list[str]) -> bool:
    """Return whether each two whole numbers of a row could be one with a decimal comma: no sign behind the comma."""
    return (
        len(cells) >= 6
        and len(cells) % 2 == 0
        and all(_WHOLE.fullmatch(c) for c in cells)
        and not any(c.startswith(("+", "-")) for c in cells[1::2])
    )


def _surplus(path: Path, line: int, n: int, width: int) -> str:
    return (
        f"The file {path.name}, line {line}, has {n} cells and the first row {width}: give each row the same, and"
        " decimal commas only with semicolons or tabs between the cells."
    )


def _read_ply(path: Path, form: CloudForm) -> Array:
    from weldcal.calibration.data.cloud_files.ply import read_ply

    return read_ply(path)


def _read_pcd(path: Path, form: CloudForm) -> Array:
    from weldcal.calibration.data.cloud_files.pcd import read_pcd

    return read_pcd(path, form)


_TEXT = (".csv", ".txt", ".xyz", ".pts", ".asc")
_READERS: dict[str, Callable[[Path, CloudForm], Array]] = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".npz": _read_npz,
    ".npy": _read_npy,
    **dict.fromkeys(_TEXT, read_text_cloud),
    ".ply.gz": _read_ply,
    ".pcd.gz": _read_pcd,
    **dict.fromkeys((f"{s}.gz" for s in _TEXT), read_text_cloud),
    **dict.fromkeys(IMAGES, read_depth_image),
}
"""The forms of clouds: a new one is a row here and its function. The first is taken where a folder holds several."""
SUFFIXES = tuple(_READERS)
_NOTES = (".csv", ".txt", ".csv.gz", ".txt.gz", *IMAGES)
# such a file beside the clouds is a cloud, not somebody's notes or pictures
NO_NOTES = tuple(s for s in SUFFIXES if s not in _NOTES)
