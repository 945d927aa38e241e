"""The visible arm puts the scanner to some centimetres where the flange alone does not, and refuses what is no arm of
its kind."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.calibration.eye_on_base.arm_cells import START_M, ArmCell, arm_cell, write_cell
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.errors import FlangeNotFound, InconsistentPoses, TooFewPoses
from weldcal.calibration.eye_on_base.arm_start import (
    ArmShape,
    ArmStart,
    arm_shape,
    capsule_distance,
    face_guess,
    find_arm,
    start_from_arm,
)
from weldcal.models.arms.chain import known_chains, load_chain
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.tools.recorded import calibrate_dataset

FAR = 13  # a Franka at 1.4 m that shows its flange in three of eight scans; none is found without help


@cache
def cell(seed: int) -> ArmCell:
    return arm_cell(seed)


def off(one: ArmCell, X_BC: RigidTransform) -> float:
    """Error at the scanned flanges, m."""
    work = np.mean([X.translation() for X in one.X_BF], axis=0)
    return float(np.linalg.norm(X_BC @ (one.X_BC.inverse() @ work) - work))


@pytest.mark.parametrize("seed", [1, FAR])
@pytest.mark.parametrize("scans", [2])
def test_the_arm_in_few_scans_shows_the_scanner(seed: int, scans: int) -> None:
    one = cell(seed)
    arm = load_chain(one.arm)
    start = find_arm(one.clouds[:scans], [arm_shape(arm, q) for q in one.q[:scans]])
    assert start is not None
    assert start.accepted
    assert off(one, start.X_BC) < START_M


def test_other_joint_angles_are_no_start() -> None:
    one = cell(1)
    arm = load_chain(one.arm)
    wrong = one.q[:3][::-1] + np.array([0.0, 0.6, -0.9, 0.5, 0.8, 0.0])
    start = find_arm(one.clouds[:3], [arm_shape(arm, q) for q in wrong])
    assert start is None or not start.accepted


def test_scans_without_an_arm_are_no_start() -> None:
    one = cell(1)
    arm = load_chain(one.arm)
    still = [one.clouds[0]] * 3
    assert find_arm(still, [arm_shape(arm, q) for q in one.q[:3]]) is None
    assert find_arm([np.full((4, 4, 3), np.nan)], [arm_shape(arm, one.q[0])]) is None


def test_three_far_flanges_are_enough_beside_the_arm(tmp_path: Path) -> None:
    one = cell(FAR)
    write_cell(one, tmp_path / "cell")
    report = calibrate_dataset(tmp_path / "cell", tmp_path / "out")
    assert off(one, report.result.X_BC) < 0.003
    assert any("visible arm agrees" in text for text in report.result.warnings)


def test_without_joint_angles_a_franka_is_refused(tmp_path: Path) -> None:
    write_cell(cell(FAR), tmp_path / "cell", joints=False)
    with pytest.raises((TooFewPoses, InputError), match=r"usable poses|clouds can be used"):
        calibrate_dataset(tmp_path / "cell", tmp_path / "out")


def test_a_ur_needs_no_joint_angles(tmp_path: Path) -> None:
    one = cell(1)
    write_cell(one, tmp_path, joints=False)
    start = start_from_arm(load_dataset(tmp_path).between(":p01"), one.arm)
    assert start is not None
    assert start.accepted
    assert off(one, start.X_BC) < START_M


def test_joint_angles_that_lead_elsewhere_are_no_start(tmp_path: Path) -> None:
    one = cell(FAR)  # no closed form gives other angles
    write_cell(replace(one, q=one.q + 0.2), tmp_path)
    assert start_from_arm(load_dataset(tmp_path), one.arm) is None


def test_a_calibration_elsewhere_contradicts_the_arm() -> None:
    start = ArmStart(RigidTransform(), 0.9, 0.0, 0.9, -1.0)
    p = np.array([[0.5, 0.0, 1.0]])
    assert "10 mm and 0.0 degrees" in start.agreement(RigidTransform([0.0, 0.01, 0.0]), p)
    for X in (RigidTransform([0.0, 0.07, 0.0]), RigidTransform(RollPitchYaw(0.0, 0.0, 0.5), np.zeros(3))):
        with pytest.raises(InconsistentPoses, match="apart"):
            start.agreement(X, p)


def test_distances_from_capsules_are_those_of_their_points() -> None:
    rng = np.random.default_rng(0)
    shape = ArmShape(rng.normal(size=(4, 2, 3)), rng.uniform(0.1, 0.3, 4))
    points = 2.0 * rng.normal(size=(50, 3))
    along = np.linspace(0.0, 1.0, 4001)[:, None]
    far = [
        min(
            float(np.linalg.norm(a + along * (b - a) - p, axis=1).min()) - r
            for (a, b), r in zip(shape.ends, shape.radii, strict=True)
        )
        for p in points
    ]
    d, gradient = capsule_distance(points, shape)
    assert d == pytest.approx(far, abs=1e-3)
    ahead = np.array([capsule_distance(points + h, shape)[0] for h in 1e-6 * np.eye(3)]).T
    assert (ahead - d[:, None]) / 1e-6 == pytest.approx(gradient, abs=1e-3)


@pytest.mark.parametrize("name", known_chains())
def test_every_arm_has_capsules_at_its_flange(name: str) -> None:
    arm = load_chain(name)
    q = 0.5 * (arm.position_lower + arm.position_upper)
    p = forward_kinematics(arm, q).translation()
    assert abs(capsule_distance(np.array([p]), arm_shape(arm, q))[0][0]) < 0.06


def test_the_face_is_found_from_a_pose_two_centimetres_off() -> None:
    one = cell(FAR)
    standard = get_flange(one.flange)
    X_CR = one.X_BC.InvertAndCompose(one.X_BF[0])
    rough = RigidTransform(RollPitchYaw(0.02, -0.02, 0.0), [0.012, -0.01, 0.01]) @ X_CR
    guess = face_guess(one.clouds[0].reshape(-1, 3), RigidTransform(X_CR.rotation(), rough.translation()), standard)
    assert np.linalg.norm(guess.center_C - X_CR.translation()) < 0.003
    with pytest.raises(FlangeNotFound, match="turned away or hidden"):
        face_guess(one.clouds[0].reshape(-1, 3) + 1.0, X_CR, standard)


def test_half_a_face_is_found() -> None:
    standard = get_flange("iso9409-1-50-4-m6")
    x, y = (g.ravel() for g in np.meshgrid(*[np.arange(-0.04, 0.04, 0.001)] * 2))
    rho = np.hypot(x, y)
    half = (rho < standard.outer_radius_m) & (rho > standard.bore_radius_m) & (x > 0.0)
    points = np.column_stack([x, y, np.full(len(x), 1.0)])[half]
    X_CR = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [-0.01, 0.005, 1.01])
    assert np.linalg.norm(face_guess(points, X_CR, standard).center_C - [0.0, 0.0, 1.0]) < 0.003


def test_an_arm_that_is_seen_through_is_no_start() -> None:
    sure = ArmStart(RigidTransform(), 0.9, 0.05, 0.85, 0.1)
    assert sure.accepted
    for other in ({"explained": 0.6}, {"seen_through": 0.2}, {"next_best": 0.84}):
        assert not replace(sure, **other).accepted
        assert "state scanner_guess" in replace(sure, **other).sentence


def test_surface_seen_through_is_allowed_only_where_nothing_else_comes_near() -> None:
    """Links inside their capsules: 0.15 of a rendered UR10e's surface is seen through; a wrong place leads by less than
    0.2."""
    start = ArmStart(X_BC=RigidTransform(), explained=0.82, seen_through=0.15, score=0.67, next_best=0.1)
    assert start.accepted
    assert not replace(start, next_best=0.45).accepted
    assert not replace(start, seen_through=0.2, score=0.62).accepted
    assert not replace(start, explained=0.7).accepted
