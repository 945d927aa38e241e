"""Reads point clouds from PLY, PCD, NPZ, NPY and text files and depth images; refuses damaged ones with a reason."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.cloud_body import CloudError
from weldcal.calibration.data.cloud_form import CloudForm
from weldcal.calibration.data.depth import (
    IMAGES,
    back_projected,
    camera_of,
    check_pixels,
    depth_points,
    is_depth_array,
    read_depth_image,
)
from weldcal.calibration.data.grid import measured
from weldcal.calibration.data.intrinsics import checked_intrinsics, intrinsics_of
from weldcal.calibration.data.pcd import read_pcd
from weldcal.calibration.data.ply import read_ply
from weldcal.calibration.data.text_cloud import read_text_cloud
from weldcal.models.array_files import read_npy, read_npz
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.limits import LARGEST_NUMBER
from weldcal.models.result_files import write_npz

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

_TEXT = (".csv", ".txt", ".xyz", ".pts", ".asc")
_PLAIN = (".ply", ".pcd", ".npz", ".npy", *_TEXT)
_PACKED = (".ply.gz", ".pcd.gz", *(f"{s}.gz" for s in _TEXT))
SUFFIXES = (*_PLAIN, *_PACKED, *IMAGES)
_NOTES = (".csv", ".txt", ".csv.gz", ".txt.gz", *IMAGES)
NO_NOTES = tuple(
    s for s in SUFFIXES if s not in _NOTES
)  # such a file beside the clouds is a cloud, not somebody's notes or pictures
_MIN_POINTS = 30


def ending_of(path: Path) -> str:
    """The ending of a cloud's file, one of SUFFIXES; the name's last one for another file."""
    name = path.name.lower()
    return next((s for s in _PACKED if name.endswith(s)), path.suffix.lower())


def cloud_id(path: Path) -> str:
    """The name of a cloud's file without its ending."""
    return path.name[: len(path.name) - len(ending_of(path))]


def find_cloud(folder: Path, id: str) -> Path:
    """The one cloud file of an id. Raises CloudError when there is none or more than one."""
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
    centres at whole numbers; zero or NaN depth is invalid. NPY: such points alone, or a depth image. Text: x, y, z are the first
    three columns, below a header or none. Points with NaN or at 0 0 0 were not measured: they are NaN in organised clouds and
    left out of lists. A list in the sensor's order that keeps them becomes organised.

    Args:
        form: what is known of the files beyond their contents.

    Raises:
        CloudError: not a regular file, unreadable, truncated, larger than the bounds in models/limits.py, empty, infinite
            coordinates, a depth image without intrinsics, a PCD whose VIEWPOINT has no stated meaning.
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


_READERS: dict[str, Callable[[Path, CloudForm], Array]] = {
    ".npz": _read_npz, ".npy": _read_npy, **dict.fromkeys((".ply", ".ply.gz"), lambda path, form: read_ply(path)),
    **dict.fromkeys((".pcd", ".pcd.gz"), read_pcd), **dict.fromkeys(IMAGES, read_depth_image),
    **dict.fromkeys((*_TEXT, *(f"{s}.gz" for s in _TEXT)), lambda path, form: read_text_cloud(path)),
}  # fmt: skip
