"""The region of a hand-eye pose holds the truth as often as it says, neither more nor less: poses by NumPy and SciPy
alone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_ax_yb

Array = NDArray[np.float64]

TURN, SHIFT = np.radians(0.05), 2e-4
CELLS = {8: 80, 15: 80}  # poses: cells


def poses(n: int, rng: np.random.Generator, turn: float, shift: float) -> Array:
    """Poses (n, 4, 4), rotation vectors and positions normal with these sigmas (rad, m)."""
    X = np.tile(np.eye(4), (n, 1, 1))
    X[:, :3, :3] = Rotation.from_rotvec(turn * rng.normal(size=(n, 3))).as_matrix()
    X[:, :3, 3] = shift * rng.normal(size=(n, 3))
    return X


def cell(n: int, seed: int) -> tuple[HandEyeResult, Array, Array]:
    """A X = Y B with n poses, B with noise on its own side; the result and the truth."""
    rng = np.random.default_rng([n, seed])
    A = poses(n, rng, 0.8, 0.3)
    X, Y = poses(2, rng, 1.5, 0.3)
    B = np.linalg.inv(Y) @ A @ X @ poses(n, rng, TURN, SHIFT)
    return solve_ax_yb(A, B, HandEyeConfig(folds=0)), X, Y


def judge(n: int, cells: int) -> tuple[Array, Array, Array]:
    """Of both poses of each cell (2 cells,): normalised squared error, and the regions of 50 and 95 %."""
    rows = []
    for seed in range(cells):
        result, X, Y = cell(n, seed)
        for name, truth in (("X", X), ("Y", Y)):
            e = result.normalised_error(name, RigidTransform(truth))
            rows.append((e, result.region(0.5), result.region(0.95)))
    square, half, most = np.array(rows).T
    return square, half, most


@pytest.fixture(scope="module", params=CELLS)
def judged(request: pytest.FixtureRequest) -> tuple[Array, Array, Array]:
    """Cells of so many poses."""
    return judge(request.param, CELLS[request.param])


def test_the_covariance_is_that_of_the_errors(judged: tuple[Array, Array, Array]) -> None:
    # of X and Y together some 900 degrees of freedom, partly shared: 6 %; few poses know their noise to a fifth
    assert 0.75 < judged[0].mean() / 6.0 < 1.3


def test_half_of_the_truths_lie_in_the_region_of_half(judged: tuple[Array, Array, Array]) -> None:
    # binomial of 80 to 160: 5 %; twice the region holds four fifths, half of it an eighth
    assert 0.37 < (judged[0] < judged[1]).mean() < 0.66


def test_the_region_of_95_percent_is_hardly_missed(judged: tuple[Array, Array, Array]) -> None:
    assert (judged[0] < judged[2]).mean() > 0.91


def test_four_poses_know_their_noise_badly_and_say_so() -> None:
    """Twelve numbers more than unknowns: with the noise taken for known, 86 % lie in the region."""
    square, _, most = judge(4, 80)
    assert (square < most).mean() > 0.92
