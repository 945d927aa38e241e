"""Reads point clouds from PLY, PCD, NPZ, NPY and text files; refuses damaged ones with a reason."""

import re
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

_TEXT = (".csv", ".txt", ".xyz")
SUFFIXES = (".ply", ".pcd", ".npz", ".npy", *_TEXT)
NO_NOTES = tuple(
    s for s in SUFFIXES if s not in (".csv", ".txt")
)  # such a file beside the clouds is a cloud, not somebody's notes
_MIN_POINTS = 30


class CloudError(InputError):
    """A cloud cannot be used; ``reason`` is one sentence without its name."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


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
    Raises CloudError: unreadable, truncated, empty, NaN in a list of points, infinite coordinates.
    """
    try:
        points, declared = _READERS.get(path.suffix.lower(), _read_open3d)(path)
    except CloudError:
        raise
    except (OSError, ValueError, RuntimeError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as e:
        raise CloudError(
            f"The file {path.name} cannot be read: {str(e).splitlines()[0] if str(e) else type(e).__name__}."
        ) from e
    flat = points.reshape(-1, 3)
    if declared is not None and declared > 0 and len(flat) < declared:
        raise CloudError(
            f"The file {path.name} is truncated: its header promises {declared} points and {len(flat)} are there."
        )
    if len(flat) == 0:
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    if np.isinf(flat).any():
        raise CloudError(f"The cloud {path.name} holds infinite coordinates; export it again.")
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
        np.savez_compressed(
            path, depth=np.asarray(points_C[:, :, 2], dtype=np.float32), intrinsics=np.array(intrinsics)
        )
        return
    np.savez_compressed(path, points=np.asarray(points_C, dtype=np.float32))


def _read_open3d(path: Path) -> tuple[Array, int | None]:
    head = path.read_bytes()[:8192].decode("latin-1")
    if not head.strip():
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    if path.suffix.lower() == ".pcd":
        declared = _number(r"^POINTS\s+(\d+)", head)
        width, height = _number(r"^WIDTH\s+(\d+)", head), _number(r"^HEIGHT\s+(\d+)", head)
        if declared is None:
            raise CloudError(f"The file {path.name} is not a PCD file: its header has no POINTS line.")
        ascii_rows = re.search(r"^DATA\s+ascii", head, re.MULTILINE) is not None
    else:
        declared, width, height = _number(r"^element\s+vertex\s+(\d+)", head), None, None
        if declared is None:
            raise CloudError(f"The file {path.name} is not a PLY file: its header has no vertex element.")
        ascii_rows = re.search(r"^format\s+ascii", head, re.MULTILINE) is not None
    if declared == 0:
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    if ascii_rows:
        _check_rows(path, declared)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(path, remove_nan_points=False, remove_infinite_points=False)
    points = np.asarray(cloud.points, dtype=float)
    if len(points) == 0:
        raise CloudError(f"The file {path.name} cannot be read: it is damaged or truncated; export it again.")
    if height is not None and width is not None and height > 1 and width * height == len(points):
        points = points.reshape(height, width, 3)
    return points, declared


def _check_rows(path: Path, declared: int) -> None:
    """A text cloud that stops early is read by some libraries as a cloud with zeros at its end."""
    marker = rb"DATA ascii" if path.suffix.lower() == ".pcd" else rb"end_header"
    body = path.read_bytes().split(marker, 1)[-1]
    rows = sum(1 for line in body.splitlines() if line.strip())
    if rows < declared:
        raise CloudError(
            f"The file {path.name} is truncated: its header promises {declared} points and {rows} are there."
        )


def _number(pattern: str, text: str) -> int | None:
    found = re.search(pattern, text, re.MULTILINE)
    return None if found is None else int(found.group(1))


def _read_npy(path: Path) -> tuple[Array, None]:
    return _points(path, "The array", np.load(path, allow_pickle=False)), None


def _read_text(path: Path) -> tuple[Array, None]:
    lines = [re.split(r"[\s,;]+", s.strip().strip(",;")) for s in path.read_text(encoding="utf-8-sig").splitlines()]
    rows = [line for line in lines if line != [""] and not line[0].startswith(("#", "//"))]
    if rows and not _is_number(rows[0][0]):
        rows = rows[1:]
    if any(len(row) < 3 for row in rows):
        raise CloudError(f"The file {path.name} has a row of fewer than three numbers; x, y and z are needed.")
    return np.array([row[:3] for row in rows], dtype=float).reshape(-1, 3), None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _points(path: Path, name: str, value: Any) -> Array:
    points = np.asarray(value, dtype=float)
    if points.ndim not in (2, 3) or points.shape[-1] != 3:
        raise CloudError(f"{name} in {path.name} has the shape {points.shape}; (N, 3) or (H, W, 3) is needed.")
    return points


def _read_npz(path: Path) -> tuple[Array, int | None]:
    with np.load(path, allow_pickle=False) as data:
        if "points" in data:
            return _points(path, "'points'", data["points"]), None
        if "depth" not in data:
            raise CloudError(f"{path.name} holds neither 'points' nor 'depth'.")
        depth = np.asarray(data["depth"], dtype=float)
        if depth.ndim != 2:
            raise CloudError(f"'depth' in {path.name} has the shape {depth.shape}; (H, W) is needed.")
        if "K" in data:
            K = np.asarray(data["K"], dtype=float)
            fx, fy, cx, cy = (
                (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])) if K.shape == (3, 3) else (0.0,) * 4
            )
        elif "intrinsics" in data and np.size(data["intrinsics"]) == 4:
            fx, fy, cx, cy = (float(v) for v in np.ravel(data["intrinsics"]))
        else:
            raise CloudError(
                f"{path.name} holds a depth map without intrinsics; add 'intrinsics' (fx, fy, cx, cy) or 'K' (3, 3)."
            )
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        raise CloudError(f"The intrinsics in {path.name} are not usable; focal lengths must be positive.")
    z = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    return np.stack([z * (u - cx) / fx, z * (v - cy) / fy, z], axis=-1), None


_READERS: dict[str, Callable[[Path], tuple[Array, int | None]]] = {
    ".npz": _read_npz, ".npy": _read_npy, **dict.fromkeys(_TEXT, _read_text)
}  # fmt: skip
