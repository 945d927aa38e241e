"""States what the files of clouds do not say of themselves: intrinsics and scale of depth images, the meaning of
VIEWPOINT."""

from dataclasses import dataclass
from pathlib import Path

VIEWPOINTS = ("sensor", "world")
"""What VIEWPOINT of a PCD file means: the points are in the sensor's frame, or were moved by VIEWPOINT."""


@dataclass(frozen=True, kw_only=True)
class CloudForm:
    """What dataset.yaml states of its clouds.

    Attributes:
        intrinsics: fx, fy, cx, cy of depth images, pixels, with pixel centres at whole numbers; None: a file of the
            camera beside the images says it.
        depth_scale: length of one unit of a depth image in ``unit``; 0: one.
        viewpoint: one of VIEWPOINTS, or empty: a VIEWPOINT other than identity is refused.
        folder: the dataset's folder, where a file of the camera is looked for, too.
    """

    intrinsics: tuple[float, float, float, float] | None = None
    depth_scale: float = 0.0
    viewpoint: str = ""
    folder: Path | None = None
