"""Cells whose errors the noise model does not have: the mean of all weightings beats OpenCV where one alone does not."""

from __future__ import annotations

import numpy as np
import pytest

from tests.calibration.hand_eye.poses import eye_in_hand
from weldcal.calibration.geometry.se3 import difference
from weldcal.calibration.hand_eye.choice import CANDIDATES, solve
from weldcal.calibration.hand_eye.problem import full_problem, residuals
from weldcal.calibration.hand_eye.solve import IDENTITY
from weldcal.tools.worlds.imperfect_cells import imperfect_cell, ratios

KNOWN = (IDENTITY, IDENTITY, IDENTITY)


def test_the_answer_is_the_mean_of_all_weightings() -> None:
    F, G, _, _ = eye_in_hand(15, np.random.default_rng(2), 2e-3, 1e-3)
    problem = full_problem(F, G)
    whole = solve(problem, KNOWN).state[0]
    alone = [solve(problem, KNOWN, candidates=(CANDIDATES[0], c)).state[0] for c in CANDIDATES]
    # a pair's mean lies half way between its members, so these seven add up to the mean of all
    first = solve(problem, KNOWN, candidates=CANDIDATES[:1]).state[0]
    shift = sum((2.0 * difference(first, X) for X in alone), np.zeros(6)) / len(CANDIDATES)
    np.testing.assert_allclose(difference(first, whole), shift, atol=1e-7)
    assert np.abs(shift).max() > 1e-5


def test_rotations_alone_owe_nothing_to_the_translations() -> None:
    F, G, _, _ = eye_in_hand(15, np.random.default_rng(2), 2e-3, 1e-3)
    moved = F.copy()
    moved[:, :3, 3] += 0.02 * np.random.default_rng(1).normal(size=(15, 3))
    a, b = (solve(full_problem(X, G), KNOWN, candidates=CANDIDATES[5:6]).state[0][:3, :3] for X in (F, moved))
    np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_wrong_camera_bends_the_rotations_of_least_squares_and_not_of_the_mean() -> None:
    cells = [ratios("camera", seed) for seed in (502, 503)]
    deg, mm = ({name: [cell[name][column] for cell in cells] for name in cells[0]} for column in (0, 1))
    assert max(deg["weldcal"]) < 1.03 < 1.05 < min(deg["least squares alone"])
    # and the translations keep most of what they gain
    assert max(mm["weldcal"]) < 0.9 < min(mm["rotations alone"])


@pytest.mark.parametrize("kind", ["corners only", "both"])
def test_the_truth_of_a_cell_fits_its_poses_up_to_their_errors(kind: str) -> None:
    cell = imperfect_cell(kind, 3)
    w, d = residuals(full_problem(cell.F, cell.G), (cell.X, cell.Y, IDENTITY))
    assert np.degrees(np.linalg.norm(w, axis=1)).max() < 6.0
    assert 1e-5 < np.linalg.norm(d, axis=1).max() < 0.04
