"""A wrong scale of the camera's distances is named from eight poses on, at the level of the F test, and X is offered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.calibration.hand_eye.scale_sets import QUICK, independent_sigma, named, pairs
from weldcal.calibration.hand_eye.mistakes import _scale_fit, wrong_scale
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import solve_ax_xb, solve_problem
from weldcal.calibration.recorded_hand_eye import HandEyeOptions
from weldcal.tools.commands.hand_eye import run_hand_eye


@pytest.mark.parametrize("n", [8, 10, 12, 20])
def test_a_board_at_97_percent_is_named(n: int) -> None:
    F, G, X = pairs(np.random.default_rng(n), n, 1.0 / 0.97, 0.05, 0.3)
    found = named(F, G)
    assert found is not None
    assert found.factor == pytest.approx(0.97, abs=max(4.0 * found.sigma, 1e-3))
    first = _scale_fit(full_problem(F, G), solve_problem(full_problem(F, G), config=QUICK))
    assert first is not None
    assert first[1] == pytest.approx(found.sigma, rel=0.3)  # the residuals with the error in them are 20 times as large
    assert first[2] < 1e-5
    plain = solve_problem(full_problem(F, G), config=QUICK).X.translation() - X[:3, 3]
    assert np.linalg.norm(found.poses["X"].translation() - X[:3, 3]) < 0.5 * np.linalg.norm(plain)
    assert "too long" in found.sentence


def test_the_chance_of_right_sets_is_uniform() -> None:
    """240 sets: at the level of 10 % a share of 0.10 +- 0.02; with the variance of the other fit it is 0.05 or less."""
    chances, factors = [], []
    for k in range(240):
        rng = np.random.default_rng([11, k])
        deg, mm = rng.uniform(0.02, 0.3), rng.uniform(0.1, 1.5)
        F, G, X = pairs(rng, int(rng.integers(8, 13)), 1.0, deg, mm)
        problem = full_problem(F, G)
        fit = _scale_fit(problem, solve_problem(problem, config=QUICK))
        assert fit is not None
        chances.append(fit[2])
        factors.append(fit[1] / independent_sigma(F, G, X, deg, mm) if k % 8 == 0 else np.nan)
    assert 0.04 < np.mean(np.array(chances) < 0.1) < 0.18
    assert 0.38 < np.mean(np.array(chances) < 0.5) < 0.60
    # the sigma agrees with one by finite differences; three turns more are free here, which costs a little
    assert 0.9 < np.nanmedian(factors) < 1.35


@pytest.mark.parametrize("noise_mm", [0.1, 2.0])
def test_turns_about_one_point_name_no_scale(noise_mm: float) -> None:
    for seed in range(6):
        F, G, _ = pairs(np.random.default_rng(seed), 15, 1.0, 0.05, noise_mm, shift=0.0)
        # the camera turns about the board: its distance stays, and every scale fits as well
        problem = full_problem(F, G)
        fit = _scale_fit(problem, solve_problem(problem, config=QUICK))
        assert fit is None or fit[2] > 1e-4
        assert wrong_scale(problem, solve_problem(problem, config=QUICK), QUICK) is None


def test_motions_name_the_scale_as_well() -> None:
    F, G, _ = pairs(np.random.default_rng(3), 13, 1.04, 0.03, 0.2)
    A = np.array([np.linalg.inv(F[0]) @ f for f in F[1:]])
    B = np.array([G[0] @ np.linalg.inv(g) for g in G[1:]])
    problem = full_problem(A, np.linalg.inv(B), free=(True, False, False), tied=True)
    found = wrong_scale(problem, solve_ax_xb(A, B, QUICK), QUICK)
    assert found is not None
    assert found.factor == pytest.approx(1.0 / 1.04, abs=0.01)


def test_the_first_screen_names_a_wrong_scale_first(tmp_path: Path) -> None:
    F, G, _ = pairs(np.random.default_rng(3), 12, 1.0 / 0.97, 0.05, 0.3)
    np.savez(tmp_path / "pairs.npz", A=F, B=G, mode="eye_in_hand")
    first = run_hand_eye(tmp_path / "pairs.npz", tmp_path / "out", HandEyeOptions(), limit_mm=1.0).first
    assert first.concerns[0].startswith("The camera's distances seem")
    assert first.next.text.startswith("Correct the target's stated size")


def test_the_first_screen_states_another_order_and_unit(tmp_path: Path) -> None:
    F, G, _ = pairs(np.random.default_rng(3), 12, 1.0, 0.05, 0.3)
    G[:, :3, 3] *= 1000.0 / 25.4
    np.savez(tmp_path / "pairs.npz", A=F, B=np.roll(G, 5, axis=0)[::-1], mode="eye_in_hand")
    first = run_hand_eye(tmp_path / "pairs.npz", tmp_path / "out", HandEyeOptions()).first
    assert first.more["read as"] == "camera positions in inch; rows paired by their motions (-v: the order)"
