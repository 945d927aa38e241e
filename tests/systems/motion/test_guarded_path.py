"""A planned motion is refused where the guard would slow or stop the arm, with the place and the joint; the drive shows
who is right."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.systems.placements import GuardedArm
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.systems.motion.guarded_path import GuardedMotion, InfeasiblePath, check_joints, check_path, straight
from weldcal.welding.servo.guards import GUARD

ARM, X_FT = load_arm("ur10e"), RigidTransform([0.0, 0.0, 0.17])
HOME = np.deg2rad([0.0, -80.0, 110.0, -120.0, -90.0, 0.0])
DOWN = np.array([0.0, 0.0, -1.0])


def drive(arm: ArmModel, q: Array, motion: GuardedMotion) -> tuple[str | None, float, Array]:
    """How the guard's joint velocities end when they follow a straight motion: reason, least share, and the way (3,) m
    that was made."""
    carrier = GuardedArm(arm=arm, X_FT=motion.X_FT, q=q)
    p = np.array([X.translation() for X in motion.X_BT])
    V = np.r_[np.zeros(3), (p[-1] - p[0]) / motion.time[-1]]
    at, reason = p[0], None
    for _ in range(int(1.5 * motion.time[-1] / 0.008)):
        _, at, reason = carrier(V, 0.008)
        if reason or np.linalg.norm(at - p[0]) >= np.linalg.norm(p[-1] - p[0]):
            break
    return reason, carrier.slowest, at - p[0]


def motion(way: Array, speed: float = 0.02, q: Array = HOME, share: float = 0.9) -> GuardedMotion:
    return straight("the descent", forward_kinematics(ARM, q) @ X_FT, way, speed, X_FT, share)


def test_a_motion_near_home_is_followed_on_one_branch() -> None:
    found = check_path(ARM, HOME, [motion(0.1 * DOWN)])[0]
    assert found.share == 1.0
    assert np.abs(np.diff(found.q, axis=0)).max() < 0.02
    end = forward_kinematics(ARM, found.q[-1]) @ X_FT
    assert end.translation() == pytest.approx(
        (forward_kinematics(ARM, HOME) @ X_FT).translation() + 0.1 * DOWN, abs=1e-8
    )
    assert drive(ARM, HOME, motion(0.1 * DOWN))[0] is None


def test_an_arm_that_gets_stretched_is_refused_where_it_sticks() -> None:
    out = motion(np.array([0.9, 0.0, 0.0]) * (1.0 if forward_kinematics(ARM, HOME).translation()[0] > 0.0 else -1.0))
    with pytest.raises(
        InfeasiblePath, match=r"the descent at .* the elbow turns without effect: move the workpiece"
    ) as refused:
        check_path(ARM, HOME, [out])
    place = 1e-3 * float(re.search(r"at (\d+) mm", str(refused.value)).group(1))  # type: ignore[union-attr]
    reason, _, made = drive(ARM, HOME, out)
    assert reason == "guard"
    assert place < np.linalg.norm(made) < place + 0.05


def test_a_descent_may_be_slowed_but_not_stopped() -> None:
    """Between sigma_slow and sigma_stop a seam is refused, and a descent is not."""
    out = np.array([1.0, 0.0, 0.0]) * (1.0 if forward_kinematics(ARM, HOME).translation()[0] > 0.0 else -1.0)
    lengths = np.arange(0.534, 0.546, 0.001)
    refused = {
        share: next(float(x) for x in lengths if not followed(motion(x * out, share=share))) for share in (0.9, 0.25)
    }
    assert refused[0.9] < refused[0.25]
    assert check_path(ARM, HOME, [motion((refused[0.25] - 0.001) * out, share=0.25)])[0].sigma_min > GUARD.sigma_stop


def followed(path: GuardedMotion) -> bool:
    try:
        check_path(ARM, HOME, [path])
    except InfeasiblePath:
        return False
    return True


def test_a_speed_that_a_joint_does_not_have_is_named() -> None:
    with pytest.raises(
        InfeasiblePath, match=r"at its speed: the \w+.* would turn at [\d.]+ rad/s, and 1.57 rad/s are allowed"
    ):
        check_path(ARM, HOME, [motion(0.1 * DOWN, speed=1.5)])
    assert drive(ARM, HOME, motion(0.1 * DOWN, speed=1.5))[1] < 0.9


def test_a_joint_at_its_limit_is_named() -> None:
    upper = ARM.position_upper.copy()
    upper[2] = HOME[2] + 0.03
    narrow = replace(ARM, position_upper=upper)
    check_path(narrow, HOME, [motion(1e-3 * DOWN)])
    with pytest.raises(InfeasiblePath, match=r"the elbow would be at 11. deg, and its limits are -180 to 112 deg"):
        check_path(narrow, HOME, [motion(0.2 * DOWN), motion(-0.2 * DOWN)])
    with pytest.raises(InfeasiblePath, match="home: the elbow"):
        check_joints(narrow, HOME + 0.1, "home")


def test_a_wrist_that_is_straight_is_refused_at_once() -> None:
    q = HOME.copy()
    q[4] = 0.03
    with pytest.raises(
        InfeasiblePath, match=r"at 0 mm: it comes too near to a singular position .*in which the wrist [13] turns"
    ):
        check_path(ARM, q, [motion(0.05 * DOWN, q=q)])
    assert drive(ARM, q, motion(0.05 * DOWN, q=q))[0] == "guard"


def test_the_path_of_another_branch_is_another_path() -> None:
    """A motion is followed on the branch on which the arm stands, not on the nearest one to home."""
    X_BF = forward_kinematics(ARM, HOME)
    flipped = nearest_solution(ARM, X_BF, HOME + np.array([0.0, 0.0, 0.0, np.pi, np.pi, np.pi]))
    assert flipped is not None
    assert np.abs(flipped - HOME).max() > 1.0
    found = check_path(ARM, flipped, [motion(0.05 * DOWN)])[0]
    assert np.abs(found.q[-1] - flipped).max() < 0.3


def test_a_weave_does_not_hide_which_way_the_joints_go() -> None:
    """2 mm at 2.3 Hz with a chord of 60 mm: 0.48 rad/s about the tool, and 0.25 s to the next place of a slow weld."""
    slow = motion(0.05 * DOWN, 0.004, share=0.25)
    assert np.allclose(
        check_path(ARM, HOME, [replace(slow, weave_rad_s=0.48)])[0].q, check_path(ARM, HOME, [slow])[0].q
    )
