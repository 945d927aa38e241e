"""Made-up hand-eye observations with known answers, for the tests of every mounting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose

Array = NDArray[np.float64]


def random_poses(n: int, rng: np.random.Generator, turn: float = 0.8, shift: float = 0.3) -> Array:
    """Poses (n, 4, 4) with rotation vectors and positions normal with these sigmas (rad, m)."""
    return pose(exp_rotation(rng.normal(size=(n, 3)) * turn), rng.normal(size=(n, 3)) * shift)


def noise(n: int, rng: np.random.Generator, turn: float, shift: float) -> Array:
    """Small poses (n, 4, 4): what a measurement adds on the side of the target."""
    return random_poses(n, rng, turn, shift)


def eye_in_hand(
    n: int, rng: np.random.Generator, turn: float = 0.0, shift: float = 0.0
) -> tuple[Array, Array, Array, Array]:
    """Robot poses F, measured target poses G, and the truth X, Y with F X G = Y up to the noise of G."""
    F = random_poses(n, rng)
    X, Y = random_poses(2, rng, 1.5)
    return F, inverse(F @ X) @ Y @ noise(n, rng, turn, shift), X, Y


def co_manipulation(
    n: int, rng: np.random.Generator, turn: float = 0.0, shift: float = 0.0
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """A, B, C and the truth X, Y, Z with A X B = Y C Z up to the noise of B."""
    A, C = random_poses(n, rng), random_poses(n, rng)
    X, Y, Z = random_poses(3, rng, 1.5)
    return A, inverse(A @ X) @ (Y @ C @ Z) @ noise(n, rng, turn, shift), C, X, Y, Z
