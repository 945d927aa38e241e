"""Flange poses of a profiler calibration as arrays, with checks of their motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weldcal.calibration.geometry.se3 import angle_of, exp_rotation, skew
from weldcal.models.errors import InputError

Floats = NDArray[np.float64]

ORTHONORMAL = 1e-6  # a choice: six printed digits of a matrix leave half of it
KEPT = 3  # different optima that are polished
SAME_RAD = 0.02  # a choice: nearer ends of descents are one optimum; half only polishes the same one twice
SAME_ROTATION_RAD = 1e-4  # orientations of a group differ by less: a robot holds one to a hundredth of this


@dataclass(frozen=True, eq=False)
class FlangePoses:
    """Flange poses X_BF as arrays: R_BF (n, 3, 3), p_BF (n, 3) m."""

    rotation: Floats
    translation: Floats

    def __len__(self) -> int:
        return len(self.translation)

    def __getitem__(self, chosen: NDArray[np.intp] | NDArray[np.bool_] | slice) -> FlangePoses:
        return FlangePoses(self.rotation[chosen], self.translation[chosen])

    @staticmethod
    def checked(rotation: ArrayLike, translation: ArrayLike) -> FlangePoses:
        """Arrays that are poses.

        Args:
            rotation: (n, 3, 3) R_BF; translation: (n, 3) p_BF in m.

        Raises:
            InputError: wrong shapes, not finite, or a rotation that is not orthonormal to 1e-6.
        """
        R, p = np.asarray(rotation, float), np.asarray(translation, float)
        if R.ndim != 3 or R.shape[1:] != (3, 3) or p.shape != (len(R), 3):
            raise InputError(
                f"Flange poses need rotations (n, 3, 3) and translations (n, 3), not {R.shape} and {p.shape}."
            )
        if not len(R):
            raise InputError("There is no flange pose: take scans in several.")
        if not (np.isfinite(R).all() and np.isfinite(p).all()):
            raise InputError("A flange pose holds a number that is not finite: leave that sample out.")
        off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).reshape(len(R), -1).max(axis=1, initial=0.0)
        bad = np.flatnonzero((off > ORTHONORMAL) | (np.linalg.det(R) < 0.0))
        if bad.size:
            raise InputError(f"The rotation of pose {bad[0]} is not a rotation matrix: check its axes and its numbers.")
        return FlangePoses(R, p)


def checked_points(points: ArrayLike, count: int) -> Floats:
    """One profile point [x, z] (n, 2) m for each pose.

    Raises:
        InputError: another shape, or not finite.
    """
    p = np.asarray(points, float)
    if p.shape != (count, 2):
        raise InputError(f"{count} poses need {count} profile points [x, z], not an array of shape {p.shape}.")
    if not np.isfinite(p).all():
        raise InputError("A profile point is not finite: leave that sample out.")
    return p


def rotation_groups(poses: FlangePoses) -> NDArray[np.intp]:
    """Return a number (n,) for each pose: poses of one orientation have the same, in the order in which they come."""
    R = poses.rotation
    group = np.full(len(R), -1, dtype=np.intp)
    found = 0
    for k in range(len(R)):
        if group[k] >= 0:
            continue
        group[(angle_of(R[k].T @ R) < SAME_ROTATION_RAD) & (group < 0)] = found
        found += 1
    return group


def rotation_axes_spread(rotation: Floats) -> float:
    """Second singular value over the first of the axes of all turns from the first orientation.

    0 where all share one axis.
    """
    turns = np.array([_axis_times_sine(rotation[0].T @ R) for R in rotation[1:]])
    if len(turns) < 2:
        return 0.0
    s = np.linalg.svd(turns, compute_uv=False)
    return float(s[1] / s[0]) if s[0] > 0.0 else 0.0


def _axis_times_sine(R: Floats) -> Floats:
    return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


def turned(R: Floats, w: Floats) -> Floats:
    """R exp(w) for stacks of rotations (..., 3, 3) and rotation vectors (..., 3) in their own frame."""
    return np.asarray(R @ exp_rotation(w))


def distinct(R: Floats, order: NDArray[np.intp]) -> list[int]:
    """Return the first few of rotations (m, 3, 3), taken in that order, that differ from each other."""
    chosen: list[int] = []
    for k in order:
        if len(chosen) < KEPT and all(angle_of(R[k].T @ R[j]) > SAME_RAD for j in chosen):
            chosen.append(int(k))
    return chosen


def times_own(rows: Floats, M: Floats) -> Floats:
    """Row vectors (m, n, 3), the nth of each of m candidates times its own matrix M (n, 3, k)."""
    return np.asarray(np.swapaxes(np.swapaxes(rows, 0, 1) @ M, 0, 1))


def left_jacobian(w: Floats) -> Floats:
    """J (3, 3) with exp(w + d) = exp(J d) exp(w) for a small d."""
    angle, K = float(np.linalg.norm(w)), skew(w)
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * K)
    return np.asarray(np.eye(3) + (1 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * K @ K)
