"""Cells whose errors the noise of single poses does not have: a discord of rotations and translations."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.calibration.hand_eye.poses import eye_in_hand, random_poses
from tests.worlds.hand_eye import imperfect_cell, ratios
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.calibration.hand_eye.choice import solve
from weldcal.calibration.hand_eye.opencv_methods import METHODS, opencv_held_out
from weldcal.calibration.hand_eye.problem import full_problem, residuals
from weldcal.calibration.hand_eye.solve import IDENTITY, HandEyeConfig, solve_problem

KNOWN = (IDENTITY, IDENTITY, IDENTITY)


def test_a_large_discord_lets_rotations_owe_nothing_to_the_translations() -> None:
    F, G, _, _ = eye_in_hand(15, np.random.default_rng(2), 2e-3, 1e-3)
    moved = F.copy()
    moved[:, :3, 3] += 0.02 * np.random.default_rng(1).normal(size=(15, 3))
    a, b = (solve(full_problem(X, G), KNOWN, usual_discord=1e6).state[0][:3, :3] for X in (F, moved))
    np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_wrong_camera_bends_the_rotations_of_least_squares_alone() -> None:
    """Ten cells in a row; ratios to the best of OpenCV's methods in each column, geometric means."""
    cells = [ratios("camera", seed) for seed in range(502, 512)]
    deg, mm = (
        {name: float(np.exp(np.mean([np.log(c[name][column]) for c in cells]))) for name in cells[0]}
        for column in (0, 1)
    )
    assert deg["weldcal"] < 1.01
    assert deg["weldcal"] + 0.01 < deg["least squares alone"]
    # and the translations keep most of what they gain
    assert mm["weldcal"] < 0.8 < mm["rotations alone"]


def test_a_target_at_five_metres_is_placed_by_its_translations() -> None:
    """A few tenths of a degree in each rotation are centimetres at the target, while its translations are known to
    millimetres."""
    worse = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        F, _, X, _ = eye_in_hand(15, rng)
        F[:, :3, :3] = exp_rotation(0.15 * rng.normal(size=(15, 3)))
        Y = pose(np.eye(3), np.array([0.0, 0.0, 5.0]))
        G = inverse(F @ X) @ Y @ random_poses(15, rng, np.radians(0.5), 3e-3)
        found = solve_problem(full_problem(F, G))
        theirs = [opencv_held_out(m, F, G) for m in METHODS]
        worse.append(
            found.held_out.rms_translation / min(t.rms_translation for t in theirs if np.isfinite(t.translation).all())
        )
    # a mean of weightings that has rotations alone among them reaches 0.47
    assert np.exp(np.mean(np.log(worse))) < 0.36


@pytest.mark.parametrize("kind", ["corners only", "both"])
def test_the_truth_of_a_cell_fits_its_poses_up_to_their_errors(kind: str) -> None:
    cell = imperfect_cell(kind, 3)
    w, d = residuals(full_problem(cell.F, cell.G), (cell.X, cell.Y, IDENTITY))
    assert np.degrees(np.linalg.norm(w, axis=1)).max() < 6.0
    assert 1e-5 < np.linalg.norm(d, axis=1).max() < 0.04


def test_the_region_holds_the_truth_as_often_as_stated() -> None:
    """Poses from corners with noise by PnP: errors grow with the distance, and no two poses have the same."""
    nees, bound = [], []
    for seed in range(2000, 2090):
        cell = imperfect_cell("corners only", seed)
        found = solve_problem(full_problem(cell.F, cell.G), config=HandEyeConfig(folds=0))
        nees.append(found.normalised_error("X", RigidTransform(cell.X)))
        bound.append(found.region(0.95))
    shares = [float((np.array(nees) < factor * np.array(bound)).mean()) for factor in (0.25, 1.0)]
    assert 0.91 <= shares[1] <= 0.985
    # half of the sigma would be refused, and so would twice of it: then a quarter of the squares count
    assert shares[0] < 0.91
    assert 0.75 < np.mean(nees) / 6.0 < 1.2
