"""The tablet paper's two fitness functions: mean distances after the chain (stage 1) and the affine pair (stage 2)."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from weldcal.calibration.tablet.published.chain import Landmarks, Model, place_landmarks
from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.models.arrays import Array

AFFINE_NAMES = ("X_1", "Y_1", "Sx_1", "Sy_1", "theta_1", "X_2", "Y_2", "Sx_2", "Sy_2", "theta_2")
AFFINE_NONE = np.array([0.0, 0.0, 1.0, 1.0, 0.0] * 2)
# The paper gives no search range for stage 2; its figures lie well inside this one. mm, 1, degrees.
AFFINE_RANGE = np.array([[-5, 5], [-5, 5], [0.7, 1.3], [0.7, 1.3], [-10, 10]] * 2, float)
CENTRE = 4  # the landmark that A_n turns about: "the fourth black dot", counted from 0


class Sign(IntEnum):
    """Sign of the touching error in Eq. 20: as printed in the paper, omitted, or as the paper's data require."""

    PRINTED = -1
    NONE = 0
    CORRECTED = 1


@dataclass(frozen=True)
class Fitness:
    """F = f1 + f2, mm: f1 camera against tablet (Eq. 18, 22), f2 hand against where it stood (Eq. 19, 23)."""

    F: float
    f1: float
    f2: float


def stage1_residuals(
    touches: TabletTouches, parameters: Array, model: Model, sign: Sign, dh_offset_in_error: bool = True
) -> Array:
    """Differences (k, 2 n, 2) mm of Eqs. 18 and 19 for parameter sets (k, 12): n of f1, then n of f2."""
    p = place_landmarks(touches, parameters, model, dh_offset_in_error)
    target = 1e3 * touches.hand_m + sign * p.correction
    return np.concatenate([p.seen - p.shown, p.seen - p.pen - target], axis=1)


def stage2_residuals(touches: TabletTouches, affine: Array, stage1: Landmarks, sign: Sign) -> Array:
    """Differences (k, 2 n, 2) mm of Eqs. 22 and 23 for affine pairs (k, 10) on top of one stage 1.

    A_1 acts on the camera's landmarks, A_2 on what A_1 gives minus the pen (only that reading of Eq. 23 reproduces the
    published figures).
    """
    a = np.atleast_2d(affine)
    first = apply_affine(a[:, :5], stage1.seen)
    hand = apply_affine(a[:, 5:], first - stage1.pen)
    target = 1e3 * touches.hand_m + sign * stage1.correction
    return np.concatenate([first - stage1.shown, hand - target], axis=1)


def apply_affine(a: Array, points: Array, about: Array | None = None) -> Array:
    """Eq. 24 on points (k, n, 2) mm for a (k, 5) = X, Y, Sx, Sy (1), theta (deg), about a point (k, 2) or landmark
    4."""
    X, Y, Sx, Sy, theta = np.asarray(a).T[:, :, None]
    centre = points[:, CENTRE : CENTRE + 1] if about is None else np.asarray(about)[:, None, :]
    d = points - centre
    x, y = Sx * d[..., 0], Sy * d[..., 1]
    c, s = np.cos(np.radians(theta)), np.sin(np.radians(theta))
    return np.asarray(centre + np.stack([c * x - s * y + X, s * x + c * y + Y], axis=-1))


def fitness(residuals: Array) -> Fitness:
    """The paper's figures from the differences (2 n, 2) mm of one parameter set."""
    d = np.linalg.norm(residuals.reshape(-1, 2), axis=-1)
    n = len(d) // 2
    f1, f2 = float(d[:n].mean()), float(d[n:].mean())
    return Fitness(f1 + f2, f1, f2)
