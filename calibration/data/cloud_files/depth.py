"""Turn depth images and depth maps into organised points by the camera's intrinsics.

Images are PNG, TIFF or NPY, maps are in NPZ files; a file beside them may state the intrinsics.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.camera_file import find_camera
from weldcal.calibration.data.cloud_files.body import CloudError, CloudForm
from weldcal.models.array_files import npy_shape, png_depth, read_raw_image
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import MOST_POINTS, expansion_limit, file_size

IMAGES = (".png", ".tif", ".tiff")
"""Endings of depth images."""
_PIXEL_BITS = 16
_STEMS = (
    "camera_info", "depth_camera_info", "depth_intrinsics", "intrinsics", "intrinsic", "camera_intrinsics",
    "camera_intrinsic",
    "camera-intrinsics", "intrinsic_depth", "camera_matrix", "camera", "depth_camera", "depth", "k", "cam_k",
    "camchain", "scene_camera",
)  # fmt: skip
_TREES = (".yaml", ".yml", ".json", ".xml")
_TEXTS = (".txt", ".csv")
_ADVICE = "write 'intrinsics: {fx: ..., fy: ..., cx: ..., cy: ...}' (pixels) into dataset.yaml"


@dataclass(frozen=True, kw_only=True)
class DepthIntrinsics:
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
    """Return whether a file's name says that it holds a camera's intrinsics."""
    return path.stem.lower() in _STEMS and path.suffix.lower() in (*_TREES, *_TEXTS)


def find_intrinsics(*folders: Path) -> DepthIntrinsics | None:
    """Return the camera of the first of these folders that holds a file of one; None where none does.

    Raises:
        CloudError: a file of that name cannot be read, or holds no intrinsics.
    """
    for folder in dict.fromkeys(folders):
        files = {p.name.lower(): p for p in sorted(folder.iterdir()) if p.is_file()} if folder.is_dir() else {}
        for stem in _STEMS:
            for ending in (*_TREES, *_TEXTS):
                path = files.get(stem + ending)
                if path is not None and (found := _stated(path)) is not None:
                    return found
    return None


def checked_intrinsics(values: tuple[float, ...], source: str) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy where they can be a camera's. Raises CloudError."""
    fx, fy, cx, cy = values
    if not (np.isfinite(values).all() and min(fx, fy) > 0.0 and max(map(abs, values)) < 1e6):
        raise CloudError(
            f"The intrinsics in {source} are not usable (fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}): focal lengths are"
            " positive, in pixels."
        )
    return fx, fy, cx, cy


def intrinsics_of(
    found: DepthIntrinsics | None, shape: tuple[int, int], name: str
) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy for a depth image (height, width).

    Raises:
        CloudError: no camera is known, its images have another size, or a lens distortion. The sentence says what to
            write where.
    """
    height, width = shape
    if found is None:
        raise CloudError(
            f"{name} is a depth image of {width} x {height} pixels, but the intrinsics of its camera are missing. To"
            f" give them, {_ADVICE}, or put the camera's file (camera_info.yaml of ROS, OpenCV or Kalibr) beside the"
            " images."
        )
    if found.size not in ((0, 0), (width, height)):
        raise CloudError(
            f"{name} has {width} x {height} pixels, and {found.source.name} states a camera of {found.size[0]} x"
            f" {found.size[1]}: give the camera of the depth images, or {_ADVICE}."
        )
    if not found.straight:
        raise CloudError(
            f"{found.source.name} states a lens distortion, and points follow from rectified depth images only: where"
            f" {name} is rectified, {_ADVICE}."
        )
    return found.values


def _stated(path: Path) -> DepthIntrinsics | None:
    """Return the camera in a file; None where it holds none."""
    try:
        found = find_camera(path)
    except InputError as problem:
        raise CloudError(str(problem)) from problem
    if found is None:
        return None
    K, straight = found.K, not found.distortion.any()
    values = checked_intrinsics((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), path.name)
    return DepthIntrinsics(values=values, source=path, size=found.size or (0, 0), straight=straight)


def may_be_depth(path: Path) -> bool:
    """Return whether an image can be a depth image: a PNG of one channel with 16 bits, or a TIFF."""
    ending = path.suffix.lower()
    return ending in IMAGES and (ending != ".png" or png_depth(path) == (_PIXEL_BITS, 1))


def is_depth(path: Path) -> bool:
    """Return whether a cloud's file is a depth image, whose points need the camera's intrinsics."""
    if path.suffix.lower() != ".npy":
        return path.suffix.lower() in IMAGES
    try:
        return _flat(npy_shape(path))
    except InputError:
        return False


def camera_of(path: Path, form: CloudForm) -> DepthIntrinsics | None:
    """Return the camera of a depth image: as stated, else of a file beside it or in the dataset's folder.

    Raises CloudError.
    """
    if form.intrinsics is not None:
        return DepthIntrinsics(values=checked_intrinsics(form.intrinsics, "dataset.yaml"), source=Path("dataset.yaml"))
    return find_intrinsics(path.parent, *(() if form.folder is None else (form.folder,)))


def read_depth_image(path: Path, form: CloudForm) -> Array:
    """Points (H, W, 3) of an image, NaN where it holds no depth. Raises CloudError, InputError."""
    pixels = read_raw_image(path)
    if pixels.ndim != 2:
        raise CloudError(
            f"{path.name} is a picture of {pixels.shape[2]} channels, and a depth image has one: give the depth image,"
            " or a cloud."
        )
    if pixels.dtype.itemsize * 8 < _PIXEL_BITS:
        raise CloudError(
            f"{path.name} has 8 bits a pixel, too coarse for depth: export depth images with 16 bits, or as"
            " floating-point numbers."
        )
    return depth_points(path, pixels, form)


def depth_points(path: Path, pixels: Any, form: CloudForm) -> Array:
    """Points (H, W, 3) of the pixels (H, W) of a depth image: depth along the optical axis.

    0, NaN and 65535 hold none.
    """
    if pixels.dtype.kind not in "fui":
        raise CloudError(f"{path.name} holds {pixels.dtype}, and depth is 16-bit or floating-point numbers.")
    check_pixels(path, pixels.size)
    values = intrinsics_of(camera_of(path, form), pixels.shape, path.name)
    depth = pixels.astype(float)
    if pixels.dtype == np.uint16:
        depth[pixels == np.iinfo(np.uint16).max] = np.nan
    return back_projected(depth * form.depth_scale if form.depth_scale else depth, values)


def is_depth_array(array: Any) -> bool:
    """Return whether an array of an NPY file is a depth image: two sides, neither of which is the three coordinates."""
    return _flat(array.shape)


def _flat(shape: tuple[int, ...]) -> bool:
    return len(shape) == 2 and shape[1] > 4 and shape[0] > 4


def check_pixels(path: Path, pixels: int) -> None:
    """Refuse more pixels than points are read, or than a file of its size may hold. Raises CloudError."""
    if pixels > MOST_POINTS or 24 * pixels > expansion_limit(file_size(path)):
        raise CloudError(f"The depth map in {path.name} has {pixels} pixels, too many for a file of its size.")


def back_projected(depth: Array, intrinsics: tuple[float, float, float, float]) -> Array:
    """Points (H, W, 3) in the unit of the depths (H, W) along the optical axis.

    NaN where a depth is no positive number.
    """
    fx, fy, cx, cy = intrinsics
    points = np.empty((*depth.shape, 3))
    z = points[:, :, 2]
    z[:] = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    # in place: an image of the largest scanner must not be in memory many times over
    np.divide(np.multiply(z, np.arange(depth.shape[1]) - cx, out=points[:, :, 0]), fx, out=points[:, :, 0])
    np.divide(np.multiply(z, (np.arange(depth.shape[0]) - cy)[:, None], out=points[:, :, 1]), fy, out=points[:, :, 1])
    return points
