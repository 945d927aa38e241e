"""Causes of single poses that do not fit the others: exchanged, paired wrongly, another TCP or frame."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.calibration.hand_eye.poses import Array, eye_in_hand, random_poses
from weldcal.calibration.geometry.se3 import inverse
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult
from weldcal.calibration.recorded_hand_eye import solve_pairs

TURN, SHIFT = float(np.radians(0.05)), 3e-4
QUICK = HandEyeConfig(folds=0)
MODES = ("eye_in_hand", "eye_on_base")


def world(mode: str, seed: int, n: int = 15) -> tuple[Array, Array, Array]:
    """Robot poses, camera poses, and the truth X of either mounting."""
    F, G, X, _ = eye_in_hand(n, np.random.default_rng(seed), TURN, SHIFT)
    return (F if mode == "eye_in_hand" else inverse(F)), G, X


def solved(robot: Array, camera: Array, mode: str, ids: tuple[str, ...] = ()) -> HandEyeResult:
    return solve_pairs(PosePairs(source="made up", robot=robot, camera=camera, mode=mode, ids=ids), QUICK)


def causes(result: HandEyeResult) -> list[str]:
    """The sentences about single poses."""
    return [w for w in result.warnings if any(word in w for word in ("exchanged", "instead", "TCP", "user frame"))]


def tcp(*offset: float) -> Array:
    T = np.eye(4)
    T[:3, 3] = offset
    return T


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("which", ["robot", "camera"])
def test_exchanged_poses_are_named(mode: str, which: str) -> None:
    robot, camera, X = world(mode, 1)
    listed = robot if which == "robot" else camera
    listed[[4, 7]] = listed[[7, 4]]
    result = solved(robot, camera, mode)
    assert causes(result) == ["Poses 4 and 7 are exchanged in one list: both fit when they change places."]
    assert result.normalised_error("X", RigidTransform(X)) < result.region(0.999)
    assert "Poses 4 ('e') and 7 ('h') are" in causes(solved(robot, camera, mode, tuple("abcdefghijklmno")))[0]


@pytest.mark.parametrize("mode", MODES)
def test_an_image_of_the_neighbour_is_named(mode: str) -> None:
    robot, camera, _ = world(mode, 2)
    camera[5] = camera[6]
    (said,) = causes(solved(robot, camera, mode))
    assert said == "The camera's pose 5 fits the robot's 6 instead: check how these rows are paired."
    robot, camera, _ = world(mode, 2)
    camera[[8, 9]] = camera[[9, 10]]
    (said,) = causes(solved(robot, camera, mode))
    assert said == "The camera's poses 8 and 9 fit the robot's 9 and 10 instead: check how these rows are paired."


@pytest.mark.parametrize("mode", MODES)
def test_a_robot_pose_of_the_row_before_is_named(mode: str) -> None:
    """Without noise of the robot the row is a repeat of the row before, to the last digit."""
    robot, camera, X = world(mode, 2)
    robot[5] = robot[4]
    result = solved(robot, camera, mode)
    (said,) = causes(result)
    assert said == "The robot's pose 5 fits the camera's 4 instead: check how these rows are paired."
    assert result.normalised_error("X", RigidTransform(X)) < result.region(0.999)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("axis", range(3))
def test_one_pose_with_another_tcp_is_named(mode: str, axis: int) -> None:
    robot, camera, X = world(mode, 3)
    robot[6] = robot[6] @ tcp(*(0.12 * np.eye(3)[axis]))
    result = solved(robot, camera, mode)
    (said,) = causes(result)
    assert said.startswith("Pose 6 fits if the robot's pose had another TCP: offset 1")
    assert said.endswith(f"mm along {'xyz'[axis]} of the flange.")
    assert float(said.split("offset ")[1].split()[0]) == pytest.approx(120.0, abs=3.0)
    assert result.normalised_error("X", RigidTransform(X)) < result.region(0.999)


@pytest.mark.parametrize("mode", MODES)
def test_poses_with_one_other_tcp_or_frame_are_named(mode: str) -> None:
    T = random_poses(1, np.random.default_rng(9), 0.4, 0.1)[0]
    robot, camera, _ = world(mode, 4)
    robot[[2, 6, 9]] = robot[[2, 6, 9]] @ T
    (said,) = causes(solved(robot, camera, mode))
    assert said.startswith("Poses 2, 6 and 9 fit if the robot's poses had another TCP, or if the ")
    offset = [float(v) for v in said.split("(")[1].split(")")[0].split(",")]
    assert np.allclose(offset, 1e3 * T[:3, 3], atol=3.0)
    robot, camera, _ = world(mode, 4)
    robot[[2, 6, 9]] = T @ robot[[2, 6, 9]]
    (said,) = causes(solved(robot, camera, mode))
    assert said.startswith("Poses 2, 6 and 9 fit if the robot's poses had another base or user frame, or if the ")


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(5))
def test_outliers_without_a_cause_stay_outliers(mode: str, seed: int) -> None:
    """Wrong camera poses of any size, and robot poses that are shifted anyhow."""
    robot, camera, _ = world(mode, 10 + seed)
    rng = np.random.default_rng(seed)
    camera[[1, 5]] = camera[[1, 5]] @ random_poses(2, rng, 1.0, 0.2)
    robot[9, :3, 3] += [0.05, -0.08, 0.06]
    robot[12, :3, 3] += [0.0, 0.1, 0.0]
    result = solved(robot, camera, mode)
    assert np.flatnonzero(~result.inliers).tolist() == [1, 5, 9, 12]
    assert causes(result) == []


@pytest.mark.parametrize("seed", range(6))
def test_outliers_of_few_poses_do_not_hide(seed: int) -> None:
    """Two of 11 camera poses are 20 to 50 mm off, and no other pose is excluded."""
    robot, camera, X = world("eye_in_hand", 40 + seed, 11)
    rng = np.random.default_rng(seed)
    off = rng.normal(size=(2, 3))
    camera[[3, 8], :3, 3] += off / np.linalg.norm(off, axis=1)[:, None] * rng.uniform(0.02, 0.05, (2, 1))
    result = solved(robot, camera, "eye_in_hand")
    assert np.flatnonzero(~result.inliers).tolist() == [3, 8]
    assert result.normalised_error("X", RigidTransform(X)) < result.region(0.999)
