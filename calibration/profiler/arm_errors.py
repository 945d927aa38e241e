"""A robot that is a little other than its drawing: joint offsets and sag under gravity, as a calibration may estimate them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.errors import InputError

# Joint 1 turns the base and joint 6 the flange: their offsets are part of other unknowns.
OFFSET_JOINTS = (1, 2, 3, 4)
SAG_JOINTS = (1, 2)


@dataclass(frozen=True, eq=False)
class DhArm:
    """A six-axis arm by standard Denavit-Hartenberg rows (6, 4): a m, alpha rad, d m, theta offset rad; base z upwards."""

    rows: Floats

    @staticmethod
    def checked(rows: ArrayLike) -> DhArm:
        """Rows that are an arm.

        Raises:
            InputError: not (6, 4), or not finite.
        """
        dh = np.asarray(rows, float)
        if dh.shape != (6, 4) or not np.isfinite(dh).all():
            raise InputError(f"An arm's table has six finite rows [a, alpha, d, theta], not the shape {dh.shape}.")
        return DhArm(dh)

    @staticmethod
    def of(arm: ArmModel) -> DhArm:
        """A UR arm's table, by the nominal lengths of its model."""
        d, right = arm.dh, 0.5 * np.pi
        return DhArm(
            np.array(
                [
                    [0.0, right, d.d1, 0.0],
                    [d.a2, 0.0, 0.0, 0.0],
                    [d.a3, 0.0, 0.0, 0.0],
                    [0.0, right, d.d4, 0.0],
                    [0.0, -right, d.d5, 0.0],
                    [0.0, 0.0, d.d6, 0.0],
                ]
            )
        )

    def frames(self, q: Floats) -> Floats:
        """Homogeneous poses (n, 7, 4, 4) of the base and of the frames after each joint, for joints (n, 6) rad."""
        out = np.empty((len(q), 7, 4, 4))
        out[:, 0] = np.eye(4)
        for k, (a, alpha, d, offset) in enumerate(self.rows):
            c, s, ca, sa = np.cos(q[:, k] + offset), np.sin(q[:, k] + offset), np.cos(alpha), np.sin(alpha)
            A = np.zeros((len(q), 4, 4))
            A[:, 0] = np.column_stack([c, -s * ca, s * sa, a * c])
            A[:, 1] = np.column_stack([s, c * ca, -c * sa, a * s])
            A[:, 2] = [0.0, sa, ca, d]
            A[:, 3, 3] = 1.0
            out[:, k + 1] = out[:, k] @ A
        return out

    def loads(self, q: Floats) -> Floats:
        """Horizontal lever (n, 2) m of the flange about the axes of joints 2 and 3: what gravity turns them by, but for a factor."""
        frames = self.frames(q)
        flange = frames[:, 6, :2, 3]
        radial = flange / np.maximum(np.linalg.norm(flange, axis=1, keepdims=True), 1e-9)
        return np.column_stack([np.einsum("ni,ni->n", flange - frames[:, k, :2, 3], radial) for k in SAG_JOINTS])

    def poses(self, q: Floats, offsets: Floats, sag: Floats, loads: Floats) -> FlangePoses:
        """Flange poses with offsets (4,) rad of joints 2 to 5 and sag (2,) rad/m of joints 2 and 3."""
        moved = np.array(q, float)
        moved[:, list(OFFSET_JOINTS)] += offsets
        moved[:, list(SAG_JOINTS)] += loads * sag
        X = self.frames(moved)[:, 6]
        return FlangePoses(X[:, :3, :3], X[:, :3, 3])
