"""Reads a tablet visit: the page's CSV, robot poses and an image."""

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.checks import Row, read_rows
from weldcal.calibration.errors import LandmarksNotFound, TabletDataError
from weldcal.calibration.tablet.detection import Look, arrange, find_marks
from weldcal.calibration.tablet.touches import check_page_match
from weldcal.calibration.tablet.wrist.fit import WristTouches
from weldcal.models.array_files import read_grey_image
from weldcal.models.arrays import Array
from weldcal.models.documents import parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_DOCUMENT, LARGEST_NUMBER, read_text, sha256

MOST_COLUMNS = 30
_ON_GRID_PX = 1.5  # of the page: its landmarks sit on whole device pixels
_MORE_ROWS = 8  # rows below the last touched one that are looked for in the image


def grid_columns(shown_px: Mapping[int, Array]) -> tuple[int, int]:
    """Columns of the page, and rows down to its last touched landmark, from coordinates (2,) px by landmark number.

    A landmark's number is its row times the columns plus its column; x goes with the column and y with the row, evenly,
    in whichever way the page is turned. Raises TabletDataError where no number of columns explains the coordinates.
    """
    numbers = np.array(sorted(shown_px))
    at = np.array([shown_px[k] for k in numbers])
    for columns in range(2, MOST_COLUMNS + 1):
        row, column = np.divmod(numbers, columns)
        if len(set(row)) < 2 or len(set(column)) < 2:
            continue
        A = np.c_[column, row, np.ones(len(numbers))]
        fit, *_ = np.linalg.lstsq(A, at, rcond=None)
        if np.abs(A @ fit - at).max() > _ON_GRID_PX or np.linalg.matrix_rank(A) < 3:
            continue
        right, down = fit[0], fit[1]
        square = abs(right @ down) < 0.02 * np.linalg.norm(right) * np.linalg.norm(down)
        if square and right[0] * down[1] - right[1] * down[0] > 0.0:
            return columns, int(row.max()) + 1
    raise TabletDataError(
        "The landmarks are not a grid that is numbered row by row from 0, which a search in the picture needs. Give"
        " their pixels with --seen instead of the picture."
    )


def find_page(grey: NDArray[np.uint8], shown_px: Mapping[int, Array], look: Look) -> Array:
    """Positions (n, 2) px in the image (h, w) of all of the page's landmarks, in their order.

    Rows that nobody touched are not in the file, but they are in the image: the page has as many rows as are found.
    Raises LandmarksNotFound, TabletDataError.
    """
    columns, rows = grid_columns(shown_px)
    points, full = find_marks(grey, columns * (rows + _MORE_ROWS), look)
    for more in range(_MORE_ROWS, 0, -1):
        if len(points) >= columns * (rows + more):
            with contextlib.suppress(LandmarksNotFound):
                return arrange(points, full, columns, rows + more)
    return arrange(points, full, columns, rows)


def read_table(path: Path, columns: Sequence[str]) -> list[Row]:
    """Rows of a CSV file that has at least these columns (lower case); a cell that is missing is empty.

    Raises TabletDataError: no such file, no text, a column missing.
    """
    try:
        names, rows = read_rows(path)
    except InputError as error:
        raise TabletDataError(str(error)) from error
    missing = [c for c in columns if c not in names]
    if missing:
        raise TabletDataError(f"'{path.name}' lacks the column{'s' if len(missing) > 1 else ''} {', '.join(missing)}.")
    return rows


def number(row: Row, column: str, path: Path) -> float:
    """Return the finite number of a column; raises TabletDataError."""
    try:
        value = float(row[column])
    except ValueError:
        value = float("nan")
    if not math.isfinite(value):
        raise TabletDataError(f"'{path.name}': '{row[column][:40]}' in the column {column} is not a number.")
    if abs(value) > LARGEST_NUMBER:
        raise TabletDataError(f"'{path.name}': {row[column][:40]} in the column {column} is beyond {LARGEST_NUMBER:g}.")
    return value


def landmark(row: Row, path: Path) -> int:
    """Return the landmark's number, from 0; raises TabletDataError."""
    value = number(row, "landmark", path)
    if value < 0.0 or value != int(value):
        raise TabletDataError(f"'{path.name}': landmarks are whole numbers from 0, not '{row['landmark'][:40]}'.")
    return int(value)


_LEAST_FOCAL_PX = 1e-3  # anything less is no camera, and its rays overflow
_COUNTS = (4, 5, 8, 12, 14)  # of distortion coefficients that OpenCV knows
_MATRIX, _DISTORTION = ("camera_matrix", "K", "k", "M"), ("distortion_coefficients", "D", "d", "distortion")


@dataclass(frozen=True)
class WristIntrinsics:
    """A pinhole camera with OpenCV's distortion.

    Focal lengths and principal point are in px, the centre of the first pixel at (0, 0).
    """

    focal_px: Array
    centre_px: Array
    distortion: Array

    def rays(self, uv_px: Array) -> Array:
        """Undistorted viewing rays (n, 2) of pixels (n, 2)."""
        K = np.array([[self.focal_px[0], 0, self.centre_px[0]], [0, self.focal_px[1], self.centre_px[1]], [0, 0, 1]])
        return np.asarray(cv2.undistortPoints(uv_px[:, None], K, self.distortion)[:, 0], dtype=float)


def load_intrinsics(path: Path) -> WristIntrinsics:
    """Intrinsics from a YAML file.

    Fx, fy, cx, cy and optionally distortion (OpenCV's order), or camera_matrix (K) and distortion_coefficients (D) as
    lists or with their `data`. Raises TabletDataError.
    """
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
    return WristIntrinsics(np.array(numbers[:2]), np.array(numbers[2:]), distortion if distortion.size else np.zeros(5))


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


TOUCH_COLUMNS = ("landmark", "landmark_x_px", "landmark_y_px", "touch_x_px", "touch_y_px", "mm_per_px")
POSE_COLUMNS = ("landmark", "x", "y", "z", "qw", "qx", "qy", "qz")
SEEN_COLUMNS = ("landmark", "u", "v")
CAMERA_ROW = "camera"
_FARTHEST_M = 5.0  # of a wrist from its base: beyond it the file is in millimetres
_OFF_CENTRE = 0.12  # of the image's size: a principal point farther from its middle is told
_NAMES_OF_CAMERA = (CAMERA_ROW, "image", "picture")


@dataclass(frozen=True)
class WristVisit:
    """Touches for fit_wrist, warnings about the files, and the landmarks' names.

    Where there is an image (h, w), all landmarks of the page were found in it at (n, 2) px.
    """

    data: WristTouches
    warnings: tuple[str, ...]
    names: tuple[str, ...]
    picture: NDArray[np.uint8] | None
    found_px: Array


def file_hash(path: Path) -> str:
    """SHA-256 of a file. Raises TabletDataError where it is no regular file."""
    try:
        return sha256(path)
    except InputError as error:
        raise TabletDataError(str(error)) from error


def load_visit(
    touches: Path,
    poses: Path,
    camera: Path | None,
    *,
    image: Path | None = None,
    seen: Path | None = None,
    look: Look = "rings",
    tip_radius_m: float = 0.0,
) -> WristVisit:
    """Touches of the page's CSV, with the flange's poses and what the camera saw (an image, or positions in a CSV).

    ``poses``: landmark,x,y,z,qw,qx,qy,qz of X_BF in metres at each touch, and one row whose landmark is `camera` for
    where the image was taken. Without ``camera`` there is no image. Of a landmark touched twice the last touch and the
    last pose count. Landmarks without a pose are left out and named in the warnings. ``tip_radius_m`` of a round pen
    tip. Raises TabletDataError with the file and what to change (touches that are not at their landmarks too),
    LandmarksNotFound for the image.
    """
    rows = {landmark(r, touches): r for r in read_table(touches, TOUCH_COLUMNS)}
    if not rows:
        raise TabletDataError(f"'{touches.name}' holds no touch.")
    X_camera, pose_of = _poses(poses)
    if X_camera is None and camera is not None:
        raise TabletDataError(
            f"'{poses.name}' lacks the row '{CAMERA_ROW}': the flange's pose when the image was taken."
        )
    used = [k for k in sorted(rows) if k in pose_of]
    if not used:
        raise TabletDataError(f"No landmark of '{touches.name}' has a pose in '{poses.name}'; both count from 0.")
    if sorted(pose_of) == [k + 1 for k in sorted(rows)]:
        raise TabletDataError(
            f"'{poses.name}' counts its landmarks from 1 and '{touches.name}' from 0: count both from 0."
        )
    values = {k: {c: number(rows[k], c, touches) for c in TOUCH_COLUMNS[1:]} for k in rows}
    pitch = {values[k]["mm_per_px"] for k in used}
    if len(pitch) != 1 or min(pitch) <= 0.0:
        raise TabletDataError(f"'{touches.name}' mixes sizes (mm_per_px); touch all landmarks at one size of the page.")
    scale = 1e-3 * pitch.pop()
    shown = {k: np.array([v["landmark_x_px"], v["landmark_y_px"]]) for k, v in values.items()}
    touched = scale * np.array([[values[k]["touch_x_px"], values[k]["touch_y_px"]] for k in used])
    landmarks = scale * np.array([shown[k] for k in used])
    names = tuple(str(k) for k in used)
    odd = check_page_match(touched / scale, landmarks / scale, names, 1e3 * scale, touches.name)
    corner = landmarks.min(axis=0)
    data = WristTouches(
        X_BF=tuple(pose_of[k] for k in used),
        touched_m=touched - corner,
        landmark_m=landmarks - corner,
        views=(),
        focal_px=1.0,
        tip_radius_m=tip_radius_m,
    )
    picture, found = None, np.zeros((0, 2))
    told = (*odd, *_warnings(rows, used, poses))
    if camera is None or X_camera is None:
        return WristVisit(data, told, names, picture, found)
    intrinsics = load_intrinsics(camera)
    if seen is not None:
        uv = _seen(seen, used)
    elif image is not None:
        picture = _picture(image)
        found = find_page(picture, shown, look)
        uv = found[used]
        told = (*told, *_image_warnings(intrinsics, picture, camera))
    else:
        raise TabletDataError("Give the camera's image (--image), or the pixels of the landmarks in it (--seen).")
    views = ((X_camera, intrinsics.rays(uv)),)
    return WristVisit(
        replace(data, views=views, focal_px=float(intrinsics.focal_px.mean())), told, names, picture, found
    )


def _poses(path: Path) -> tuple[RigidTransform | None, dict[int, RigidTransform]]:
    """Return the flange where the image was taken (None: no such row), and at each landmark."""
    found: dict[int, RigidTransform] = {}
    X_camera: RigidTransform | None = None
    for row in read_table(path, POSE_COLUMNS):
        if row["landmark"].lower() in _NAMES_OF_CAMERA:
            X_camera = _flange_pose(row, path)
        else:
            found[landmark(row, path)] = _flange_pose(row, path)
    return X_camera, found


def _seen(path: Path, used: list[int]) -> Array:
    positions = {landmark(r, path): r for r in read_table(path, SEEN_COLUMNS)}
    missing = [k for k in used if k not in positions]
    if missing:
        raise TabletDataError(f"'{path.name}' lacks landmark {missing[0]}.")
    return np.array([[number(positions[k], c, path) for c in ("u", "v")] for k in used])


def _picture(path: Path) -> NDArray[np.uint8]:
    try:
        picture = read_grey_image(path)
    except InputError as error:
        raise TabletDataError(str(error)) from error
    return np.asarray(picture, dtype=np.uint8)


def _warnings(rows: Mapping[int, Row], used: list[int], poses: Path) -> tuple[str, ...]:
    found = []
    if any(rows[k].get("size_checked", "1") == "0" for k in used):
        found.append("The page's size was not checked with a card: lengths may be wrong by some per cent.")
    without = [k for k in sorted(rows) if k not in used]
    if without:
        found.append(f"Excluded, without a pose in '{poses.name}': landmark {', '.join(map(str, without))}.")
    return tuple(found)


def _image_warnings(intrinsics: WristIntrinsics, picture: NDArray[np.uint8], camera: Path) -> tuple[str, ...]:
    size = np.array(picture.shape[::-1])
    off = np.abs(intrinsics.centre_px - 0.5 * (size - 1)) / size
    if off.max() <= _OFF_CENTRE:
        return ()
    return (
        (
            f"The image has {size[0]} by {size[1]} pixels, and the principal point of '{camera.name}' lies at"
            f" {intrinsics.centre_px[0]:.0f}, {intrinsics.centre_px[1]:.0f}: these intrinsics seem to belong to images"
            " of another size, or turned."
        ),
    )


def _flange_pose(row: Row, path: Path) -> RigidTransform:
    x, y, z, *q = (number(row, c, path) for c in POSE_COLUMNS[1:])
    norm = float(np.linalg.norm(q))
    if abs(norm - 1.0) > 1e-2:
        raise TabletDataError(
            f"'{path.name}': the quaternion of '{row['landmark'][:40]}' has the length {norm:.3g}, not 1."
        )
    if max(abs(x), abs(y), abs(z)) > _FARTHEST_M:
        raise TabletDataError(
            f"'{path.name}' must be in metres; '{row['landmark'][:40]}' is {max(abs(x), abs(y), abs(z)):.0f} away."
        )
    return RigidTransform(RotationMatrix(Quaternion(np.array(q) / norm)), [x, y, z])
