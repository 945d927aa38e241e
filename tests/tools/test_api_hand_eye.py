"""`weldcal.hand_eye`: arrays that are no poses are refused, and rotations by columns are read as such and named."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform

import weldcal
from tests.calibration.hand_eye.poses import eye_in_hand
from weldcal.calibration.geometry.se3 import inverse
from weldcal.models.errors import InputError

Array = NDArray[np.float64]
F, G, X, Y = eye_in_hand(12, np.random.default_rng(0), 1e-3, 3e-4)


def off_mm(result: object) -> float:
    return 1e3 * float(np.linalg.norm(result.poses["X"].translation() - X[:3, 3]))  # type: ignore[attr-defined]


def transposed(M: Array) -> Array:
    out = M.copy()
    out[:, :3, :3] = np.swapaxes(M[:, :3, :3], 1, 2)
    return out


def scaled(M: Array, by: float) -> Array:
    out = M.copy()
    out[:, :3, 3] *= by
    return out


def test_poses_as_they_are_are_used_without_a_word() -> None:
    result = weldcal.hand_eye(F, G)
    assert off_mm(result) < 1.5
    assert not result.warnings
    assert off_mm(weldcal.hand_eye([RigidTransform(M) for M in F], G)) == pytest.approx(off_mm(result), abs=1e-6)  # type: ignore[arg-type]


@pytest.mark.parametrize("who", ["robot", "camera"])
def test_transposed_rotations_are_read_and_named(who: str) -> None:
    robot, camera = (transposed(F), G) if who == "robot" else (F, transposed(G))
    result = weldcal.hand_eye(robot, camera)
    assert off_mm(result) < 1.5
    assert f"{who.capitalize()} poses read as matrices, rotations transposed" in result.warnings[0]


def test_rotations_of_both_transposed_are_named() -> None:
    with pytest.raises(InputError, match="the rotations of robot and camera are transposed"):
        weldcal.hand_eye(transposed(F), transposed(G))


def with_nan() -> Array:
    out = F.copy()
    out[3, 0, 0] = np.nan
    return out


def mirrored() -> Array:
    out = F.copy()
    out[:, :3, 0] *= -1.0
    return out


def stretched() -> Array:
    out = F.copy()
    out[2, :3, :3] *= 1.3
    return out


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        (with_nan(), "'robot' holds numbers that are not finite, first in pose 3"),
        (mirrored(), "mirrored"),
        (stretched(), "Pose 2 of 'robot' is not a rigid pose: the columns"),
        (np.swapaxes(F, 1, 2), "its position is in the last row; exchange rows and columns"),
        (scaled(F, 1000.0), "must be metres. Divide millimetres by 1000"),
        (inverse(F), "robot poses are inverted"),
    ],
)
def test_poses_that_cannot_be_used_are_input_errors(robot: Array, words: str) -> None:
    with pytest.raises(InputError, match=words.replace(".", r"\.")):
        weldcal.hand_eye(robot, G)


def test_camera_positions_in_mm_are_named() -> None:
    with pytest.raises(InputError, match="fit the robot's motion in mm, but m is stated"):
        weldcal.hand_eye(F, scaled(G, 1000.0))


def test_the_stated_form_is_used() -> None:
    assert off_mm(weldcal.hand_eye(inverse(F), G, robot_form="matrix,inverse")) < 1.5
