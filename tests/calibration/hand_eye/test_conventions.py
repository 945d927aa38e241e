"""The data choose how two lists of poses are read; SciPy writes the lists, so that the readers' own tables are not the
truth."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.poses.readings import PoseNumbers, readings
from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.hand_eye.pairs.conventions import decide
from weldcal.calibration.hand_eye.pairs.files import read_pairs

SETS = 24
MOVING = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "XYX", "XZX", "YXY", "YZY", "ZXZ", "ZYZ")
AXES = (*MOVING, *(axes.lower() for axes in MOVING))


def world(rng: np.random.Generator, n: int, degrees: float, mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Robot poses, camera poses and X of an eye in hand, by the equation itself."""
    A, X, Y = np.tile(np.eye(4), (n, 1, 1)), np.eye(4), np.eye(4)
    A[:, :3, :3] = (
        Rotation.from_rotvec(rng.normal(size=(n, 3)) * rng.uniform(0.2, 1.0)) * Rotation.random(rng=rng)
    ).as_matrix()
    A[:, :3, 3] = rng.uniform([0.2, -0.3, 0.1], [0.8, 0.3, 0.7], (n, 3))
    X[:3, :3], X[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 0.07
    Y[:3, :3], Y[:3, 3] = Rotation.random(rng=rng).as_matrix(), [0.6, 0.1, 0.0]
    B = np.linalg.inv(X) @ np.linalg.inv(A) @ Y
    B[:, :3, :3] = (
        B[:, :3, :3] @ Rotation.from_rotvec(rng.normal(size=(n, 3)) * np.radians(degrees) / np.sqrt(3.0)).as_matrix()
    )
    B[:, :3, 3] += rng.normal(size=(n, 3)) * 1e-3 * mm / np.sqrt(3.0)
    return A, B, X


def written(X: np.ndarray, rng: np.random.Generator) -> tuple[PoseNumbers, str]:
    """A list in a random convention, and the form that states it."""
    turn, p = Rotation.from_matrix(X[:, :3, :3]), X[:, :3, 3]
    kind = rng.integers(0, 4)
    if kind == 0:
        order = ("wxyz", "xyzw")[int(rng.integers(2))]
        return PoseNumbers(source="a", p=p, r=turn.as_quat(scalar_first=order == "wxyz")), f"quaternion_{order}"
    unit = ("deg", "rad")[int(rng.integers(2))]
    if kind == 1:
        return PoseNumbers(source="a", p=p, r=turn.as_rotvec(degrees=unit == "deg")), f"rotation_vector,{unit}"
    axes = AXES[int(rng.integers(len(AXES)))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # gimbal lock: one angle is chosen, and the rotation is right
        return PoseNumbers(source="a", p=p, r=turn.as_euler(axes, degrees=unit == "deg")), f"euler_{axes},{unit}"


@pytest.mark.parametrize("seed", range(SETS))
def test_the_right_reading_of_both_lists_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B, X = world(rng, int(rng.integers(6, 25)), degrees=0.5 * rng.uniform(), mm=2.0 * rng.uniform())
    (robot, stated), (camera, other) = written(A, rng), written(B, rng)
    found = decide(readings(robot), readings(camera), eye_in_hand=True)
    assert found.determined
    assert (found.best.robot.form, found.best.camera.form) == (stated, other) or pytest.approx(
        X, abs=0.05
    ) == found.best.X


@pytest.mark.parametrize("seed", range(4))
def test_turns_about_one_axis_select_a_reading(seed: int) -> None:
    """A SCARA arm: rotations leave the angle of X about the axis open, and the positions fix it."""
    rng = np.random.default_rng(seed)
    A, _, X = world(rng, 14, degrees=0.0, mm=0.0)
    A[:, :3, :3] = Rotation.from_rotvec(rng.uniform(-1.2, 1.2, (14, 1)) * [0.0, 0.0, 1.0]).as_matrix() @ A[0, :3, :3]
    B = np.linalg.inv(X) @ np.linalg.inv(A) @ np.diag([1.0, -1.0, -1.0, 1.0])
    B[:, :3, 3] += rng.normal(size=(14, 3)) * 3e-4
    B[:, :3, :3] = B[:, :3, :3] @ Rotation.from_rotvec(rng.normal(size=(14, 3)) * 1e-3).as_matrix()
    turn, other = (Rotation.from_matrix(one[:, :3, :3]) for one in (A, B))
    robot = PoseNumbers(source="a", p=A[:, :3, 3], r=turn.as_quat(scalar_first=False))
    camera = PoseNumbers(source="b", p=1e3 * B[:, :3, 3], r=other.as_rotvec(degrees=True))
    found = decide(readings(robot), readings(camera), eye_in_hand=True)
    assert found.determined
    assert found.best.agrees
    assert (found.best.robot.form, found.best.camera.form) == ("quaternion_xyzw", "rotation_vector,deg")


def test_few_noisy_poses_do_not_select_a_reading() -> None:
    """A wrong reading must never be used: where the noise hides the difference, several are left."""
    rng = np.random.default_rng(5)
    A, B, _ = world(rng, 5, degrees=6.0, mm=30.0)
    turn = Rotation.from_matrix(A[:, :3, :3])
    robot = PoseNumbers(source="a", p=A[:, :3, 3], r=turn.as_euler("ZYX"))
    camera = PoseNumbers(source="b", p=B[:, :3, 3], r=Rotation.from_matrix(B[:, :3, :3]).as_euler("ZYX"))
    assert decide(readings(robot), readings(camera), eye_in_hand=True).rivals


def test_an_inverted_list_is_refused_with_the_three_ways_to_state_it(tmp_path: Path) -> None:
    A, B, _ = world(np.random.default_rng(2), 12, degrees=0.05, mm=0.3)
    np.savez(tmp_path / "a.npz", A=np.linalg.inv(A), B=B)
    with pytest.raises(
        InconsistentPoses,
        match=r"--mounting eye_on_base.*--as robot-form=matrix,inverse.*--as camera-form=matrix,inverse",
    ):
        read_pairs(tmp_path / "a.npz", mounting="eye_in_hand")
    assert read_pairs(tmp_path / "a.npz", mounting="eye_on_base").robot == pytest.approx(np.linalg.inv(A), abs=1e-12)


def test_a_list_shifted_by_a_row_is_shifted_back(tmp_path: Path) -> None:
    A, B, _ = world(np.random.default_rng(3), 15, degrees=0.05, mm=0.3)
    np.savez(tmp_path / "a.npz", A=A[:-1], B=B[1:])
    pairs = read_pairs(tmp_path / "a.npz", mounting="eye_in_hand")
    assert pairs.robot == pytest.approx(A[1:-1], abs=1e-12)
    assert pairs.camera == pytest.approx(B[1:-1], abs=1e-12)
    assert any("shifted" in note for note in pairs.notes)


def test_squares_that_are_counted_are_named_with_their_size(tmp_path: Path) -> None:
    A, B, _ = world(np.random.default_rng(4), 15, degrees=0.05, mm=0.3)
    B[:, :3, 3] /= 0.0285
    np.savez(tmp_path / "a.npz", A=A, B=B)
    with pytest.raises(InconsistentPoses, match=r"0\.0285 m"):
        read_pairs(tmp_path / "a.npz", mounting="eye_in_hand")
