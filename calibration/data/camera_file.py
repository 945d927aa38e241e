"""Read a camera's matrix and distortion from the files that ROS, OpenCV, Kalibr, EuRoC, ViSP and RealSense users have."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.poses.storage import read_tree
from weldcal.calibration.errors import DatasetError
from weldcal.models.array_files import read_npy, read_npz
from weldcal.models.arrays import Array
from weldcal.models.documents import as_number
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_DOCUMENT, LARGEST_NUMBER, read_text

_MATRIX = ("cameramatrix", "intrinsicmatrix", "k", "mtx", "m1", "m", "cammatrix", "intrinsic", "intrinsics", "kmatrix")
_DISTORTION = ("distortioncoefficients", "distortioncoeffs", "distortion", "distcoeffs", "distcoeff", "dist", "d", "d1", "coeffs", "distcoefs", "kc")  # fmt: skip
_NUMBERS = (("fx", "fu", "px"), ("fy", "fv", "py"), ("cx", "ppx", "u0", "pu"), ("cy", "ppy", "v0", "pv"))
_FISHEYE = ("equidistant", "fisheye", "kannala", "omni", "thin_prism", "eucm", "fov")
_COUNTS = (4, 5, 8, 12, 14)  # of distortion coefficients that OpenCV knows
_NEEDED = "give camera_matrix (or K) and distortion_coefficients, as ROS and OpenCV write them, or fx, fy, cx and cy in pixels"


@dataclass(frozen=True, eq=False)
class CameraFile:
    """A camera as a file states it.

    Attributes:
        K: camera matrix (3, 3), px; the centre of the first pixel at (0, 0).
        distortion: OpenCV's coefficients k1, k2, p1, p2, k3 ..., 5 or more.
        size: width and height of its pictures, px; None where the file does not state it.
    """

    K: Array
    distortion: Array
    size: tuple[int, int] | None


def read_camera(path: Path) -> CameraFile:
    """The camera of a file.

    Raises:
        DatasetError: the file cannot be read, states no camera, or a lens model that OpenCV's pinhole model does not include.
    """
    tree = _tree(path)
    for node in _nodes(tree):
        found = _camera(node, path.name)
        if found is not None:
            return found
    raise DatasetError(f"'{path.name}' states no camera that can be read: {_NEEDED}.")


def _tree(path: Path) -> Any:
    ending = path.suffix.lower()
    try:
        if ending == ".npz":
            return dict(read_npz(path))
        if ending == ".npy":
            return {"K": read_npy(path)}
        if ending in (".txt", ".csv", ".dat"):
            words = re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", read_text(path, LARGEST_DOCUMENT))
            values = np.array([float(w) for w in words])
            if len(values) >= 9 and values[8] == 1.0 and not values[[3, 6, 7]].any():
                return (
                    {"K": values[:9].reshape(3, 3), "D": values[9:]} if len(values) > 9 else {"K": values.reshape(3, 3)}
                )
            raise DatasetError(f"'{path.name}' does not begin with the nine numbers of a camera matrix: {_NEEDED}.")
        return read_tree(path)
    except DatasetError:
        raise
    except InputError as problem:
        raise DatasetError(str(problem)) from problem


def _nodes(tree: Any, depth: int = 0) -> Iterator[Mapping[str, Any]]:
    """Every mapping of a tree, the outer ones first."""
    if isinstance(tree, Mapping):
        yield tree
    if depth < 5 and isinstance(tree, Mapping | list):
        for one in tree.values() if isinstance(tree, Mapping) else tree:
            yield from _nodes(one, depth + 1)


def _plain(node: Mapping[str, Any]) -> dict[str, Any]:
    return {re.sub(r"[^a-z0-9]", "", str(key).lower()): value for key, value in node.items()}


def _values(value: Any) -> Array | None:
    if isinstance(value, Mapping):
        value = value.get("data")
    if isinstance(value, str):
        value = value.replace(",", " ").split()
    try:
        found = np.ravel(np.asarray(value, dtype=float))
    except (TypeError, ValueError, OverflowError):
        return None
    return found if found.size and np.isfinite(found).all() else None


def _camera(node: Mapping[str, Any], name: str) -> CameraFile | None:
    plain = _plain(node)
    K = None
    for key in _MATRIX:
        values = _values(plain.get(key))
        if values is not None and values.size == 9:
            K = values.reshape(3, 3)
            K = K if K[2, 2] == 1.0 and K[2, 0] == 0.0 else K.T
        elif values is not None and values.size == 4 and key == "intrinsics":  # Kalibr and EuRoC: fx, fy, cx, cy
            K = np.array([[values[0], 0.0, values[2]], [0.0, values[1], values[3]], [0.0, 0.0, 1.0]])
        if K is not None:
            break
    if K is None:
        numbers = [next((as_number(plain[k]) for k in keys if k in plain), np.nan) for keys in _NUMBERS]
        if not np.isfinite(numbers).all():
            return None
        K = np.array([[numbers[0], 0.0, numbers[2]], [0.0, numbers[1], numbers[3]], [0.0, 0.0, 1.0]])
    model = " ".join(
        str(plain.get(k, "")) for k in ("distortionmodel", "cameramodel", "model", "projectionmodel")
    ).lower()
    if any(word in model for word in _FISHEYE):
        raise DatasetError(
            f"'{name}' states the lens model '{model.strip()}'; pinhole cameras with radial and tangential distortion are read: calibrate the "
            "camera with OpenCV's calibrateCamera, or leave the file out and let the camera be estimated."
        )
    dist = next((v for key in _DISTORTION if (v := _values(plain.get(key))) is not None), None)
    if dist is None:
        named = [as_number(plain.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2", "k3")]
        if plain.get("kud") is not None:  # ViSP: u = u0 + px x (1 + kud r2)
            named[0] = as_number(plain["kud"])
        dist = np.array([v if np.isfinite(v) else 0.0 for v in named])
    if dist.size not in _COUNTS:
        raise DatasetError(
            f"'{name}' holds {dist.size} distortion coefficients; OpenCV knows {', '.join(map(str, _COUNTS))}."
        )
    dist = np.append(dist, 0.0) if dist.size == 4 else dist
    if not (np.abs([*K.ravel(), *dist]) <= LARGEST_NUMBER).all() or min(K[0, 0], K[1, 1]) <= 1.0:
        raise DatasetError(f"'{name}' holds a focal length that is no number of pixels above 1; {_NEEDED}.")
    return CameraFile(K, dist, _size(plain))


def _size(plain: Mapping[str, Any]) -> tuple[int, int] | None:
    for keys in (("imagewidth", "imageheight"), ("width", "height")):
        values = [as_number(plain.get(k)) for k in keys]
        if all(np.isfinite(v) and v >= 1.0 for v in values):
            return int(values[0]), int(values[1])
    for key in ("resolution", "imagesize", "imgsize"):
        found = _values(plain.get(key))
        if found is not None and found.size == 2:
            return int(found[0]), int(found[1])
    return None
