"""Reads camera intrinsics from YAML: fx, fy, cx, cy, or the camera matrix as ROS and OpenCV write it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from weldcal.calibration.tablet.errors import TabletDataError
from weldcal.models.arrays import Array
from weldcal.models.documents import parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import read_text
from weldcal.models.limits import LARGEST_DOCUMENT, LARGEST_NUMBER

_LEAST_FOCAL_PX = 1e-3  # anything less is no camera, and its rays overflow
_COUNTS = (4, 5, 8, 12, 14)  # of distortion coefficients that OpenCV knows
_MATRIX, _DISTORTION = ("camera_matrix", "K", "k", "M"), ("distortion_coefficients", "D", "d", "distortion")


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera: focal lengths and principal point (px, centre of the first pixel at (0, 0)), OpenCV distortion."""

    focal_px: Array
    centre_px: Array
    distortion: Array

    def rays(self, uv_px: Array) -> Array:
        """Undistorted viewing rays (n, 2) of pixels (n, 2)."""
        K = np.array([[self.focal_px[0], 0, self.centre_px[0]], [0, self.focal_px[1], self.centre_px[1]], [0, 0, 1]])
        return np.asarray(cv2.undistortPoints(uv_px[:, None], K, self.distortion)[:, 0], dtype=float)


def load_intrinsics(path: Path) -> Intrinsics:
    """Intrinsics from a YAML file: fx, fy, cx, cy and optionally distortion (OpenCV's order), or camera_matrix (K) and
    distortion_coefficients (D) as lists or with their `data`. Raises TabletDataError."""
    try:
        text = read_text(path, LARGEST_DOCUMENT)
    except InputError as error:
        raise TabletDataError(str(error)) from error
    try:
        d = _document(path, text)
        numbers = [float(d[key]) for key in ("fx", "fy", "cx", "cy")] if "fx" in d else _from_matrix(d)
        found: Any = next((d[key] for key in _DISTORTION if d.get(key) is not None), [])
        distortion = np.ravel(np.array(_data(found), dtype=float))
    except InputError as error:
        raise TabletDataError(str(error)) from error
    except Exception as error:  # unreadable in any way: the same sentence
        raise TabletDataError(
            f"'{path.name}' must hold fx, fy, cx and cy in pixels, or camera_matrix (and distortion, where known)."
        ) from error
    if distortion.size not in (0, *_COUNTS):
        counts = ", ".join(map(str, _COUNTS))
        raise TabletDataError(f"'{path.name}': distortion holds {distortion.size} numbers; OpenCV knows {counts}.")
    if not (np.abs([*numbers, *distortion]) <= LARGEST_NUMBER).all() or min(numbers[:2]) < _LEAST_FOCAL_PX:
        raise TabletDataError(
            f"'{path.name}' holds a focal length that is not positive, or a value that is not a number."
        )
    return Intrinsics(np.array(numbers[:2]), np.array(numbers[2:]), distortion if distortion.size else np.zeros(5))


def _document(path: Path, text: str) -> dict[str, Any]:
    if not text.startswith("%YAML:"):
        return dict(parse_document(path.name, text))
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)  # OpenCV's own dialect
    nodes = {key: storage.getNode(key) for key in (*_MATRIX, *_DISTORTION)}
    return {key: node.mat().ravel().tolist() for key, node in nodes.items() if not node.empty()}


def _data(value: Any) -> Any:
    return value["data"] if isinstance(value, dict) else value


def _from_matrix(d: dict[str, Any]) -> list[float]:
    K = np.array(_data(next(d[key] for key in _MATRIX if key in d)), dtype=float).reshape(3, 3)
    return [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
