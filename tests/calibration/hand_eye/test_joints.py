"""Joint angles find what is wrong with the robot where something is, and say that they do not help where nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.calibration.hand_eye.poses import Array, noise, random_poses
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.calibration.hand_eye.joints import JointRefinement, flange_poses, poses_of_arm, refine_joints
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import HandEyeResult, solve_problem
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import Chain, forward_kinematics
from weldcal.models.errors import InputError

TURN, SHIFT = np.radians(0.02), 1e-4
OFFSET_RAD = np.radians(
    [0.0, 0.15, -0.2, 0.12, 0.25, 0.0]
)  # of a robot nobody measured; the ends belong to base and flange


def cell(mode: str, offsets: Array, seed: int = 0, n: int = 40) -> tuple[PosePairs, Chain, Array]:
    """Pairs as a controller with nominal numbers states them while the robot turns by the offsets, and the camera's
    pose."""
    arm, rng = load_chain("ur10e"), np.random.default_rng(seed)
    q = np.array([0.3, -1.4, 1.7, -1.9, -1.5, 0.4]) + rng.uniform(-0.6, 0.6, (n, 6))
    errors = np.zeros((6, 6))
    errors[:, 2] = offsets
    stated, real = flange_poses(arm, q, np.zeros((6, 6))), flange_poses(arm, q, errors)
    X, Y = random_poses(2, rng, 1.5)
    F = real if mode == "eye_in_hand" else inverse(real)
    camera = inverse(F @ X) @ Y @ noise(n, rng, TURN, SHIFT)
    return PosePairs(source="cell.npz", robot=stated, camera=camera, mode=mode, q=q), arm, X


def refined(mode: str, offsets: Array, kind: str = "joints") -> tuple[JointRefinement, HandEyeResult, Array]:
    pairs, arm, X = cell(mode, offsets, n=40 if kind == "joints" else 20)
    plain = solve_problem(full_problem(pairs.F, pairs.G))
    return refine_joints(pairs, plain, arm, kind), plain, X


def test_the_chain_of_all_poses_is_the_arm_s_own() -> None:
    for name in ("ur5e", "franka_panda"):
        arm = load_chain(name)
        q = np.random.default_rng(1).uniform(-1.0, 1.0, (4, arm.n))
        own = np.array([forward_kinematics(arm, each).GetAsMatrix4() for each in q])
        np.testing.assert_allclose(flange_poses(arm, q, np.zeros((arm.n, 6))), own, atol=1e-12)


@pytest.mark.parametrize("mode", ["eye_in_hand", "eye_on_base"])
def test_joint_offsets_are_found_and_halve_the_error_at_least(mode: str) -> None:
    found, plain, X = refined(mode, OFFSET_RAD)
    assert found.accepted, found.sentence
    # the first and the last joint's offset are the base's and the flange's; the four between are seen
    assert [n.split()[1] for n in found.names] == ["offset"] * 4
    assert (np.abs(found.values - OFFSET_RAD[1:5]) < 3.5 * found.sigma).all()
    assert (found.sigma < np.radians(0.05)).all()
    assert found.result.held_out.rms_translation < 0.5 * plain.held_out.rms_translation
    # held out means held out: what is left is the camera's own noise, as at the start
    assert found.result.held_out.rms_translation < 2.0 * np.sqrt(3.0) * SHIFT
    assert found.result.normalised_error("X", RigidTransform(X)) < found.result.region(0.999)
    assert plain.normalised_error("X", RigidTransform(X)) > plain.region(0.999)
    assert "shoulder_lift_joint offset" in found.sentence
    assert "enter these errors" in found.sentence


@pytest.mark.parametrize("kind", ["joints", "links"])
def test_a_sound_robot_is_left_alone_in_a_sentence(kind: str) -> None:
    found, plain, _ = refined("eye_in_hand", np.zeros(6), kind)
    assert not found.accepted
    assert found.result is plain
    assert "do not help" in found.sentence


def test_too_few_poses_are_no_ground_to_change_a_robot() -> None:
    pairs, arm, _ = cell("eye_in_hand", OFFSET_RAD, n=6)
    plain = solve_problem(full_problem(pairs.F, pairs.G))
    found = refine_joints(pairs, plain, arm, "links")
    assert not found.accepted
    assert "too few" in found.sentence


def test_a_controller_s_tool_and_base_do_not_matter() -> None:
    pairs, arm, _ = cell("eye_in_hand", OFFSET_RAD)
    turned = random_poses(2, np.random.default_rng(5))
    told = replace(pairs, robot=turned[0] @ pairs.robot @ turned[1])
    found = refine_joints(told, solve_problem(full_problem(told.F, told.G)), arm)
    assert found.accepted
    assert (np.abs(found.values - OFFSET_RAD[1:5]) < 3.5 * found.sigma).all()


def test_joint_angles_of_another_robot_are_told() -> None:
    pairs, arm, _ = cell("eye_in_hand", OFFSET_RAD)
    plain = solve_problem(full_problem(pairs.F, pairs.G))
    with pytest.raises(InputError, match="do not lead ur3e"):
        refine_joints(pairs, plain, load_chain("ur3e"))
    with pytest.raises(InputError, match="franka_panda needs"):
        refine_joints(pairs, plain, load_chain("franka_panda"))
    assert pairs.q is not None
    with pytest.raises(InputError, match="in radians"):
        refine_joints(replace(pairs, q=np.degrees(pairs.q)), plain, arm)
    with pytest.raises(DatasetError, match="no joint angles"):
        refine_joints(replace(pairs, q=None), plain, arm)
    still = pose(np.eye(3), np.zeros(3))
    with pytest.raises(InputError, match="eye_in_hand or eye_on_base"):
        refine_joints(replace(pairs, mode="eye_on_arm_target_on_base", link=still), plain, arm)


def test_poses_of_a_corrected_arm_replace_the_stated_ones() -> None:
    pairs, arm, X = cell("eye_in_hand", OFFSET_RAD)
    errors = np.zeros((6, 6))
    errors[:, 2] = OFFSET_RAD
    real = replace(
        arm,
        stack=np.array([joint @ pose(exp_rotation(e[:3]), e[3:]) for joint, e in zip(arm.stack, errors, strict=True)]),
    )
    moved = poses_of_arm(pairs, real)
    np.testing.assert_allclose(moved.robot, flange_poses(arm, pairs.q, errors), atol=1e-12)  # type: ignore[arg-type]
    off = [np.linalg.norm(solve_problem(full_problem(p.F, p.G)).X.translation() - X[:3, 3]) for p in (pairs, moved)]
    assert off[1] < 0.3 * off[0]
