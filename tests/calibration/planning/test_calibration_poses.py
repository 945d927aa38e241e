"""Planned poses are reachable, clear and in view, spread in space and in tilt, and a hopeless scanner is said so."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.planning.calibration_poses import (
    PlannedPose,
    PlannerConfig,
    plan_calibration_poses,
    predicted_sigma,
)
from weldcal.calibration.planning.clearance import arm_bodies, lowest_point, occludes
from weldcal.models.arms.kinematics import forward_kinematics, link_frames, load_arm
from weldcal.models.errors import InputError
from weldcal.models.scanners import get_scanner

ARM = load_arm("ur10e")
SCANNER = get_scanner("phoxi_m", 824)
X_BC = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [-0.65, -0.2, 1.3])
X_FR = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.14, 0.0, -0.012])
Q_START = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
CONFIG = PlannerConfig()


@pytest.fixture(scope="module")
def planned() -> list[PlannedPose]:
    return plan_calibration_poses(ARM, X_FR, X_BC, SCANNER, 10, q_start=Q_START)


def test_joints_put_the_feature_where_the_plan_says(planned: list[PlannedPose]) -> None:
    for pose in planned:
        X_BF = forward_kinematics(ARM, pose.q)
        assert np.allclose(X_BF.GetAsMatrix34(), pose.X_BF.GetAsMatrix34(), atol=1e-7)
        assert np.allclose((X_BF @ X_FR).GetAsMatrix34(), pose.X_BR.GetAsMatrix34(), atol=1e-7)
        assert (pose.q >= ARM.position_lower).all()
        assert (pose.q <= ARM.position_upper).all()
        assert np.abs(pose.q - Q_START).max() <= CONFIG.max_travel_rad


def test_the_feature_is_in_view_faces_the_scanner_and_is_not_hidden(planned: list[PlannedPose]) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 60)
    ring = 0.0315 * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    bodies = arm_bodies(ARM)
    for pose in planned:
        X_CR = X_BC.inverse() @ pose.X_BR
        p = (X_CR @ ring.T).T
        u = SCANNER.fx * p[:, 0] / p[:, 2] + SCANNER.cx
        v = SCANNER.fy * p[:, 1] / p[:, 2] + SCANNER.cy
        # the tilt of the ring takes a little of the 8 % margin
        assert (u > 0.06 * SCANNER.width).all()
        assert (u < 0.94 * SCANNER.width).all()
        assert (v > 0.06 * SCANNER.height).all()
        assert (v < 0.94 * SCANNER.height).all()
        assert (p[:, 2] > SCANNER.near_m).all()
        assert (p[:, 2] < SCANNER.far_m).all()
        sight = -X_CR.translation() / np.linalg.norm(X_CR.translation())
        assert np.arccos(sight @ X_CR.rotation().matrix()[:, 2]) <= CONFIG.theta_max_rad + 1e-9
        frames = link_frames(ARM, pose.q)
        assert not occludes(bodies, frames, X_BC.translation(), (pose.X_BR @ ring.T).T)[0]
        assert lowest_point(bodies, frames) >= CONFIG.table_z_m + CONFIG.margin_m


def test_poses_span_space_and_tilt(planned: list[PlannedPose]) -> None:
    p = np.array([pose.X_BR.translation() for pose in planned])
    assert np.linalg.svd(p - p.mean(axis=0), compute_uv=False)[2] / np.sqrt(len(p)) > 0.02
    normals = np.array([pose.X_BR.rotation().matrix()[:, 2] for pose in planned])
    assert np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min())) > 20.0
    first = np.array([pose.X_BR.translation() for pose in planned[:4]])
    assert np.linalg.svd(first - first.mean(axis=0), compute_uv=False)[2] > 0.01


def test_every_pose_adds_and_the_prediction_falls(planned: list[PlannedPose]) -> None:
    sigma = [pose.sigma_m for pose in planned]
    assert all(b < a for a, b in itertools.pairwise(sigma))
    assert all(pose.gain > 0.0 for pose in planned)


def test_a_plan_tells_more_than_poses_taken_at_random(planned: list[PlannedPose]) -> None:
    work = tuple(np.mean([pose.X_BR.translation() for pose in planned], axis=0))
    config = PlannerConfig(work_point_B=work)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    crowd = [
        pose.X_BR @ RigidTransform(RollPitchYaw(*(0.05 * rng.standard_normal(3))), 0.02 * rng.standard_normal(3))
        for pose in [planned[0]] * 10
    ]
    assert predicted_sigma([pose.X_BR for pose in planned], X_BC, config) < 0.3 * predicted_sigma(crowd, X_BC, config)


def test_a_scanner_out_of_reach_is_named() -> None:
    with pytest.raises(UnreachableScanner, match="out of the arm's reach"):
        plan_calibration_poses(
            ARM,
            X_FR,
            RigidTransform(X_BC.rotation(), [-3.5, 0.0, 1.3]),
            SCANNER,
            6,
            q_start=Q_START,
            config=PlannerConfig(max_trials=200),
        )


def test_a_scanner_that_looks_at_the_table_from_below_its_range_is_named() -> None:
    low = RigidTransform(X_BC.rotation(), [-0.65, -0.2, 0.3])
    with pytest.raises(UnreachableScanner, match="the table is in the way"):
        plan_calibration_poses(ARM, X_FR, low, SCANNER, 6, q_start=Q_START, config=PlannerConfig(max_trials=200))


def test_fewer_than_four_poses_are_not_a_plan() -> None:
    with pytest.raises(InputError, match="at least 4 poses"):
        plan_calibration_poses(ARM, X_FR, X_BC, SCANNER, 3, q_start=Q_START)
