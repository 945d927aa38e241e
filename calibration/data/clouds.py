"""Reads point clouds from PLY, PCD, NPZ, NPY and text files; refuses damaged ones with a reason."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.cloud_body import CloudError
from weldcal.calibration.data.pcd import read_pcd
from weldcal.calibration.data.ply import read_ply
from weldcal.calibration.data.text_cloud import read_text_cloud
from weldcal.models.array_files import read_npy, read_npz
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import file_size
from weldcal.models.limits import LARGEST_NUMBER, MOST_POINTS, expansion_limit
from weldcal.models.result_files import write_npz

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
    Raises CloudError: not a regular file, unreadable, truncated, larger than the bounds in models/limits.py, empty, NaN in a
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
