"""Frames with the flange found in them: centres, normals, their noise and the frames' times, as arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array


@dataclass(frozen=True, eq=False, kw_only=True)
class ObservedFrames:
    """N frames in the order of their arrival.

    ``arrival`` (N,) s on the robot's clock; ``device`` (N,) s on the scanner's own clock, NaN where a frame has none,
    or None; ``p_C`` (N, 3) m flange centre and ``n_C`` (N, 3) outward normal in the camera frame; ``covariance`` (N, 3,
    3) m^2 of the centre, ``normal_sigma`` (N,) rad an axis. ``slide`` (N, 3) m in the camera frame, or None: how a
    centre moves if the edges found lie one noise of the face below it (a rough face hides where its chamfer begins).
    """

    ids: tuple[str, ...]
    arrival: Array
    device: Array | None
    p_C: Array
    n_C: Array
    covariance: Array
    normal_sigma: Array
    slide: Array | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def pick(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> "ObservedFrames":
        """Some of the frames."""
        index = np.arange(len(self.ids))[which]
        return ObservedFrames(
            ids=tuple(self.ids[k] for k in index),
            arrival=self.arrival[index],
            device=None if self.device is None else self.device[index],
            p_C=self.p_C[index],
            n_C=self.n_C[index],
            covariance=self.covariance[index],
            normal_sigma=self.normal_sigma[index],
            slide=None if self.slide is None else self.slide[index],
        )
