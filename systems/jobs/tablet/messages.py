"""Messages of the tablet job: a picture of the wrist camera, a touch, and the ground truth of a simulation."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.models.arrays import Array
from weldcal.systems.messages import Message


@dataclass(frozen=True, eq=False)
class WristPicture(Message):
    """One picture: grey (h, w) uint8 and depth (h, w) m with its noise; `sequence` 0 before the first."""

    sequence: int = 0
    capture_time: float = -np.inf
    grey: NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 0), dtype=np.uint8))
    depth_m: Array = field(default_factory=lambda: np.empty((0, 0)))


@dataclass(frozen=True, eq=False)
class TabletTouch(Message):
    """One touch as the page records it: position (2,) px from the first landmark, to a tenth; `sequence` 0 before the first."""

    sequence: int = 0
    time: float = -np.inf
    position_px: Array = field(default_factory=lambda: np.full(2, np.nan))
    down: bool = False


@dataclass(frozen=True, eq=False)
class TabletTruth(Message):
    """Ground truth of the simulation: camera and pen tip (its centre, at rest) on the flange, tablet in the base."""

    X_FC: RigidTransform
    p_FP: Array
    X_BT: RigidTransform
