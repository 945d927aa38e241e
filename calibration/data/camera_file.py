"""Read a camera's matrix and distortion from the files of common tools.

They are those of ROS, OpenCV, Kalibr, EuRoC, ViSP, Open3D, BOP and RealSense.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import DatasetError
from weldcal.models.array_files import read_npy, read_npz
from weldcal.models.arrays import Array
from weldcal.models.documents import as_number
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_DOCUMENT, LARGEST_NUMBER, read_text

_MATRIX = ("cameramatrix", "intrinsicmatrix", "k", "camk", "mtx", "m1", "m", "cammatrix", "intrinsic", "intrinsics",
           "kmatrix", "matrix")  # fmt: skip
_DISTORTION = (
    "distortioncoefficients",
    "distortioncoeffs",
    "distortion",
    "distcoeffs",
    "distcoeff",
    "dist",
    "d",
    "d1",
    "coeffs",
    "distcoefs",
    "kc",
)
_NUMBERS = (
    ("fx", "fu", "px", "focalx"),
    ("fy", "fv", "py", "focaly"),
    ("cx", "ppx", "u0", "pu", "centerx"),
    ("cy", "ppy", "v0", "pv", "centery"),
)
_FISHEYE = ("equidistant", "fisheye", "kannala", "omni", "thin_prism", "eucm", "fov")
_COUNTS = (4, 5, 8, 12, 14)  # of distortion coefficients that OpenCV knows
_NEEDED = (
    "give camera_matrix (or K) and distortion_coefficients, as ROS and OpenCV write them, or fx, fy, cx and cy in"
    " pixels"
)


@dataclass(frozen=True, eq=False)
class CameraFile:
    """A camera as a file states it.

    Attributes:
        K: camera matrix (3, 3), px; the centre of the first pixel at (0, 0).
        distortion: OpenCV's coefficients k1, k2, p1, p2, k3 ..., 5 or more.
        size: width and height of its pictures, px; None where the file does not state it.
        model: the file's words for its lens.
        covariance: of fx, fy, cx, cy and the distortion, (4 + d, 4 + d), zero for numbers that are fixed; None where
            the file does not state it.
    """

    K: Array
    distortion: Array
    size: tuple[int, int] | None
    model: str = ""
    covariance: Array | None = None

    @property
    def numbers(self) -> Array:
        """fx, fy, cx, cy and the distortion, (4 + d,)."""
        return np.concatenate([self.K[[0, 1, 0, 1], [0, 1, 2, 2]], self.distortion])

    @property
    def free(self) -> NDArray[np.int64]:
        """Places of the numbers that the file states with a covariance."""
        return np.flatnonzero(np.diag(np.zeros((1, 1)) if self.covariance is None else self.covariance) > 0.0)


def read_camera(path: Path) -> CameraFile:
    """Return the camera of a file.

    Raises:
        DatasetError: the file cannot be read, states no camera, or a lens model that OpenCV's pinhole model does not
            include.
    """
    try:
        found = find_camera(path)
    except InputError as problem:
        raise DatasetError(str(problem)) from problem
    if found is None:
        raise DatasetError(f"'{path.name}' states no camera that can be read: {_NEEDED}.")
    name, K, dist = path.name, found.K, found.distortion
    if any(word in found.model for word in _FISHEYE):
        raise DatasetError(
            f"'{name}' has the lens model '{found.model.strip()}'. Only pinhole cameras with radial and tangential"
            " distortion can be read. Calibrate the camera with OpenCV's calibrateCamera, or leave the file out: the"
            " camera is then estimated."
        )
    if dist.size not in _COUNTS:
        raise DatasetError(
            f"'{name}' holds {dist.size} distortion coefficients; OpenCV knows {', '.join(map(str, _COUNTS))}."
        )
    if not (np.abs([*K.ravel(), *dist]) <= LARGEST_NUMBER).all() or min(K[0, 0], K[1, 1]) <= 1.0:
        raise DatasetError(f"'{name}' holds a focal length that is no number of pixels above 1; {_NEEDED}.")
    found = replace(found, distortion=np.append(dist, 0.0) if dist.size == 4 else dist)
    C, m = found.covariance, 4 + found.distortion.size
    if C is None:
        return found
    if C.size != m**2 or not (np.abs(C) <= LARGEST_NUMBER).all():
        raise DatasetError(f"'{name}' holds a covariance of {C.size} numbers; {m} x {m} of finite ones are needed.")
    C = 0.5 * (C.reshape(m, m) + C.reshape(m, m).T)
    some = np.diag(C) > 0.0
    if np.diag(C).min() < 0.0 or C[~some].any() or not (np.linalg.eigvalsh(C[some][:, some]) > 0.0).all():
        raise DatasetError(f"'{name}' holds a covariance that is none: it has a variance that is not positive.")
    return replace(found, covariance=C)


def camera_document(camera: CameraFile) -> dict[str, Any]:
    """Return the contents of a camera file as ROS and OpenCV read it, with the key ``covariance`` for weldcal."""
    width, height = camera.size or (0, 0)
    arrays = {"camera_matrix": camera.K, "distortion_coefficients": camera.distortion[None]}
    if camera.covariance is not None:
        arrays["covariance"] = camera.covariance
    forms = {k: {"rows": v.shape[0], "cols": v.shape[1], "data": v.ravel().tolist()} for k, v in arrays.items()}
    return {"image_width": int(width), "image_height": int(height), "distortion_model": "plumb_bob", **forms}


def find_camera(path: Path) -> CameraFile | None:
    """Return the camera of a file as it is stated, not checked; None where it states none.

    Raises InputError where it cannot be read.
    """
    return next((found for node in _nodes(_tree(path)) if (found := _camera(node)) is not None), None)


def _tree(path: Path) -> Any:
    ending = path.suffix.lower()
    if ending == ".npz":
        return dict(read_npz(path))
    if ending == ".npy":
        return {"K": read_npy(path)}
    if ending not in (".txt", ".csv", ".dat"):
        from weldcal.calibration.data.poses.storage import read_tree  # a demo reads no file of a camera

        return read_tree(path)
    words = re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", read_text(path, LARGEST_DOCUMENT))
    values = np.array([float(w) for w in words])
    if len(values) in (4, 12, 16):
        return {"intrinsics": values}
    return {"K": values[:9], "D": values[9:]} if len(values) > 9 else {"K": values}


def _nodes(tree: Any) -> Iterator[Mapping[str, Any]]:
    """The mappings of a tree, the outer ones first."""
    level = [tree]
    while level:
        yield from (node for node in level if isinstance(node, Mapping))
        parts = (
            node.values() if isinstance(node, Mapping) else node if isinstance(node, list) else () for node in level
        )
        level = [v for values in parts for v in values if isinstance(v, Mapping | list)]


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


def _camera(node: Mapping[str, Any]) -> CameraFile | None:
    plain = _plain(node)
    numbers = [next((as_number(plain[k]) for k in keys if k in plain), np.nan) for keys in _NUMBERS]
    for key in _MATRIX:
        values = _values(plain.get(key))
        if values is None:
            continue
        if values.size == 4 and key.startswith("intrinsic"):  # Kalibr and EuRoC: fx, fy, cx, cy
            numbers = values.tolist()
            break
        if values.size in (9, 12, 16):
            K = values.reshape({9: (3, 3), 12: (3, 4), 16: (4, 4)}[values.size])[:3, :3]
            K = K.T if K[2, 0] > 1.0 and K[0, 2] == 0.0 else K  # column by column, as Open3D writes it
            if K[2, 2] == 1.0 and K[1, 0] == 0.0 == K[2, 0] == K[2, 1]:
                numbers = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
                break
    if not np.isfinite(numbers).all():
        return None
    fx, fy, cx, cy = numbers
    model = " ".join(str(plain.get(k, "")) for k in ("distortionmodel", "cameramodel", "model", "projectionmodel"))
    dist = next((v for key in _DISTORTION if (v := _values(plain.get(key))) is not None), None)
    if dist is None:
        named = [as_number(plain.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2", "k3")]
        if plain.get("kud") is not None:  # ViSP: u = u0 + px x (1 + kud r2)
            named[0] = as_number(plain["kud"])
        dist = np.array([v if np.isfinite(v) else 0.0 for v in named])
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return CameraFile(K, dist, _size(plain), model.lower(), _values(plain.get("covariance")))


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
