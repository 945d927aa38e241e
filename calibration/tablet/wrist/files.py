"""Reads a tablet visit: the page's CSV, robot poses and an image."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.tables import Row
from weldcal.calibration.tablet.detection import Look
from weldcal.calibration.tablet.errors import TabletDataError
from weldcal.calibration.tablet.intrinsics import Intrinsics, load_intrinsics
from weldcal.calibration.tablet.page_match import check_page_match
from weldcal.calibration.tablet.tables import landmark, number, read_table
from weldcal.calibration.tablet.wrist.fit import WristTouches
from weldcal.calibration.tablet.wrist.page_grid import find_page
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import sha256
from weldcal.models.images import read_grey_image

TOUCH_COLUMNS = ("landmark", "landmark_x_px", "landmark_y_px", "touch_x_px", "touch_y_px", "mm_per_px")
POSE_COLUMNS = ("landmark", "x", "y", "z", "qw", "qx", "qy", "qz")
SEEN_COLUMNS = ("landmark", "u", "v")
CAMERA_ROW = "camera"
_FARTHEST_M = 5.0  # of a wrist from its base: beyond it the file is in millimetres
_OFF_CENTRE = 0.12  # of the image's size: a principal point farther from its middle is told
_NAMES_OF_CAMERA = (CAMERA_ROW, "image", "picture")


@dataclass(frozen=True)
class WristVisit:
    """Touches for fit_wrist, warnings about the files, the landmarks' names, and the image (h, w) with where all landmarks of
    the page were found in it (n, 2) px, where there is one."""

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
    camera: Path,
    *,
    image: Path | None = None,
    seen: Path | None = None,
    look: Look = "rings",
    tip_radius_m: float = 0.0,
) -> WristVisit:
    """Touches of the page's CSV, with the flange's poses and what the camera saw (an image, or positions in a CSV).

    ``poses``: landmark,x,y,z,qw,qx,qy,qz of X_BF in metres at each touch, and one row whose landmark is `camera` for where
    the image was taken. Of a landmark touched twice the last touch and the last pose count. Landmarks without a pose are left
    out and named in the warnings. ``tip_radius_m`` of a round pen tip. Raises TabletDataError with the file and what to change
    (touches that are not at their landmarks too), LandmarksNotFound for the image.
    """
    rows = {landmark(r, touches): r for r in read_table(touches, TOUCH_COLUMNS)}
    if not rows:
        raise TabletDataError(f"'{touches.name}' holds no touch.")
    X_camera, pose_of = _poses(poses)
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
    intrinsics = load_intrinsics(camera)
    picture, found = None, np.zeros((0, 2))
    if seen is not None:
        uv = _seen(seen, used)
    elif image is not None:
        picture = _picture(image)
        found = find_page(picture, shown, look)
        uv = found[used]
    else:
        raise TabletDataError("Give the camera's image (--image) or where the landmarks are in it (--seen).")
    corner = landmarks.min(axis=0)
    data = WristTouches(
        X_BF=tuple(pose_of[k] for k in used),
        touched_m=touched - corner,
        landmark_m=landmarks - corner,
        views=((X_camera, intrinsics.rays(uv)),),
        focal_px=float(intrinsics.focal_px.mean()),
        tip_radius_m=tip_radius_m,
    )
    told = (*odd, *_warnings(rows, used, poses, intrinsics, picture, camera))
    return WristVisit(data, told, names, picture, found)


def _poses(path: Path) -> tuple[RigidTransform, dict[int, RigidTransform]]:
    """The flange where the image was taken, and at each landmark."""
    found: dict[int, RigidTransform] = {}
    X_camera: RigidTransform | None = None
    for row in read_table(path, POSE_COLUMNS):
        if row["landmark"].lower() in _NAMES_OF_CAMERA:
            X_camera = _flange_pose(row, path)
        else:
            found[landmark(row, path)] = _flange_pose(row, path)
    if X_camera is None:
        raise TabletDataError(
            f"'{path.name}' lacks the row '{CAMERA_ROW}': the flange's pose when the image was taken."
        )
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


def _warnings(
    rows: Mapping[int, Row],
    used: list[int],
    poses: Path,
    intrinsics: Intrinsics,
    picture: NDArray[np.uint8] | None,
    camera: Path,
) -> tuple[str, ...]:
    found = []
    if any(rows[k].get("size_checked", "1") == "0" for k in used):
        found.append("The page's size was not checked with a card: lengths may be wrong by some per cent.")
    without = [k for k in sorted(rows) if k not in used]
    if without:
        found.append(f"Excluded, without a pose in '{poses.name}': landmark {', '.join(map(str, without))}.")
    if picture is not None:
        size = np.array(picture.shape[::-1])
        off = np.abs(intrinsics.centre_px - 0.5 * (size - 1)) / size
        if off.max() > _OFF_CENTRE:
            found.append(
                f"The image has {size[0]} by {size[1]} pixels, and the principal point of '{camera.name}' lies at "
                f"{intrinsics.centre_px[0]:.0f}, {intrinsics.centre_px[1]:.0f}: these intrinsics seem to belong to images of another "
                "size, or turned."
            )
    return tuple(found)


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
