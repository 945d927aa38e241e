"""Turns depth images (PNG, TIFF, NPY) and depth maps of NPZ files into organised points by the camera's intrinsics."""

from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.cloud_files.body import CloudError
from weldcal.calibration.data.cloud_files.form import CloudForm
from weldcal.calibration.data.cloud_files.intrinsics import (
    Intrinsics,
    checked_intrinsics,
    find_intrinsics,
    intrinsics_of,
)
from weldcal.models.array_files import npy_shape, png_depth, read_raw_image
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import MOST_POINTS, expansion_limit, file_size

IMAGES = (".png", ".tif", ".tiff")
"""Endings of depth images."""
_PIXEL_BITS = 16


def may_be_depth(path: Path) -> bool:
    """Whether an image can be a depth image: a PNG of one channel with 16 bits, or a TIFF."""
    ending = path.suffix.lower()
    return ending in IMAGES and (ending != ".png" or png_depth(path) == (_PIXEL_BITS, 1))


def is_depth(path: Path) -> bool:
    """Whether a cloud's file is a depth image, whose points need the camera's intrinsics."""
    if path.suffix.lower() != ".npy":
        return path.suffix.lower() in IMAGES
    try:
        return _flat(npy_shape(path))
    except InputError:
        return False


def camera_of(path: Path, form: CloudForm) -> Intrinsics | None:
    """The camera of a depth image: as stated, else of a file beside it or in the dataset's folder. Raises CloudError."""
    if form.intrinsics is not None:
        return Intrinsics(values=checked_intrinsics(form.intrinsics, "dataset.yaml"), source=Path("dataset.yaml"))
    return find_intrinsics(path.parent, *(() if form.folder is None else (form.folder,)))


def read_depth_image(path: Path, form: CloudForm) -> Array:
    """Points (H, W, 3) of an image, NaN where it holds no depth. Raises CloudError, InputError."""
    pixels = read_raw_image(path)
    if pixels.ndim != 2:
        raise CloudError(
            f"{path.name} is a picture of {pixels.shape[2]} channels, and a depth image has one: give the depth image, or a cloud."
        )
    if pixels.dtype.itemsize * 8 < _PIXEL_BITS:
        raise CloudError(
            f"{path.name} has 8 bits a pixel, too coarse for depth: export depth images with 16 bits, or as floating-point numbers."
        )
    return depth_points(path, pixels, form)


def depth_points(path: Path, pixels: Any, form: CloudForm) -> Array:
    """Points (H, W, 3) of the pixels (H, W) of a depth image: depth along the optical axis; 0, NaN and 65535 hold none."""
    if pixels.dtype.kind not in "fui":
        raise CloudError(f"{path.name} holds {pixels.dtype}, and depth is 16-bit or floating-point numbers.")
    check_pixels(path, pixels.size)
    values = intrinsics_of(camera_of(path, form), pixels.shape, path.name)
    depth = pixels.astype(float)
    if pixels.dtype == np.uint16:
        depth[pixels == np.iinfo(np.uint16).max] = np.nan
    return back_projected(depth * form.depth_scale if form.depth_scale else depth, values)


def is_depth_array(array: Any) -> bool:
    """Whether an array of an NPY file is a depth image: two sides, neither of which is the three coordinates."""
    return _flat(array.shape)


def _flat(shape: tuple[int, ...]) -> bool:
    return len(shape) == 2 and shape[1] > 4 and shape[0] > 4


def check_pixels(path: Path, pixels: int) -> None:
    """Refuse more pixels than points are read, or than a file of its size may hold. Raises CloudError."""
    if pixels > MOST_POINTS or 24 * pixels > expansion_limit(file_size(path)):
        raise CloudError(f"The depth map in {path.name} has {pixels} pixels, too many for a file of its size.")


def back_projected(depth: Array, intrinsics: tuple[float, float, float, float]) -> Array:
    """Points (H, W, 3) in the unit of the depths (H, W) along the optical axis; NaN where a depth is no positive number."""
    fx, fy, cx, cy = intrinsics
    points = np.empty((*depth.shape, 3))
    z = points[:, :, 2]
    z[:] = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    # in place: an image of the largest scanner must not be in memory many times over
    np.divide(np.multiply(z, np.arange(depth.shape[1]) - cx, out=points[:, :, 0]), fx, out=points[:, :, 0])
    np.divide(np.multiply(z, (np.arange(depth.shape[0]) - cy)[:, None], out=points[:, :, 1]), fy, out=points[:, :, 1])
    return points
