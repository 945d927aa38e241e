"""Find the pictures and the camera file of a folder, and load pictures in grey."""

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.camera_file import CameraFile, read_camera
from weldcal.calibration.data.poses.names import natural, number_of
from weldcal.calibration.errors import DatasetError

ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
_OTHER = re.compile(
    r"(?i)(depth|disparity|mask|detected|corners|result|output|annotated|debug|visuali[sz]ation|overlay|undistort|rectified)"
)
_CAMERA = re.compile(
    r"(?i)^(camera|cam|camera_?info|camera_?(params?|parameters|matrix|calib\w*|intrinsics?)|camchain.*|.*intrinsics?.*|.*ost|calibration|calib"
    r"|sensor|param|params)$"
)
_CAMERA_ENDINGS = (".yaml", ".yml", ".xml", ".json", ".txt", ".npz")


def picture_files(folder: Path, named: str | None = None) -> list[Path]:
    """The pictures of one kind in a folder, two levels deep, in the natural order of their names.

    Args:
        named: part of the path of the right ones, where the user states it.

    Raises:
        DatasetError: there are none, or several kinds.
    """
    groups: dict[tuple[Path, str, str], list[Path]] = {}
    for path in sorted(p for pattern in ("*", "*/*", "*/*/*") for p in folder.glob(pattern)):
        inside = path.relative_to(folder).as_posix()
        if path.suffix.lower() not in ENDINGS or not path.is_file() or path.name.startswith((".", "_")):
            continue
        if named is not None and named not in inside:
            continue
        stem = re.sub(r"\d+$", "", path.stem) if number_of(path.stem) is not None else ""
        groups.setdefault((path.parent, stem, path.suffix.lower()), []).append(path)
    wanted = [g for g in groups.values() if named is not None or not _OTHER.search(g[0].relative_to(folder).as_posix())]
    if not wanted:
        raise DatasetError(
            f"'{folder.name}' holds no pictures ({', '.join(ENDINGS)}); put them beside the robot's poses."
        )
    by_place: dict[tuple[Path, str], list[list[Path]]] = {}
    for (parent, stem, _), files in groups.items():
        if files in wanted:
            by_place.setdefault((parent, stem), []).append(files)
    # beside a picture, a TIFF of the same name is a depth image
    kinds = [min(g, key=lambda f: (f[0].suffix.lower() in (".tif", ".tiff"), -len(f))) for g in by_place.values()]
    most = max(len(k) for k in kinds)
    kinds = [k for k in kinds if 2 * len(k) > most]
    if len(kinds) > 1 and len({k[0].parent for k in kinds}) == 1 and all(len(k) == 1 for k in kinds):
        kinds = [[k[0] for k in kinds]]
    if len(kinds) > 1:
        colour = [
            k for k in kinds if re.search(r"(?i)(rgb|colou?r|left|image|img)", k[0].relative_to(folder).as_posix())
        ]
        kinds = colour if len(colour) == 1 else kinds
    if len(kinds) > 1:
        names = ", ".join(repr(k[0].relative_to(folder).as_posix()) for k in kinds[:4])
        raise DatasetError(
            f"'{folder.name}' holds several kinds of pictures ({names}): name the right ones with --camera-poses, by a part of their path."
        )
    return sorted(kinds[0], key=lambda p: natural(p.name))


def camera_in(folder: Path) -> tuple[Path, CameraFile] | None:
    """The file of a folder that is named as a camera's and states one, or None."""
    found = [p for pattern in ("*", "*/*") for p in sorted(folder.glob(pattern)) if p.is_file()]
    for path in found:
        if path.suffix.lower() in _CAMERA_ENDINGS and _CAMERA.match(path.stem):
            try:
                return path, read_camera(path)
            except DatasetError:
                continue
    return None


def load_grey(path: Path) -> NDArray[np.uint8] | None:
    """A picture in 8 bits of grey; None where it cannot be read."""
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError:
        return None
    if not data.size:
        return None
    try:
        image = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None
    if image is None:
        return None
    if image.dtype != np.uint8:
        low, high = np.percentile(image, [0.5, 99.5])
        image = np.clip((image.astype(float) - low) * 255.0 / max(float(high - low), 1.0), 0, 255).astype(np.uint8)
    return np.asarray(image, dtype=np.uint8)
