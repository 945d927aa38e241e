"""Residuals of a tracked flange against the calibration, with their derivatives by a move, the clock and the scale."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.geometry.se3 import exp_rotation, skew
from weldcal.models.arrays import Array

MOVE, CLOCK, SCALE = slice(0, 6), 6, 7
SIZE = 8
"""Unknowns of a change: a move of the scanner [rotation; translation] in the base about the pivot, clock (s), scale."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedFrame:
    """A frame: robot time (s), the feature by the robot then, in B: centre (3,) m, outward normal (3,), their rates
    (m/s, 1/s); its fit.

    ``p_CR`` (3,) m and ``n_C`` (3,) in the camera frame, after the scanner's correction; ``covariance`` (3, 3) m^2 of
    the centre and ``normal_sigma`` rad per axis: noise of the fit.
    """

    id: str
    time: float
    p_BR: Array
    n_B: Array
    v_BR: Array
    turn_B: Array
    p_CR: Array
    n_C: Array
    covariance: Array
    normal_sigma: float


@dataclass(frozen=True, eq=False)
class Rows:
    """Residuals of n frames: times (n,), r (n, 5) [m m m rad rad] in B, their derivatives (n, 5, SIZE), covariances of
    the fits (n, 5, 5), and centres and normals (n, 3) in C. Two tilts are enough: the normal's third number follows."""

    times: Array
    residuals: Array
    derivatives: Array
    covariances: Array
    centers: Array
    normals: Array

    def __len__(self) -> int:
        return len(self.times)

    def part(self, which: slice | NDArray[np.intp] | NDArray[np.bool_]) -> "Rows":
        """Some of the frames."""
        return Rows(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def tracked_rows(X_BC: RigidTransform, pivot: Array, frames: Sequence[TrackedFrame]) -> Rows:
    """Residuals of frames (n) against a calibration: e = X_BC p_C - p_BR, and the tilt of R_BC n_C against the robot's
    normal.

    A scanner that moved by (a, b) about the pivot, X_BC' = Exp(a, b) X_BC, sees the flange where the old pose puts it
    at e = - a x (q - pivot) - b. A pose that is taken d seconds too early leaves e = v d; a scanner that measures all
    by 1 + s too long, s R_BC p_C.
    """
    names = ("time", "p_BR", "n_B", "v_BR", "turn_B", "p_CR", "n_C", "covariance", "normal_sigma")
    return rows_of(X_BC, pivot, *(np.array([getattr(f, name) for f in frames]) for name in names))


def rows_of(
    X_BC: RigidTransform,
    pivot: Array,
    times: Array,
    p_BR: Array,
    n_B: Array,
    v_BR: Array,
    turn_B: Array,
    p_CR: Array,
    n_C: Array,
    covariances: Array,
    normal_sigmas: Array,
) -> Rows:
    """The same from arrays: times (n,), p_BR, n_B, v_BR, turn_B, p_CR, n_C (n, 3), covariances (n, 3, 3), normal_sigmas
    (n,)."""
    n = len(times)
    R, p = X_BC.rotation().matrix(), np.asarray(X_BC.translation())
    q = p_CR @ R.T + p
    n_R = n_C @ R.T
    first = R[:, 0] - n_B * (n_B @ R[:, 0])[:, None]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(n_B, first)
    across = np.stack([first, second], axis=1)  # (n, 2, 3)
    r = np.empty((n, 5))
    r[:, :3] = q - p_BR
    r[:, 3:] = np.einsum("nij,nj->ni", across, n_R - n_B)
    H = np.zeros((n, 5, SIZE))
    H[:, :3, :3] = skew(q - pivot)
    H[:, :3, 3:6] = -np.eye(3)
    H[:, 3:, :3] = across @ skew(n_R)
    H[:, :3, CLOCK] = v_BR
    H[:, 3:, CLOCK] = np.einsum("nij,nj->ni", across, turn_B)
    H[:, :3, SCALE] = p_CR @ R.T
    S = np.zeros((n, 5, 5))
    S[:, :3, :3] = R @ covariances @ R.T
    S[:, [3, 4], [3, 4]] = (normal_sigmas**2)[:, None]
    return Rows(np.asarray(times, dtype=float), r, H, S, np.asarray(p_CR), np.asarray(n_C))


def about(covariance: Array, lever: Array) -> Array:
    """A covariance (6, 6) [rotation; translation] about one point, as of a point ``lever`` (3,) m farther."""
    A = np.eye(6)
    A[3:, :3] = -skew(lever)
    return np.asarray(A @ covariance @ A.T)


def moved_about(X_BC: RigidTransform, move: Array, pivot: Array) -> RigidTransform:
    """X_BC after a move (6,) [rotation; translation] in the base about the pivot (3,)."""
    M = np.eye(4)
    M[:3, :3] = exp_rotation(move[:3])
    M[:3, 3] = pivot - M[:3, :3] @ pivot + move[3:]
    return RigidTransform(M) @ X_BC
