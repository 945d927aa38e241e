"""Camera and pen on the wrist: exact without noise, sure of what they say with it, and open about what touches leave
open."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.errors import EqualRotations, TabletDataError, TooFewLandmarks
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.calibration.tablet.wrist.fit import WristTouches, fit_wrist, measured_point
from weldcal.models.arrays import Array

X_FC = RigidTransform(RollPitchYaw(0.03, -0.05, 1.5), [0.06, 0.02, 0.05])
P_FP = np.array([-0.002, -0.021, 0.163])
X_BT = RigidTransform(RollPitchYaw(np.pi + 0.01, -0.02, 0.4), [0.5, -0.1, 0.02])
GRID = np.array([[0.06 * i, 0.038 * j] for j in range(3) for i in range(3)])
FOCAL = 617.7


def visit(
    *,
    tilt: float,
    touch_m: float = 0.0,
    pixel: float = 0.0,
    seed: int = 0,
    views: int = 1,
    across: float = 1.0,
    p_FP: Array = P_FP,
) -> WristTouches:
    """Nine touches beside the landmarks, the hand turned by 22.5 deg each time and tilted by up to ``tilt`` deg;
    ``across`` the tablet the noise is so many times that along it."""
    rng = np.random.default_rng(seed)
    touched = GRID + rng.normal(0.0, 0.5e-3, GRID.shape)
    poses = []
    for k, p in enumerate(touched):
        lean = np.radians(tilt) * rng.uniform(-1.0, 1.0, 2)
        R = RollPitchYaw(np.pi + lean[0], lean[1], np.radians(-90.0 + 22.5 * k)).ToRotationMatrix()
        tip = X_BT.multiply(np.r_[p, 0.0]) + X_BT.rotation().multiply(rng.normal(0.0, touch_m, 3) * [1, 1, across])
        poses.append(RigidTransform(R, tip - R.multiply(p_FP)))
    taken = []
    for k in range(views):
        X_BF = RigidTransform(RollPitchYaw(np.pi + 0.15 * k, 0.1 * k, -1.0 + 0.5 * k), [0.5 + 0.02 * k, -0.1, 0.40])
        p_C = (X_FC.inverse() @ X_BF.inverse() @ X_BT).multiply(np.c_[GRID, np.zeros(9)].T)
        taken.append((X_BF, (p_C[:2] / p_C[2]).T + rng.normal(0.0, pixel / FOCAL, (9, 2))))
    return WristTouches(tuple(poses), touched, GRID, tuple(taken), FOCAL)


def test_without_noise_camera_pen_and_tablet_are_found() -> None:
    fit = fit_wrist(visit(tilt=15.0))
    assert fit.X_FC.IsNearlyEqualTo(X_FC, 1e-7)
    assert fit.X_BT.IsNearlyEqualTo(X_BT, 1e-7)
    np.testing.assert_allclose(fit.p_FP, P_FP, atol=1e-7)
    assert fit.leave_one_out_m.max() < 1e-7
    assert fit.unobservable == ()


def test_an_upright_pen_leaves_its_length_open_and_says_so() -> None:
    data = visit(tilt=0.0, touch_m=0.1e-3, pixel=0.1)
    fit = fit_wrist(data)
    (sentence,) = fit.unobservable
    assert "along the flange's z" in sentence
    assert "tilt the hand" in sentence
    np.testing.assert_allclose(fit.p_FP[:2], P_FP[:2], atol=0.3e-3)
    assert np.sqrt(fit.pen_covariance[2, 2]) > 0.5
    # where the pen touches what the camera sees does not need the length
    assert 1e3 * np.median(fit.leave_one_out_m) < 0.4
    told = fit_wrist(data, pen_length_m=float(P_FP[2]), leave_one_out=False)
    assert told.unobservable == ()
    assert np.linalg.norm(told.X_FC.translation() - X_FC.translation()) < 2e-3


def test_the_covariance_is_that_of_the_errors() -> None:
    squares = []
    for seed in range(25):
        fit = fit_wrist(visit(tilt=15.0, touch_m=0.15e-3, pixel=0.15, seed=seed, views=2), leave_one_out=False)
        turn = rotation_vector(fit.X_FC.rotation() @ X_FC.rotation().inverse())
        e = np.r_[turn, fit.X_FC.translation() - X_FC.translation()]
        squares.append(e @ np.linalg.solve(fit.covariance, e))
    # chi-square with 6 degrees of freedom, some more for estimated variances: mean 6.8, its standard error 0.8, three
    # of them
    assert 6.8 - 2.4 < np.mean(squares) < 6.8 + 2.4


def test_the_pen_is_as_sure_as_it_says_where_the_glass_is_noisier_than_the_arm() -> None:
    squares = []
    for seed in range(25):
        data = visit(tilt=12.0, touch_m=0.06e-3, pixel=0.1, seed=seed, across=0.2)
        fit = fit_wrist(data, leave_one_out=False)
        squares.append((fit.p_FP - P_FP) @ np.linalg.solve(fit.pen_covariance, fit.p_FP - P_FP))
    # chi-square with 3 degrees of freedom over a variance from 12: mean 3.6, its standard error 0.6, two of them (one
    # scatter for all directions: 5.6)
    assert 3.6 - 1.2 < np.mean(squares) < 3.6 + 1.2


def test_a_seen_point_is_where_the_tablet_lies() -> None:
    data = visit(tilt=15.0)
    fit = fit_wrist(data, leave_one_out=False)
    X_BF, rays = data.views[0]
    for p, ray in zip(GRID, rays, strict=True):
        np.testing.assert_allclose(measured_point(fit, X_BF, ray), X_BT.multiply(np.r_[p, 0.0]), atol=1e-7)


def test_what_fixes_nothing_is_named() -> None:
    data = visit(tilt=0.0)
    with pytest.raises(TooFewLandmarks):
        fit_wrist(data.pick(np.arange(9) < 3))
    with pytest.raises(EqualRotations):
        fit_wrist(WristTouches((data.X_BF[0],) * 9, data.touched_m, GRID, data.views, FOCAL))
    with pytest.raises(TabletDataError, match="no image"):
        fit_wrist(WristTouches(data.X_BF, data.touched_m, GRID, (), FOCAL))
