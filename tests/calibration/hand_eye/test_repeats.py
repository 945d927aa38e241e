"""Repeats of a pose: one observation in the folds and in the covariance, however often it was measured."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from tests.calibration.hand_eye.poses import eye_in_hand, noise, random_poses
from weldcal.calibration.geometry.se3 import inverse
from weldcal.calibration.hand_eye.mountings import get_mounting
from weldcal.calibration.hand_eye.opencv_methods import opencv_held_out
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.repeats import one_per_pose
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_problem
from weldcal.tools.report.hand_eye import HandEyeReport

Array = NDArray[np.float64]
TURN, SHIFT = float(np.radians(0.05)), 3e-4


def repeated(seed: int, counts: list[int], shot: float = 1.0, jitter: float = 0.0) -> tuple[Array, Array, Array, Array]:
    """Samples of poses that were each measured so often: an error of each pose, and one of each sample (``shot`` times
    as large)."""
    rng = np.random.default_rng(seed)
    F, G, X, Y = eye_in_hand(len(counts), rng, TURN, SHIFT)
    rows = np.repeat(np.arange(len(counts)), counts)
    F, G = F[rows], G[rows] @ noise(len(rows), rng, shot * TURN, shot * SHIFT)
    return F @ noise(len(rows), rng, jitter * 1e-5, jitter * 1e-5), G, X, Y


def solved(F: Array, G: Array, folds: int = 0) -> HandEyeResult:
    return solve_problem(full_problem(F, G), config=HandEyeConfig(folds=folds))


@pytest.mark.parametrize("counts", [[8] * 8, [1, 1, 1, 1, 1, 25, 4, 2, 2, 1], [1] * 40 + [30] * 4])
def test_the_covariance_is_right_whatever_the_repeats(counts: list[int]) -> None:
    """The squared error over the covariance is 1 for each unknown.

    Its spread over a run is 0.75 at most (six unknowns of 13 degrees of freedom), so that the mean of 30 runs lies
    within 0.4 with 99.7 %; counted as independent, 8 x 8 samples give 4.7.
    """
    squares = []
    for seed in range(30):
        F, G, X, Y = repeated(seed, counts, jitter=1.0)
        result = solved(F, G)
        squares += [result.normalised_error(k, RigidTransform(T)) for k, T in (("X", X), ("Y", Y))]
    assert 0.6 < np.mean(squares) / 6.0 < 1.45


def test_exact_copies_change_nothing() -> None:
    F, G, _, _ = repeated(3, [1] * 9)
    rows = np.repeat(np.arange(9), 4)
    once, often = solved(F, G, folds=5), solved(F[rows], G[rows], folds=5)
    assert np.allclose(once.X.GetAsMatrix4(), often.X.GetAsMatrix4(), atol=1e-9)
    assert np.allclose(once.covariance["X"], often.covariance["X"], rtol=1e-6, atol=1e-15)
    assert np.allclose(once.held_out.translation[rows], often.held_out.translation, atol=1e-9)
    assert np.array_equal(often.observation, rows)
    theirs = opencv_held_out("PARK", F[rows], G[rows])
    assert np.allclose(theirs.translation, opencv_held_out("PARK", F, G).translation[rows], atol=1e-6)


def test_held_out_errors_are_as_without_repeats() -> None:
    """Repeats with a small error of their own add nothing: the held-out errors are those of one sample a pose."""
    ratio = []
    for seed in range(10):
        F, G, _, _ = repeated(seed, [8] * 10, shot=0.2)
        one = np.arange(0, 80, 8)
        ratio.append(solved(F, G, 5).held_out.rms_translation / solved(F[one], G[one], 5).held_out.rms_translation)
    assert 0.93 < np.median(ratio) < 1.07


def test_a_wrong_repeat_is_excluded_alone() -> None:
    F, G, X, _ = repeated(1, [5] * 10)
    G[17, :3, 3] += [0.02, 0.0, 0.0]
    result = solved(F, G, folds=5)
    assert np.flatnonzero(~result.inliers).tolist() == [17]
    assert result.normalised_error("X", RigidTransform(X)) < result.region(0.999)


def test_repeats_that_vary_more_than_other_samples_are_used() -> None:
    """Three samples at one of 40 poses with errors 2.5 times those of the others, as of a pause in a recorded
    motion."""
    for seed in range(10):
        F, G, X, _ = repeated(seed, [1] * 39 + [3], shot=0.0)
        G[39:] = G[39:] @ noise(3, np.random.default_rng(100 + seed), 2.5 * TURN, 2.5 * SHIFT)
        result = solved(F, G)
        assert result.inliers.all()
        # at least a third of the variance is common; estimated to 30 %
        assert result.sigma_translation > 0.7 * SHIFT / np.sqrt(3.0)
        assert result.normalised_error("X", RigidTransform(X)) < result.region(0.9999)


def test_poses_that_differ_are_no_repeats() -> None:
    rng = np.random.default_rng(5)
    F = random_poses(1, rng)[0] @ noise(200, rng, 0.02, 0.01)
    F = np.concatenate([F, random_poses(10, rng)])
    problem = full_problem(F, inverse(F))
    repeats = one_per_pose(problem)
    assert repeats.problem is problem
    assert np.array_equal(repeats.observation, np.arange(210))


def report(result: HandEyeResult, limit_mm: float | None = None) -> HandEyeReport:
    return HandEyeReport(
        result=result,
        mounting=get_mounting("eye_in_hand"),
        comparison=(),
        next_pose=None,
        files=(),
        seconds=0.0,
        limit_mm=limit_mm,
    )


def test_held_out_figures_are_all_of_the_poses_used() -> None:
    F, G, _, _ = repeated(1, [1] * 14)
    G[[2, 5]] = G[[2, 5]] @ random_poses(2, np.random.default_rng(0), 1.0, 0.3)
    result = solved(F, G, folds=5)
    assert np.flatnonzero(~result.inliers).tolist() == [2, 5]
    found = report(result).summary()
    kept_deg = np.degrees(result.held_out.rotation_rad[result.inliers])
    kept_mm = 1e3 * result.held_out.translation[result.inliers]
    assert found["held_out_deg"] == pytest.approx(np.sqrt(np.mean(kept_deg**2)))
    assert found["held_out_mm"] == pytest.approx(np.sqrt(np.mean(kept_mm**2)))
    assert found["held_out_of"] == "12 poses, without 2 excluded"
    backing = report(result).first.expected.backing
    assert f"rms {np.sqrt(np.mean(kept_deg**2)):.3f} degrees" in backing
    assert "of 12 poses, without 2 excluded" in backing


def test_repeats_back_the_verdict_as_one_pose_each() -> None:
    F, G, _, _ = repeated(1, [10] * 6)
    first = report(solved(F, G, folds=5)).first
    assert first.found.unseen == 6
    assert "The 60 samples repeat 6 poses: the repeats of a pose are averaged and count once." in first.notes
    assert "6 poses (60 samples)" in first.expected.backing


def test_an_undetermined_pose_is_not_to_be_used() -> None:
    """Turns about one axis leave a translation open, whatever the tolerance."""
    rng = np.random.default_rng(2)
    F = np.tile(np.eye(4), (12, 1, 1))
    angle = rng.uniform(-1.5, 1.5, 12)
    F[:, 0, 0], F[:, 0, 1], F[:, 1, 0], F[:, 1, 1] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    F[:, :3, 3] = rng.normal(size=(12, 3)) * 0.2
    X, Y = random_poses(2, rng, 1.0)
    G = inverse(F @ X) @ Y @ noise(12, rng, 1e-4, 1e-4)
    first = report(solved(F, G, folds=5), limit_mm=50.0).first
    assert first.verdict == "do not use"
    assert "Not observable: translation along the common rotation axis" in first.reason
