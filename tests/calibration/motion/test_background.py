"""Still things in the scan tell a moved scanner from a moved base; little or no background tells nothing."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.motion.drift.watch import BASE, SCANNER, background_move
from weldcal.models.arrays import Array

WIDTH, HEIGHT, FOCAL, NOISE_M = 160, 120, 150.0, 4e-4
PLANES = ((np.array([0.1, 0.0, -1.0]), 0.9), (np.array([-0.9, 0.1, -0.4]), 0.4), (np.array([0.1, -0.9, -0.3]), 0.35))


def scan(X_WC: RigidTransform, k: int, rng: np.random.Generator) -> Array:
    """An organised cloud (H, W, 3) m of a corner of a room, with an arm that passes before it."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - 0.5 * WIDTH) / FOCAL, (v - 0.5 * HEIGHT) / FOCAL, np.ones(u.shape)], axis=-1)
    R, c = X_WC.rotation().matrix(), X_WC.translation()
    depths = []
    for n, d in PLANES:
        along = rays @ (R.T @ n)
        with np.errstate(divide="ignore"):
            z = (-d - n @ c) / along
        depths.append(np.where(z > 0.1, z, np.inf))
    z = np.min(depths, axis=0)
    arm = np.abs(u - (20 + 11 * k) % WIDTH) < 8
    z = np.where(arm, 0.3, z) + NOISE_M * rng.standard_normal(z.shape)
    return np.asarray(rays * z[..., None])


@pytest.mark.parametrize(
    ("mm", "deg"),
    [((0.3, -0.2, 0.2), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.03, -0.03, 0.02)), ((2.0, 1.0, 0.0), (0.2, 0.0, 0.1))],
)
def test_a_moved_scanner_and_a_moved_base_are_told_apart(mm: tuple[float, ...], deg: tuple[float, ...]) -> None:
    rng = np.random.default_rng(1)
    move = RigidTransform(RotationMatrix(exp_rotation(np.radians(deg))), 1e-3 * np.array(mm))
    before = [scan(RigidTransform(), k, rng) for k in range(9)]
    X_AB = move.inverse()
    moved = background_move(before, [scan(move, k + 3, rng) for k in range(9)], X_AB)
    stayed = background_move(before, [scan(RigidTransform(), k + 3, rng) for k in range(9)], X_AB)
    assert moved is not None
    assert stayed is not None
    assert moved.cause == SCANNER
    assert stayed.cause == BASE


def test_nothing_is_told_without_a_background() -> None:
    rng = np.random.default_rng(2)
    X = RigidTransform([1e-3, 0.0, 0.0])
    empty = [np.full((HEIGHT, WIDTH, 3), np.nan)] * 5
    assert background_move(empty, empty, X) is None
    points = scan(RigidTransform(), 0, rng).reshape(-1, 3)
    assert background_move([points] * 5, [points] * 5, X) is None
    # a move far below the noise: it does not decide
    before = [scan(RigidTransform(), k, rng) for k in range(9)]
    tiny = background_move(before, [scan(RigidTransform(), k, rng) for k in range(9)], RigidTransform([2e-6, 0.0, 0.0]))
    assert tiny is None or tiny.cause is None
