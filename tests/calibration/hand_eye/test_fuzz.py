"""Whatever world the solver meets: no NaN, no confident wrong number, and a wrong convention is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.calibration.hand_eye.poses import Array, eye_in_hand, random_poses
from tests.worlds.hand_eye import MISTAKES, fuzz, judge, random_world
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.calibration.hand_eye.mistakes import likely_mistake, wrong_scale
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig, solve_problem

QUICK = HandEyeConfig(folds=0)


def test_random_worlds_never_get_a_nan_or_a_confident_wrong_answer() -> None:
    said = fuzz(8, seed=3)
    assert sum(sum(c.values()) for c in said.values()) == 8
    assert not any(c["NAN"] or c["WRONG"] for c in said.values())
    # tidy worlds are solved, not refused
    assert said["none"]["refused"] == said["none"]["named"] == 0
    assert said["none"]["answer"] > 0


@pytest.mark.parametrize("mistake", [m for m in MISTAKES if m not in ("none", "target size")])
def test_a_mistake_is_named_or_at_least_not_answered_with_confidence(mistake: str) -> None:
    rng = np.random.default_rng((2, MISTAKES.index(mistake)))
    world = random_world(rng, mistake)
    while world.motion != "arm":
        world = random_world(rng, mistake)
    verdict = judge(world)
    assert verdict.said == "named", verdict
    words = {"scale": "multiplied by", "quaternion order": "quaternions are in the order x, y, z, w"}
    assert words.get(mistake, mistake.split()[-1]) in verdict.sentence


def pairs_of(F: Array, G: Array) -> PosePairs:
    return PosePairs(source="made up", robot=F, camera=G, mode="eye_in_hand")


def test_a_camera_that_hardly_moves_is_no_mistake_in_units() -> None:
    # the hand turns about one point: shrinking the camera's positions to nothing would fit as well
    rng = np.random.default_rng(3)
    R = exp_rotation(rng.normal(size=(8, 3)) * 0.4)
    F = inverse(pose(R, np.zeros((8, 3))) @ pose(np.eye(3), np.array([0.3, 0.0, 0.6])))
    X, Y = random_poses(2, rng)
    G = inverse(F @ X) @ Y @ random_poses(8, rng, 2e-4, 1e-3)
    assert likely_mistake(pairs_of(F, G)) is None


def test_a_target_of_another_size_is_told_and_a_right_one_is_not() -> None:
    F, G, _, _ = eye_in_hand(25, np.random.default_rng(4), np.radians(0.05), 2e-4)
    G = G.copy()
    right = full_problem(F, G)
    assert wrong_scale(right, solve_problem(right, config=QUICK)) is None
    G[:, :3, 3] *= 1.02
    wrong = full_problem(F, G)
    found = wrong_scale(wrong, solve_problem(wrong, config=QUICK))
    assert found is not None
    assert found.factor == pytest.approx(1.0 / 1.02, abs=4.0 * found.sigma)
    assert "too long" in found.sentence


def test_samples_that_are_one_apart_are_told() -> None:
    F, G, _, _ = eye_in_hand(25, np.random.default_rng(5), np.radians(0.05), 2e-4)
    late = replace(pairs_of(F, G), robot=F[1:], camera=G[:-1])
    said = likely_mistake(late)
    assert said is not None
    assert "one sample earlier" in said
