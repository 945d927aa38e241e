"""Finds the intrinsics of a depth camera in a file beside its images: ROS, OpenCV, Kalibr, Open3D, BOP and RealSense forms, or a 3 x 3 text."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.cloud_files.body import CloudError
from weldcal.calibration.data.poses.storage import read_tree
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_DOCUMENT, read_text

_STEMS = (
    "camera_info", "depth_camera_info", "depth_intrinsics", "intrinsics", "intrinsic", "camera_intrinsics", "camera_intrinsic",
    "camera-intrinsics", "intrinsic_depth", "camera_matrix", "camera", "depth_camera", "depth", "k", "cam_k", "camchain", "scene_camera",
)  # fmt: skip
_TREES = (".yaml", ".yml", ".json", ".xml")
_TEXTS = (".txt", ".csv")
_MATRICES = ("k", "cam_k", "camera_matrix", "intrinsic_matrix", "intrinsic", "intrinsics", "cameramatrix", "matrix")
_LENS = ("d", "distortion_coefficients", "dist_coeffs", "distortion", "distcoeffs", "distortion_coeffs", "coeffs")
_NAMES = (
    ("fx", "fy", "cx", "cy"),
    ("fx", "fy", "ppx", "ppy"),
    ("f_x", "f_y", "c_x", "c_y"),
    ("focal_x", "focal_y", "center_x", "center_y"),
)
_ADVICE = "write 'intrinsics: {fx: ..., fy: ..., cx: ..., cy: ...}' (pixels) into dataset.yaml"


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A camera as its file states it.

    Attributes:
        values: fx, fy, cx, cy, pixels.
        source: the file.
        size: width and height of the images, pixels; 0 where the file does not say.
        straight: whether no lens distortion is stated.
    """

    values: tuple[float, float, float, float]
    source: Path
    size: tuple[int, int] = (0, 0)
    straight: bool = True


def is_camera_file(path: Path) -> bool:
    """Whether a file's name says that it holds a camera's intrinsics."""
    return path.stem.lower() in _STEMS and path.suffix.lower() in (*_TREES, *_TEXTS)


def find_intrinsics(*folders: Path) -> Intrinsics | None:
    """The camera of the first of these folders that holds a file of one; None where none does.

    Raises:
        CloudError: a file of that name cannot be read, or holds no intrinsics.
    """
    for folder in dict.fromkeys(folders):
        files = {p.name.lower(): p for p in sorted(folder.iterdir()) if p.is_file()} if folder.is_dir() else {}
        for stem in _STEMS:
            for ending in (*_TREES, *_TEXTS):
                path = files.get(stem + ending)
                if path is not None and (found := _read(path)) is not None:
                    return found
    return None


def checked_intrinsics(values: tuple[float, ...], source: str) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy where they can be a camera's. Raises CloudError."""
    fx, fy, cx, cy = values
    if not (np.isfinite(values).all() and min(fx, fy) > 0.0 and max(map(abs, values)) < 1e6):
        raise CloudError(
            f"The intrinsics in {source} are not usable (fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}): focal lengths are positive, in pixels."
        )
    return fx, fy, cx, cy


def intrinsics_of(found: Intrinsics | None, shape: tuple[int, int], name: str) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy for a depth image (height, width).

    Raises:
        CloudError: no camera is known, its images have another size, or a lens distortion. The sentence says what to write where.
    """
    height, width = shape
    if found is None:
        raise CloudError(
            f"{name} is a depth image of {width} x {height} pixels, and its camera's intrinsics are not known: {_ADVICE}, or put the "
            "camera's file (camera_info.yaml of ROS, OpenCV or Kalibr) beside the images."
        )
    if found.size not in ((0, 0), (width, height)):
        raise CloudError(
            f"{name} has {width} x {height} pixels, and {found.source.name} states a camera of {found.size[0]} x {found.size[1]}: give the "
            f"camera of the depth images, or {_ADVICE}."
        )
    if not found.straight:
        raise CloudError(
            f"{found.source.name} states a lens distortion, and points follow from rectified depth images only: where {name} is rectified, "
            f"{_ADVICE}."
        )
    return found.values


def _read(path: Path) -> Intrinsics | None:
    """The camera in a file; None where it holds none."""
    try:
        if path.suffix.lower() in _TEXTS:
            text = read_text(path, LARGEST_DOCUMENT).replace(",", " ").replace(";", " ")
            words = text.split()
            try:
                tree: Any = {"k": np.array([float(w) for w in words])} if len(words) in (4, 9, 12, 16) else None
            except ValueError:
                tree = None
        else:
            tree = read_tree(path)
    except InputError as e:
        raise CloudError(str(e)) from e
    for node in _nodes(tree):
        values = _values(node)
        if values is None:
            continue
        lens = next((_numbers(v) for k, v in node.items() if str(k).lower() in _LENS), None)
        return Intrinsics(
            values=checked_intrinsics(values, path.name),
            source=path,
            size=_size(node),
            straight=lens is None or not lens.any(),
        )
    return None


def _nodes(tree: Any) -> Iterator[Mapping[Any, Any]]:
    """The mappings of a tree, the outer ones first."""
    level = [tree]
    while level:
        maps = [node for node in level if isinstance(node, Mapping)]
        yield from maps
        inner = [
            v
            for node in level
            for v in (node.values() if isinstance(node, Mapping) else node if isinstance(node, list) else ())
        ]
        level = [v for v in inner if isinstance(v, Mapping | list)]


def _values(node: Mapping[Any, Any]) -> tuple[float, ...] | None:
    lower = {str(k).lower(): v for k, v in node.items()}
    for names in _NAMES:
        if all(isinstance(lower.get(n), int | float) for n in names):
            return tuple(float(lower[n]) for n in names)
    for key in _MATRICES:
        value = lower.get(key)
        if isinstance(value, Mapping) and "data" in value:
            value = value["data"]
        numbers = _numbers(value)
        if numbers is None or not np.isfinite(numbers).all():
            continue
        if numbers.size == 4:
            return tuple(numbers.tolist())
        M = {9: (3, 3), 12: (3, 4), 16: (4, 4)}.get(numbers.size)
        if M is None:
            continue
        K = numbers.reshape(M)
        K = K.T if K[2, 0] > 1.0 and K[0, 2] == 0.0 else K  # column by column, as Open3D writes it
        if K[2, 2] == 1.0 and K[1, 0] == 0.0 == K[2, 0] == K[2, 1]:
            return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    return None


def _numbers(value: Any) -> Array | None:
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        return np.asarray(value, dtype=float).ravel() if isinstance(value, list | np.ndarray) else None
    except (TypeError, ValueError):
        return None


def _size(node: Mapping[Any, Any]) -> tuple[int, int]:
    lower = {str(k).lower(): v for k, v in node.items()}
    for names in (("width", "height"), ("image_width", "image_height")):
        width, height = (lower.get(n) for n in names)
        if isinstance(width, int | float) and isinstance(height, int | float):
            return int(width), int(height)
    size = _numbers(lower.get("resolution"))
    return (int(size[0]), int(size[1])) if size is not None and size.size == 2 else (0, 0)
