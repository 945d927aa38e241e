"""Hand-eye solvers: exact where data are exact, the same in every frame and unit, sober about noise and outliers."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.calibration.hand_eye.poses import Array, co_manipulation, eye_in_hand, random_poses
from weldcal.calibration.errors import (
    CoplanarPoses,
    InconsistentPoses,
    PureTranslation,
    RepeatedPoses,
    TooFewPoses,
    UndeterminedPoses,
)
from weldcal.calibration.geometry.se3 import IDENTITY, exp_rotation, inverse, log_rotation, pose
from weldcal.calibration.hand_eye.problem import Problem, full_problem, linearise
from weldcal.calibration.hand_eye.solve import (
    HandEyeConfig,
    HandEyeResult,
    pose_difference,
    solve_ax_xb,
    solve_ax_yb,
    solve_axb_ycz,
    solve_problem,
)
from weldcal.models.errors import InputError, WeldcalError

TURN, SHIFT = np.radians(0.05), 2e-4
QUICK = HandEyeConfig(folds=0)


def fixed(F: Array, G: Array, config: HandEyeConfig = QUICK) -> HandEyeResult:
    return solve_problem(full_problem(F, G), config=config)


def errors(result: HandEyeResult, truth: dict[str, Array]) -> tuple[float, float]:
    e = np.array([pose_difference(result.poses[k], RigidTransform(X)) for k, X in truth.items()])
    return float(np.linalg.norm(e[:, :3], axis=1).max()), float(np.linalg.norm(e[:, 3:], axis=1).max())


@pytest.mark.parametrize("seed", range(3))
def test_exact_poses_give_the_exact_answer_of_each_equation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    F, G, X, Y = eye_in_hand(8, rng)
    # rounding of 1e-16 grows by the condition (under 1e3) of these motions
    assert max(errors(fixed(F, G), {"X": X, "Y": Y})) < 1e-11
    assert max(errors(solve_ax_yb(inverse(F), G, QUICK), {"X": Y, "Y": X})) < 1e-11
    motion_F, motion_G = inverse(F[1:]) @ F[:-1], G[1:] @ inverse(G[:-1])
    assert max(errors(solve_ax_xb(motion_F, motion_G, QUICK), {"X": X})) < 1e-11
    A, B, C, X, Y, Z = co_manipulation(14, rng)
    assert max(errors(solve_axb_ycz(A, B, C, QUICK), {"X": X, "Y": Y, "Z": Z})) < 1e-11


def test_derivatives_agree_with_differences() -> None:
    rng = np.random.default_rng(3)
    A, B, C, X, Y, Z = co_manipulation(6, rng, 0.3, 0.1)
    full = np.array([True, True, True, False, False, False])
    normal = np.array([False, False, False, True, True, False])
    problem = Problem(F=A, G=B, H=C, full=full, normal=normal, covariance=None, free=(True, True, True))
    centre = np.array([0.1, -0.2, 0.05])
    state = (X, Y, Z)
    lin = linearise(problem, state, centre)
    h = 1e-6
    for k in range(problem.size):
        change = np.zeros(problem.size)
        change[k] = h
        up, down = (linearise(problem, problem.step(state, s * change), centre) for s in (1.0, -1.0))
        # central differences: h^2 of truncation and 1e-16 / h of rounding
        np.testing.assert_allclose((up.w - down.w) / (2 * h), lin.Jw[:, :, k], atol=1e-8)
        np.testing.assert_allclose((up.d - down.d) / (2 * h), lin.Jd[:, :, k], atol=1e-8)


@pytest.mark.parametrize("what", ["unit", "frames", "order"])
def test_the_answer_does_not_depend_on_unit_frames_or_order(what: str) -> None:
    rng = np.random.default_rng(5)
    F, G, _, _ = eye_in_hand(25, rng, TURN, SHIFT)
    G[4] = G[4] @ random_poses(1, rng)[0]  # with an outlier too
    base = fixed(F, G)
    left, hand, camera, target = random_poses(4, rng, 1.5)
    if what == "unit":
        F2, G2 = F.copy(), G.copy()
        F2[:, :3, 3] *= 1e3
        G2[:, :3, 3] *= 1e3
        other = fixed(F2, G2)
        back = {k: np.array(P.GetAsMatrix4()) for k, P in other.poses.items()}
        for P in back.values():
            P[:3, 3] /= 1e3
    elif what == "frames":
        other = fixed(left @ F @ hand, camera @ G @ target)
        X, Y = (np.array(other.poses[k].GetAsMatrix4()) for k in "XY")
        back = {"X": hand @ X @ camera, "Y": inverse(left) @ Y @ inverse(target)}
    else:
        order = rng.permutation(25)
        other = fixed(F[order], G[order])
        back = {k: np.array(P.GetAsMatrix4()) for k, P in other.poses.items()}
        assert (other.inliers == base.inliers[order]).all()
    assert int((~base.inliers).sum()) == int((~other.inliers).sum()) == 1
    assert max(errors(base, back)) < 1e-9


def test_thirty_percent_of_gross_outliers_are_flagged_and_cost_little() -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        F, G, X, Y = eye_in_hand(30, rng, TURN, SHIFT)
        bad = np.zeros(30, dtype=bool)
        bad[rng.choice(30, 9, replace=False)] = True
        clean = fixed(F[~bad], G[~bad])
        G[bad] = G[bad] @ random_poses(9, rng, 0.5, 0.1)
        dirty = fixed(F, G)
        assert (dirty.inliers == ~bad).all()
        # the target's bound: 1.2 times the clean fit, whose answer it is here
        for a, b in zip(errors(dirty, {"X": X, "Y": Y}), errors(clean, {"X": X, "Y": Y}), strict=True):
            assert a <= 1.2 * b
        assert "excluded" in dirty.warnings[0]


def test_a_half_turn_camera_and_a_half_turn_hand_are_no_trouble() -> None:
    rng = np.random.default_rng(1)
    F = random_poses(10, rng)
    F[3, :3, :3] = F[0, :3, :3] @ np.diag([1.0, -1.0, -1.0])  # a motion by 180 degrees
    X, Y = pose(np.diag([-1.0, -1.0, 1.0]), np.array([0.1, 0.0, 0.05])), random_poses(1, rng)[0]
    G = inverse(F @ X) @ Y
    assert max(errors(fixed(F, G), {"X": X, "Y": Y})) < 1e-11


def test_degenerate_motion_is_named() -> None:
    rng = np.random.default_rng(2)
    F, G, X, Y = eye_in_hand(12, rng, TURN, SHIFT)
    with pytest.raises(TooFewPoses, match="at least 3"):
        fixed(F[:2], G[:2])
    with pytest.raises(RepeatedPoses, match="repeat only 2"):
        fixed(np.repeat(F[:2], 6, axis=0), np.repeat(G[:2], 6, axis=0))
    F[:, :3, :3] = F[0, :3, :3]
    with pytest.raises(PureTranslation, match="every direction"):
        fixed(F, inverse(F @ X) @ Y)


def test_a_single_axis_leaves_the_translation_along_it_open() -> None:
    rng = np.random.default_rng(4)
    axis = np.array([0.0, 0.6, 0.8])
    R = exp_rotation(rng.uniform(-1.5, 1.5, size=(20, 1)) * axis)
    F = pose(R, rng.normal(size=(20, 3)) * 0.3)
    X, Y = random_poses(2, rng, 1.5)
    for turn, shift in ((0.0, 0.0), (TURN, SHIFT)):
        G = inverse(F @ X) @ Y @ random_poses(20, rng, turn, shift)
        result = fixed(F, G)
        assert len(result.unobservable) == 1
        assert "translation along the common rotation axis" in result.unobservable[0]
        # the covariance is not sure along the axis, and sure across it
        sigma = np.sqrt(np.diag(result.covariance["X"])[3:])
        assert sigma[1:].min() > 1.0
        assert np.isfinite(result.joint_covariance).all()
        e = pose_difference(result.X, RigidTransform(X))
        across = e[3:] - axis * float(e[3:] @ axis)
        assert np.linalg.norm(e[:3]) < 10.0 * TURN + 1e-9
        assert np.linalg.norm(across) < 10.0 * SHIFT


def test_a_wobble_below_the_noise_does_not_pass_for_a_second_axis() -> None:
    rng = np.random.default_rng(6)
    R = exp_rotation(rng.uniform(-1.5, 1.5, size=(30, 1)) * [0.0, 0.0, 1.0] + rng.normal(size=(30, 3)) * 3e-4)
    F = pose(R, rng.normal(size=(30, 3)) * 0.3)
    X, Y = random_poses(2, rng, 1.5)
    result = fixed(F, inverse(F @ X) @ Y @ random_poses(30, rng, TURN, SHIFT))
    assert any("common rotation axis" in s for s in result.unobservable)


def test_poses_that_belong_to_no_rigid_answer_are_refused() -> None:
    rng = np.random.default_rng(7)
    F, _, _, _ = eye_in_hand(20, rng)
    with pytest.raises(InconsistentPoses, match="check units"):
        fixed(F, random_poses(20, rng, 1.5))


def test_no_input_gives_a_nan_or_a_numpy_warning() -> None:
    rng = np.random.default_rng(8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for turn in (0.0, 1e-4, 1e-2, 0.3):
            for n in (3, 4, 6):
                F = random_poses(n, rng, turn)
                X, Y = random_poses(2, rng, 1.5)
                G = inverse(F @ X) @ Y @ random_poses(n, rng, TURN, SHIFT)
                try:
                    result = fixed(F, G)
                except WeldcalError:
                    continue  # a named refusal is an answer too
                assert np.isfinite(result.joint_covariance).all()
                assert np.isfinite(result.X.GetAsMatrix4()).all()


def test_bad_matrices_are_named() -> None:
    rng = np.random.default_rng(9)
    F, G, _, _ = eye_in_hand(5, rng)
    broken = F.copy()
    broken[2, :3, :3] *= 1.1
    with pytest.raises(InputError, match="Pose 2 of 'A'"):
        solve_ax_yb(broken, G)
    broken = G.copy()
    broken[1, 0, 3] = np.nan
    with pytest.raises(InputError, match="first in pose 1"):
        solve_ax_yb(F, broken)
    with pytest.raises(InputError, match="5 robot poses and 4 camera poses"):
        solve_ax_yb(F, G[:4])


def points(
    F: Array, G: Array, known: tuple[Array, Array, Array], free: tuple[bool, bool, bool], normals: bool = False
) -> HandEyeResult:
    n = len(F)
    blind = G.copy()
    if not normals:
        blind[:, :3, :3] = np.eye(3)
    else:  # any turn about the normal: it must not matter
        blind[:, :3, :3] = G[:, :3, :3] @ exp_rotation(np.linspace(0.0, 5.0, n)[:, None] * [0.0, 0.0, 1.0])
    H = np.broadcast_to(IDENTITY, (n, 4, 4))
    problem = Problem(
        F=F, G=blind, H=H, full=np.zeros(n, dtype=bool), normal=np.full(n, normals), covariance=None, free=free
    )
    return solve_problem(problem, known, config=QUICK)


def test_points_alone_find_the_camera_on_the_base() -> None:
    rng = np.random.default_rng(10)
    F, G, X, Y = eye_in_hand(12, rng, 0.0, SHIFT)
    known = points(F, G, (IDENTITY, Y, IDENTITY), (True, False, False))
    assert known.normalised_error("X", RigidTransform(X)) < known.region(0.999)
    assert np.isnan(known.rotation_rad).all()
    # the place of the point in the hand unknown: X and that place follow together
    Y_place = pose(np.eye(3), Y[:3, 3])
    free = points(F, G, (IDENTITY, pose(np.eye(3), np.zeros(3)), IDENTITY), (True, True, False))
    assert any("rotation" in s and s.endswith(": Y") for s in free.unobservable)
    assert np.linalg.norm(free.Y.translation() - Y_place[:3, 3]) < 20.0 * SHIFT
    assert free.normalised_error("X", RigidTransform(X)) < free.region(0.999)


def test_normals_add_to_points_what_they_know() -> None:
    rng = np.random.default_rng(11)
    F, G, X, Y = eye_in_hand(12, rng, TURN, SHIFT)
    alone = points(F, G, (IDENTITY, Y, IDENTITY), (True, False, False))
    both = points(F, G, (IDENTITY, Y, IDENTITY), (True, False, False), normals=True)
    assert both.normalised_error("X", RigidTransform(X)) < both.region(0.999)
    assert np.trace(both.covariance["X"][:3, :3]) < np.trace(alone.covariance["X"][:3, :3])


def test_points_in_one_plane_or_on_one_line_are_refused() -> None:
    rng = np.random.default_rng(12)
    X, Y = random_poses(2, rng)
    p = rng.normal(size=(10, 3)) * [0.3, 0.3, 0.0]
    F = inverse(pose(np.eye(3), p))
    G = inverse(F @ X) @ Y
    with pytest.raises(CoplanarPoses, match="one plane"):
        points(F, G, (IDENTITY, Y, IDENTITY), (True, False, False))
    p[:, 1] = 0.0
    F = inverse(pose(np.eye(3), p))
    with pytest.raises(CoplanarPoses, match="one line"):
        points(F, inverse(F @ X) @ Y, (IDENTITY, Y, IDENTITY), (True, False, False))


def test_stated_covariances_are_believed() -> None:
    rng = np.random.default_rng(13)
    F, G, X, Y = eye_in_hand(30, rng)
    sigma = np.where(np.arange(30) < 15, 1e-5, 2e-3)  # half of the observations are two hundred times worse
    G = G @ pose(exp_rotation(rng.normal(size=(30, 3)) * sigma[:, None]), rng.normal(size=(30, 3)) * sigma[:, None])
    C = np.eye(6) * sigma[:, None, None] ** 2
    plain = solve_ax_yb(inverse(F), G, QUICK)
    told = solve_ax_yb(inverse(F), G, QUICK, covariance=C)
    truth = {"X": Y, "Y": X}
    assert errors(told, truth)[1] < 0.3 * errors(plain, truth)[1]
    assert told.normalised_error("Y", RigidTransform(X)) < told.region(0.999)


def test_three_unknowns_from_any_start_reach_the_same_answer() -> None:
    rng = np.random.default_rng(14)
    A, B, C, X, Y, Z = co_manipulation(30, rng, np.radians(0.02), 1e-4)
    result = solve_axb_ycz(A, B, C)
    for name, truth in (("X", X), ("Y", Y), ("Z", Z)):
        assert result.normalised_error(name, RigidTransform(truth)) < result.region(0.999)
    assert result.held_out.rms_deg < 3.0 * 0.02 * np.sqrt(3.0)
    assert result.held_out.rms_translation < 3.0 * 1e-4 * np.sqrt(3.0)


def test_too_much_left_open_is_an_error_not_an_answer() -> None:
    rng = np.random.default_rng(15)
    F = pose(exp_rotation(rng.uniform(-1.5, 1.5, size=(20, 1)) * [0.0, 0.0, 1.0]), np.zeros((20, 3)))
    X, Y = random_poses(2, rng, 1.5)
    # one axis through the base and no translation: the camera may also turn about that axis
    with pytest.raises(UndeterminedPoses, match="directions of the camera's pose open"):
        fixed(F, inverse(F @ X) @ Y)


def test_rotation_logarithm_is_the_shortest() -> None:
    rng = np.random.default_rng(16)
    w = rng.normal(size=(50, 3))
    w *= (rng.uniform(0.0, 3.1, size=50) / np.linalg.norm(w, axis=1))[:, None]
    np.testing.assert_allclose(log_rotation(exp_rotation(w)), w, atol=1e-12)
