"""Time stamps of the weld study: pictures and poses stamped a little wrong, and the pose looked up at a picture's stamp."""

from bisect import bisect_right
from collections import deque

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.tools.studies.weld.unknowns import World
from weldcal.welding.numerics import Array
from weldcal.welding.servo.state import DeflectionSample

_KEPT = 64  # poses: half a second


class Stamps:
    """Stamps poses and pictures as a world does; the servo's clock is the stamp of the newest pose."""

    def __init__(self, world: World, seed: int) -> None:
        self._world = world
        self._exact = not any((world.image_bias_s, world.image_jitter_s, world.pose_bias_s, world.pose_jitter_s))
        self._rng = np.random.default_rng((seed, 2))
        self._poses: deque[tuple[float, Array, Array]] = deque(maxlen=_KEPT)

    def pose(self, time: float, R: Array, p: Array) -> float:
        """Remember the pose of T (rotation (3,3), position (3,) m) at a true time s; return its stamp.

        A stamp is never earlier than the one before: a controller's clock runs on.
        """
        if self._exact:
            return time
        stamp = time + self._world.pose_bias_s + self._world.pose_jitter_s * float(self._rng.normal())
        if self._poses:
            stamp = max(stamp, self._poses[-1][0] + 1e-4)
        self._poses.append((stamp, R, p))
        return stamp

    def picture(self, taken: DeflectionSample) -> DeflectionSample:
        """The picture with its stamp, and with the pose that the poses' stamps give for that time; `pose` comes first."""
        if self._exact:
            return taken
        stamp = taken.capture_time + self._world.image_bias_s + self._world.image_jitter_s * float(self._rng.normal())
        return DeflectionSample(stamp, self._at(stamp), taken.deflection_T, taken.valid)

    def _at(self, stamp: float) -> RigidTransform:
        times = [t for t, _, _ in self._poses]
        if len(times) == 1:
            return RigidTransform(RotationMatrix(self._poses[0][1]), self._poses[0][2])
        k = min(max(bisect_right(times, stamp), 1), len(times) - 1)
        (t0, R0, p0), (t1, R1, p1) = self._poses[k - 1], self._poses[k]
        share = min(max((stamp - t0) / (t1 - t0), 0.0), 1.0)
        R = RotationMatrix.ProjectToRotationMatrix((1.0 - share) * R0 + share * R1)
        return RigidTransform(R, (1.0 - share) * p0 + share * p1)
