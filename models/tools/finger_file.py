"""The file that `weldcal finger calibrate` writes, and pictures rectified by it.

Those of a pinhole camera without distortion.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array
from weldcal.models.documents import read_document
from weldcal.models.errors import InputError

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class FingerFile:
    """Hold what a finger file states.

    Picture size, K (3, 3) px, OpenCV's distortion coefficients, and the tag's measured side in m (None: not measured).
    """

    width: int
    height: int
    K: Array
    distortion: Array
    tag_size_m: float | None = None

    @property
    def focal_px(self) -> float:
        """Focal length of the rectified pictures, px."""
        return float(0.5 * (self.K[0, 0] + self.K[1, 1]))

    def rectifier(self) -> Callable[[NDArray[np.uint8]], NDArray[np.uint8]]:
        """Maps a picture to that of a pinhole camera of `focal_px` with its principal point in the middle."""
        middle = [(self.width - 1) / 2.0, (self.height - 1) / 2.0]
        ideal = np.array([[self.focal_px, 0.0, middle[0]], [0.0, self.focal_px, middle[1]], [0.0, 0.0, 1.0]])
        size = (self.width, self.height)
        maps = cv2.initUndistortRectifyMap(self.K, self.distortion, np.eye(3), ideal, size, cv2.CV_32FC1)

        def rectify(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
            return np.asarray(
                cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8
            )

        return rectify


@lru_cache(maxsize=8)
def read_finger_file(path: Path) -> FingerFile:
    """Return the calibration of a finger. Raises InputError where the file is not one."""
    document = read_document(path)
    try:
        if document["schema"] != SCHEMA:
            raise ValueError(document["schema"])
        camera, tag = document["camera"], document.get("tag")
        fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
        distortion = np.array([float(v) for v in camera["distortion"]])
        found = FingerFile(
            int(camera["width"]),
            int(camera["height"]),
            np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
            distortion,
            None if tag is None else 1e-3 * float(tag["size_mm"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"'{path}' is no finger calibration: make one with weldcal finger calibrate.") from error
    if not (np.isfinite(found.K).all() and np.isfinite(distortion).all() and min(fx, fy) > 0.0):
        raise InputError(f"'{path}' holds numbers that no camera has: calibrate the finger again.")
    return found
