"""Reading what a visit to the tablet left: the page's CSV with robot poses and an image."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.yaml import yaml_load
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.tablet.detection import Look, find_landmarks
from weldcal.calibration.tablet.errors import TabletDataError
from weldcal.calibration.tablet.wrist import WristTouches

Array = NDArray[np.float64]

TOUCH_COLUMNS = ("landmark", "landmark_x_px", "landmark_y_px", "touch_x_px", "touch_y_px", "mm_per_px")
POSE_COLUMNS = ("landmark", "x", "y", "z", "qw", "qx", "qy", "qz")
SEEN_COLUMNS = ("landmark", "u", "v")
CAMERA_ROW = "camera"
_FARTHEST_M = 5.0  # of a wrist from its base: beyond it the file is in millimetres


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


@dataclass(frozen=True)
class WristVisit:
    """Touches for fit_wrist, whether a card had checked the page's size, the landmarks' names, and the image (h, w) with where
    all landmarks of the page were found in it (n, 2) px, where there is one."""

    data: WristTouches
    size_checked: bool
    names: tuple[str, ...]
    picture: NDArray[np.uint8] | None
    found_px: Array


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def load_intrinsics(path: Path) -> Intrinsics:
    """Intrinsics from a YAML file: fx, fy, cx, cy and optionally distortion (OpenCV's order)."""
    try:
        d = yaml_load(filename=str(_there(path)))
        numbers = [float(d[key]) for key in ("fx", "fy", "cx", "cy")]
        distortion = np.array(d.get("distortion") or [0.0] * 5, dtype=float)
    except TabletDataError:
        raise
    except Exception as error:  # unreadable in any way: the same sentence
        raise TabletDataError(
            f"'{path.name}' must hold fx, fy, cx and cy in pixels (and distortion, where known)."
        ) from error
    if not np.isfinite([*numbers, *distortion]).all() or min(numbers[:2]) <= 0.0:
        raise TabletDataError(f"'{path.name}' holds a focal length that is not positive, or a value that is no number.")
    return Intrinsics(np.array(numbers[:2]), np.array(numbers[2:]), distortion)


def load_visit(
    touches: Path,
    poses: Path,
    camera: Path,
    *,
    image: Path | None = None,
    seen: Path | None = None,
    look: Look = "rings",
    tip_radius_m: float = 0.0,
) -> WristVisit:
    """Touches of the page's CSV, with the flange's poses and what the camera saw (an image, or positions in a CSV).

    ``poses``: landmark,x,y,z,qw,qx,qy,qz of X_BF in metres at each touch, and one row whose landmark is `camera` for where
    the image was taken. Of a landmark touched twice the last touch counts. Landmarks without a pose are left out.
    ``tip_radius_m`` of a round pen tip. Raises TabletDataError with the file and what to change, LandmarksNotFound for the image.
    """
    rows = {int(float(r["landmark"])): r for r in _table(touches, TOUCH_COLUMNS)}
    pose_rows = {r["landmark"].strip(): r for r in _table(poses, POSE_COLUMNS)}
    if CAMERA_ROW not in pose_rows:
        raise TabletDataError(
            f"'{poses.name}' lacks the row '{CAMERA_ROW}': the flange's pose when the image was taken."
        )
    used = [k for k in sorted(rows) if str(k) in pose_rows]
    if not used:
        raise TabletDataError(f"No landmark of '{touches.name}' has a pose in '{poses.name}'; both count from 0.")
    number = {k: {c: _number(rows[k][c], touches, c) for c in TOUCH_COLUMNS} for k in rows}
    pitch = {number[k]["mm_per_px"] for k in used}
    if len(pitch) != 1 or min(pitch) <= 0.0:
        raise TabletDataError(f"'{touches.name}' mixes sizes (mm_per_px); touch all landmarks at one size of the page.")
    scale = 1e-3 * pitch.pop()
    landmark = scale * np.array([[number[k]["landmark_x_px"], number[k]["landmark_y_px"]] for k in used])
    touched = scale * np.array([[number[k]["touch_x_px"], number[k]["touch_y_px"]] for k in used])
    intrinsics = load_intrinsics(camera)
    picture, found = None, np.zeros((0, 2))
    if seen is not None:
        positions = {int(float(r["landmark"])): r for r in _table(seen, SEEN_COLUMNS)}
        missing = [k for k in used if k not in positions]
        if missing:
            raise TabletDataError(f"'{seen.name}' lacks landmark {missing[0]}.")
        uv = np.array([[_number(positions[k][c], seen, c) for c in ("u", "v")] for k in used])
    elif image is not None:
        picture, found = _in_image(image, number, look)
        uv = found[used]
    else:
        raise TabletDataError("Give the camera's image (--image) or where the landmarks are in it (--seen).")
    corner = landmark.min(axis=0)
    data = WristTouches(
        X_BF=tuple(_flange_pose(pose_rows[str(k)], poses) for k in used),
        touched_m=touched - corner,
        landmark_m=landmark - corner,
        views=((_flange_pose(pose_rows[CAMERA_ROW], poses), intrinsics.rays(uv)),),
        focal_px=float(intrinsics.focal_px.mean()),
        tip_radius_m=tip_radius_m,
    )
    checked = all(rows[k].get("size_checked", "1").strip() != "0" for k in used)
    return WristVisit(data, checked, tuple(str(k) for k in used), picture, found)


def _in_image(path: Path, number: Mapping[int, Mapping[str, float]], look: Look) -> tuple[NDArray[np.uint8], Array]:
    """The image (h, w) and positions (n, 2) of all landmarks of the page, whose columns and rows their coordinates tell."""
    picture = cv2.imread(str(_there(path)), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise TabletDataError(f"'{path.name}' is no image that can be read.")
    columns = len({round(n["landmark_x_px"], 1) for n in number.values()})
    rows = len({round(n["landmark_y_px"], 1) for n in number.values()})
    if columns * rows != len(number) or set(number) != set(range(len(number))):
        raise TabletDataError("The landmarks touched are not the page's whole grid; touch all, or give --seen.")
    grey = np.asarray(picture, dtype=np.uint8)
    return grey, find_landmarks(grey, columns, rows, look)


def _flange_pose(row: Mapping[str, str], path: Path) -> RigidTransform:
    x, y, z, *q = (_number(row[c], path, c) for c in POSE_COLUMNS[1:])
    norm = float(np.linalg.norm(q))
    if abs(norm - 1.0) > 1e-2:
        raise TabletDataError(f"'{path.name}': the quaternion of '{row['landmark']}' has the length {norm:.3g}, not 1.")
    if max(abs(x), abs(y), abs(z)) > _FARTHEST_M:
        raise TabletDataError(
            f"'{path.name}' must be in metres; '{row['landmark']}' is {max(abs(x), abs(y), abs(z)):.0f} away."
        )
    return RigidTransform(RotationMatrix(Quaternion(np.array(q) / norm)), [x, y, z])


def _table(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """The rows of a CSV file that has at least these columns."""
    try:
        text = _there(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise TabletDataError(f"'{path.name}' is no CSV text.") from error
    reader = csv.DictReader(text.splitlines())
    missing = [c for c in columns if c not in (reader.fieldnames or ())]
    if missing:
        raise TabletDataError(f"'{path.name}' lacks the column{'s' if len(missing) > 1 else ''} {', '.join(missing)}.")
    rows = [row for row in reader if any((v or "").strip() for v in row.values() if isinstance(v, str))]
    for row in rows:
        if any(row.get(c) is None for c in columns):
            raise TabletDataError(f"'{path.name}' has a row with too few columns.")
        if "landmark" in columns and row["landmark"].strip() != CAMERA_ROW:
            _number(row["landmark"], path, "landmark")
    return rows


def _number(text: str, path: Path, column: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise TabletDataError(f"'{path.name}': '{text}' in the column {column} is no number.")
    return value


def _there(path: Path) -> Path:
    if not path.is_file():
        raise TabletDataError(f"There is no file '{path}'.")
    return path
