"""The estimator on poses whose answer is known: exact, robust, honest, and able to say what it cannot see."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.errors import CoplanarPoses, InconsistentPoses, RepeatedPoses, TooFewPoses
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base, point_error_covariance
from weldcal.calibration.eye_on_base.validation import sampling_advice
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, fit_rigid, rotation_vector
from weldcal.models.errors import InputError

X_BC = RigidTransform(RollPitchYaw(np.pi - 0.1, 0.2, 0.7), [-0.6, -0.3, 1.1])


def make_observations(
    n: int, seed: int, *, sigma: float = 2e-4, sigma_n: float = 1e-3, normals: bool = True, turn: float = 0.4
) -> list[Observation]:
    """n observations in a box of 0.3 x 0.25 x 0.3 m before the camera, with Gaussian noise."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(n):
        p_C = np.array([rng.uniform(-0.15, 0.15), rng.uniform(-0.12, 0.12), rng.uniform(0.55, 0.85)])
        R_CR = RollPitchYaw(np.pi + rng.uniform(-turn, turn), rng.uniform(-turn, turn), rng.uniform(-turn, turn))
        X_BR = X_BC @ RigidTransform(R_CR, p_C)
        n_C = exp_rotation(sigma_n * rng.standard_normal(3)) @ R_CR.ToRotationMatrix().matrix()[:, 2]
        out.append(Observation(f"p{k}", X_BR, p_C + sigma * rng.standard_normal(3), n_C if normals else None))
    return out


def displaced(observation: Observation, shift: np.ndarray) -> Observation:
    return Observation(observation.id, observation.X_BR, observation.p_CR + shift, observation.n_C)


def tangent_error(X: RigidTransform) -> np.ndarray:
    """[rotation; translation] in the tangent that the covariance is stated in."""
    return np.concatenate(
        [rotation_vector(X.rotation() @ X_BC.rotation().inverse()), X.translation() - X_BC.translation()]
    )


@pytest.mark.parametrize("normals", [True, False])
def test_exact_observations_give_the_exact_pose(normals: bool) -> None:
    estimate = estimate_eye_on_base(make_observations(6, 0, sigma=0.0, sigma_n=0.0, normals=normals))
    assert np.abs(tangent_error(estimate.X_BC)).max() < 1e-8
    assert estimate.inliers.all()


def test_covariance_predicts_the_error() -> None:
    normalised, at_work = [], []
    p_BQ = X_BC @ np.array([0.05, 0.0, 0.7])
    for seed in range(60):
        estimate = estimate_eye_on_base(make_observations(10, seed), SolveConfig(leave_one_out=False, hypotheses=60))
        e = tangent_error(estimate.X_BC)
        normalised.append(float(e @ np.linalg.solve(estimate.covariance, e)) / 6.0)
        q = estimate.X_BC @ (X_BC.inverse() @ p_BQ) - p_BQ
        at_work.append(float(q @ np.linalg.solve(point_error_covariance(estimate, p_BQ), q)) / 3.0)
    # mean of 360 (180) chi-square values: sigma 0.075 (0.105); variances estimated from 10 poses add a few per cent
    assert 0.7 < np.mean(normalised) < 1.5
    assert 0.6 < np.mean(at_work) < 1.6


def test_variance_components_come_out_of_the_residuals() -> None:
    estimate = estimate_eye_on_base(make_observations(60, 3), SolveConfig(leave_one_out=False))
    # 174 and 120 degrees of freedom: 5 and 7 per cent; Huber weights take a few per cent more
    assert estimate.sigma_position_m == pytest.approx(2e-4, rel=0.2)
    assert estimate.sigma_normal_rad == pytest.approx(1e-3, rel=0.25)


@pytest.mark.parametrize(("n", "bad"), [(23, 8), (63, 3), (12, 4)])
def test_gross_outliers_are_found_and_do_not_move_the_pose(n: int, bad: int) -> None:
    rng = np.random.default_rng(n)
    observations = make_observations(n, n)
    for k in range(bad):
        shift = rng.standard_normal(3)
        observations[k] = displaced(observations[k], rng.uniform(0.01, 0.08) * shift / np.linalg.norm(shift))
    estimate = estimate_eye_on_base(observations)
    clean = estimate_eye_on_base(observations[bad:])
    assert not estimate.inliers[:bad].any()
    assert estimate.inliers[bad:].all()
    assert np.allclose(tangent_error(estimate.X_BC), tangent_error(clean.X_BC), atol=1e-7)
    assert "p0" in estimate.warnings[0]


def test_held_out_errors_are_larger_than_residuals_and_match_fresh_poses() -> None:
    ratio = []
    for seed in range(8):
        estimate = estimate_eye_on_base(make_observations(8, seed))
        fresh = make_observations(60, 1000 + seed)
        true = np.mean([np.linalg.norm(estimate.X_BC @ o.p_CR - o.p_BR) for o in fresh])
        assert estimate.held_out.position_m.mean() > estimate.position_residuals_m.mean()
        ratio.append(estimate.held_out.position_m.mean() / true)
    # leave-one-out judges 7-pose fits on 64 errors: 8 per cent of scatter, a few per cent of pessimism
    assert 0.8 < np.mean(ratio) < 1.35


def test_same_data_give_the_same_bits() -> None:
    a, b = (estimate_eye_on_base(make_observations(40, 5)) for _ in range(2))
    assert (a.X_BC.GetAsMatrix34() == b.X_BC.GetAsMatrix34()).all()
    assert (a.held_out.position_m == b.held_out.position_m).all()


def test_three_poses_are_too_few() -> None:
    with pytest.raises(TooFewPoses, match="at least 4 usable poses"):
        estimate_eye_on_base(make_observations(3, 0))


def test_coplanar_and_collinear_and_repeated_poses_are_named() -> None:
    def at(points: list[tuple[float, float, float]]) -> list[Observation]:
        return [
            Observation(f"p{k}", RigidTransform(np.array(p)), np.array(X_BC.inverse() @ np.array(p)))
            for k, p in enumerate(points)
        ]

    with pytest.raises(CoplanarPoses, match="lie in one plane"):
        estimate_eye_on_base(at([(0, 0, 0.5), (0.2, 0, 0.5), (0, 0.2, 0.5), (0.2, 0.2, 0.5)]))
    with pytest.raises(CoplanarPoses, match="lie on one line"):
        estimate_eye_on_base(at([(0, 0, 0.5), (0.1, 0, 0.5), (0.2, 0, 0.5), (0.3, 0, 0.5)]))
    with pytest.raises(RepeatedPoses, match="repeat only 3 places"):
        estimate_eye_on_base(at([(0, 0, 0.5), (0.1, 0, 0.5), (0, 0.2, 0.6), (0.0001, 0, 0.5), (0, 0.0001, 0.5)]))


def test_poses_of_different_cameras_are_refused() -> None:
    rng = np.random.default_rng(0)
    observations = [displaced(o, rng.uniform(-0.3, 0.3, 3)) for o in make_observations(12, 0)]
    with pytest.raises(InconsistentPoses, match="poses disagree by"):
        estimate_eye_on_base(observations)


def test_two_tilted_poses_with_normals_are_enough_when_asked() -> None:
    relaxed = SolveConfig(min_poses=2, allow_coplanar=True, leave_one_out=False)
    estimate = estimate_eye_on_base(make_observations(2, 4, sigma=0.0, sigma_n=0.0), relaxed)
    assert np.abs(tangent_error(estimate.X_BC)).max() < 1e-6


def test_constant_orientation_hides_a_bias_of_the_centre_and_it_is_said() -> None:
    still = estimate_eye_on_base(make_observations(10, 1, turn=0.0))
    turned = estimate_eye_on_base(make_observations(10, 1, turn=0.5))
    assert any(
        "constant bias of the flange centre" in s and "along x, y, z" in s and "looks like" in s
        for s in still.unobservable
    )
    assert not any("constant bias" in s and "looks like" in s for s in turned.unobservable)


def test_pairs_without_orientations_are_not_told_how_far_they_turned() -> None:
    """Their poses carry the identity, which is no measured turn of zero degrees."""
    observations = [Observation(o.id, RigidTransform(o.p_BR), o.p_CR) for o in make_observations(12, 3, normals=False)]
    estimate = estimate_eye_on_base(observations)
    said = [*estimate.unobservable, *sampling_advice(estimate, observations)]
    assert any("no orientations are given, so it looks like a shift of the camera" in s for s in said)
    assert any(s.startswith("Give the orientations of the poses") for s in said)
    assert not any("0.0 degrees" in s for s in said)


def test_numbers_that_are_not_finite_are_refused_at_the_door() -> None:
    with pytest.raises(InputError, match="three finite numbers"):
        Observation("p0", RigidTransform(), np.array([0.0, np.nan, 1.0]))


def test_closed_form_is_a_rotation_even_for_mirrored_noise() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        X = fit_rigid(rng.standard_normal((4, 3)), rng.standard_normal((4, 3)))
        assert np.linalg.det(X.rotation().matrix()) == pytest.approx(1.0)
    assert isinstance(fit_rigid(rng.standard_normal((5, 3)), rng.standard_normal((5, 3))).rotation(), RotationMatrix)
    with pytest.raises(ValueError, match="collinear"):
        fit_rigid(np.outer(np.arange(4.0), [1, 0, 0]), np.outer(np.arange(4.0), [0, 1, 0]))


def test_normals_that_contradict_the_poses_are_refused_although_the_centres_agree() -> None:
    # the quaternion's numbers in another order: one orientation for all poses, so that centres alone cannot show it
    rolled = RigidTransform(RollPitchYaw(1.3, 0.4, 0.2), np.zeros(3))
    turned = [
        Observation(o.id, RigidTransform(rolled.rotation(), o.p_BR), o.p_CR, X_BC.rotation().matrix()[2])
        for o in make_observations(8, 5)
    ]
    with pytest.raises(InconsistentPoses, match="quaternion order"):
        estimate_eye_on_base(turned)
