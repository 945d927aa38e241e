"""Every flange pose that an arm can reach is found from all sides, exactly, on nominal and calibrated kinematics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.worlds.other_arms import TABLES, pose_by_table
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.inverse import RESIDUAL, inverse_kinematics, nearest_solution, why_unreached
from weldcal.models.arms.kinematics import ArmModel, Chain, forward_kinematics, load_arm, sigma_min
from weldcal.models.arms.kinematics import jacobian as arm_jacobian
from weldcal.models.errors import InputError

Array = NDArray[np.float64]


def calibrated_arm(seed: int = 5) -> ArmModel:
    """The nominal arm with each link moved by about a millimetre and turned by about a milliradian."""
    arm = load_arm()
    rng = np.random.default_rng(seed)
    stack = np.array(
        [
            X @ RigidTransform(RollPitchYaw(rng.normal(0, 1e-3, 3)), rng.normal(0, 1e-3, 3)).GetAsMatrix4()
            for X in arm.stack
        ]
    )
    return replace(arm, stack=stack)


def apart(q: Array, other: Array) -> float:
    """Largest joint difference, full turns aside (rad)."""
    return float(np.abs((q - other + np.pi) % (2 * np.pi) - np.pi).max())


def residual(arm: ArmModel, q: Array, X_BF: RigidTransform) -> float:
    X_error = X_BF.inverse() @ forward_kinematics(arm, q)
    # The skew part, not arccos: it resolves angles below 1e-8.
    R = X_error.rotation().matrix()
    tilt = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    return float(max(tilt, np.linalg.norm(X_error.translation()), 0.0 if np.trace(R) > 1 else np.inf))


def assert_solutions(arm: ArmModel, X_BF: RigidTransform, solutions: Array) -> None:
    assert solutions.ndim == 2
    assert solutions.shape[1] == 6
    assert solutions.shape[0] <= 8
    for i, q in enumerate(solutions):
        assert residual(arm, q, X_BF) < RESIDUAL
        assert (np.abs(q) <= np.pi + 1e-12).all()
        assert (q >= arm.position_lower).all()
        assert (q <= arm.position_upper).all()
        assert all(apart(q, other) > 1e-6 for other in solutions[:i])


def test_every_configuration_is_found_again_from_its_flange_pose() -> None:
    arm = load_arm()
    full = 0
    for q in np.random.default_rng(0).uniform(-np.pi, np.pi, (500, 6)):
        X_BF = forward_kinematics(arm, q)
        solutions = inverse_kinematics(arm, X_BF)
        assert_solutions(arm, X_BF, solutions)
        # The closed form amplifies rounding by 1 / sin of the wrist and elbow angles; 1e-6 leaves ten digits for that.
        assert min(apart(q, other) for other in solutions) < 1e-6
        full += len(solutions) == 8
    assert full > 250


def test_calibrated_kinematics_are_solved_on_the_arm_itself() -> None:
    arm = calibrated_arm()
    checked = 0
    for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (200, 6)):
        if sigma_min(arm_jacobian(arm, q)) < 0.03:
            continue  # millimetres of calibration may merge two branches at a singularity
        X_BF = forward_kinematics(arm, q)
        solutions = inverse_kinematics(arm, X_BF)
        assert_solutions(arm, X_BF, solutions)
        assert min(apart(q, other) for other in solutions) < 1e-6
        checked += 1
    assert checked > 100


def test_a_pose_out_of_reach_has_no_solution() -> None:
    arm = load_arm()
    R_down = RollPitchYaw(np.pi, 0, 0)
    for p in ([1.6, 0.0, 0.3], [0.0, 0.0, 2.5], [0.0, 0.0, 0.4]):  # too far, too high, inside the shoulder's cylinder
        X_BF = RigidTransform(R_down, p)
        assert inverse_kinematics(arm, X_BF).shape == (0, 6)
        assert nearest_solution(arm, X_BF, np.zeros(6)) is None


def test_just_out_of_reach_is_out_of_reach() -> None:
    arm = load_arm()
    X_BF = forward_kinematics(arm, [0.3, -1.0, 0.0, -1.2, -1.5, 0.2])  # elbow stretched
    p_shoulder = np.array([0.0, 0.0, arm.dh.d1])
    outwards = (X_BF.translation() - p_shoulder) / np.linalg.norm(X_BF.translation() - p_shoulder)
    beyond = RigidTransform(X_BF.rotation(), X_BF.translation() + 0.002 * outwards)
    assert inverse_kinematics(arm, X_BF).shape[0] > 0
    assert inverse_kinematics(arm, beyond).shape[0] == 0


def test_the_nearest_solution_is_the_configuration_itself_turns_included() -> None:
    arm = load_arm()
    rng = np.random.default_rng(2)
    for q in rng.uniform(arm.position_lower, arm.position_upper, (200, 6)):
        found = nearest_solution(arm, forward_kinematics(arm, q), q)
        assert found is not None
        np.testing.assert_allclose(found, q, rtol=0, atol=1e-6)


def test_the_nearest_solution_keeps_to_the_limits() -> None:
    arm = load_arm()
    q = np.array([6.2, -1.2, 1.5, -1.0, -1.5, -6.2])
    past = q + np.array([0.2, 0, 0, 0, 0, -0.2])  # beyond the limits of joints 1 and 6
    X_BF = forward_kinematics(arm, past)
    found = nearest_solution(arm, X_BF, q)
    assert found is not None
    assert (np.abs(found) <= arm.position_upper).all()
    assert residual(arm, found, X_BF) < RESIDUAL


def test_at_the_wrist_singularity_the_free_joint_stays_where_it_is() -> None:
    arm = load_arm()
    q = np.array([0.3, -1.2, 1.5, -1.0, 0.0, 0.7])
    X_BF = forward_kinematics(arm, q)
    assert_solutions(arm, X_BF, inverse_kinematics(arm, X_BF))
    found = nearest_solution(arm, X_BF, q)
    assert found is not None
    np.testing.assert_allclose(found, q, rtol=0, atol=1e-6)


def test_near_means_cheap_for_the_slow_joints() -> None:
    arm = load_arm()
    q = np.array([0.3, -1.2, 1.5, -1.0, -1.5, 0.2])
    X_BF = forward_kinematics(arm, q)
    solutions = inverse_kinematics(arm, X_BF)
    near = q + np.array([0.05, -0.05, 0.05, 0.1, -0.1, 0.3])
    found = nearest_solution(arm, X_BF, near)
    assert found is not None
    cost = np.sum(((found - near) / arm.velocity_limit) ** 2)
    assert all(cost <= np.sum(((other - near) / arm.velocity_limit) ** 2) for other in solutions)


def test_angles_that_are_no_numbers_are_refused() -> None:
    arm = load_arm()
    X_BF = forward_kinematics(arm, np.zeros(6))
    with pytest.raises(InputError, match="6 finite"):
        nearest_solution(arm, X_BF, [0, 0, 0, 0, 0, np.nan])
    with pytest.raises(InputError, match="finite"):
        inverse_kinematics(arm, RigidTransform([np.nan, 0, 0]))


def arm_by_table(name: str, turn: float = np.pi) -> Chain:
    links = [RigidTransform(RollPitchYaw(alpha, 0, 0), [a, 0, d]).GetAsMatrix4() for d, a, alpha in TABLES[name]]
    limit = np.full(6, turn)
    return Chain(
        name=name,
        joint_names=tuple("123456"),
        stack=np.array([np.eye(4), *links[:5]]),
        X_LF=links[5],
        position_lower=-limit,
        position_upper=limit,
        velocity_limit=np.ones(6),
    )


def as_pose(X: Array) -> RigidTransform:
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(X[:3, :3]), X[:3, 3])


def found_by_many_starts(name: str, X: Array, rng: np.random.Generator, starts: int = 600) -> Array:
    """Solutions (k, 6) that Gauss-Newton with differences finds from random starts, on the table alone."""
    q, h = rng.uniform(-np.pi, np.pi, (starts, 6)), 1e-6

    def off(q: Array) -> Array:
        return np.asarray((pose_by_table(name, q) - X)[..., :3, :].reshape(*q.shape[:-1], 12))

    for _ in range(40):
        e = off(q)
        J = np.swapaxes((off(q[:, None] + h * np.eye(6)) - off(q[:, None] - h * np.eye(6))) / (2 * h), 1, 2)
        normal = np.swapaxes(J, 1, 2) @ J + np.clip((e * e).sum(axis=1), 1e-12, 1e-2)[:, None, None] * np.eye(6)
        step = np.linalg.solve(normal, np.einsum("nij,ni->nj", J, e)[..., None])[..., 0]
        q = q - step * np.minimum(1.0, 0.5 / np.maximum(np.abs(step).max(axis=1), 1e-12))[:, None]
    q = q[np.abs(off(q)).max(axis=1) < 1e-9]
    kept: list[Array] = []
    for one in q:
        if all(apart(one, other) > 1e-3 for other in kept):
            kept.append(one)
    return np.array(kept)


@pytest.mark.parametrize("name", TABLES)
def test_arms_of_other_makers_are_found_from_all_sides(name: str) -> None:
    arm = arm_by_table(name)
    for q in np.random.default_rng(3).uniform(-np.pi, np.pi, (150, 6)):
        X = pose_by_table(name, q)
        solutions = inverse_kinematics(arm, as_pose(X))
        assert np.abs(pose_by_table(name, solutions) - X).max() < 1e-8
        assert min(apart(q, other) for other in solutions) < 1e-6
        assert 2 <= len(solutions) <= 16


@pytest.mark.parametrize("name", TABLES)
def test_no_solution_of_a_dense_search_is_missed(name: str) -> None:
    arm, rng = arm_by_table(name), np.random.default_rng(4)
    for q in rng.uniform(-np.pi, np.pi, (2, 6)):
        X = pose_by_table(name, q)
        solutions = inverse_kinematics(arm, as_pose(X))
        dense = found_by_many_starts(name, X, rng)
        assert len(dense) >= 2
        assert all(min(apart(one, other) for other in solutions) < 1e-5 for one in dense)


def test_a_branch_beside_a_singularity_is_found() -> None:
    # sigma_min is 1e-4 here, and the first bend of the arm loses this branch of eight
    q = np.array(
        [
            -2.35038782673197,
            -0.96389141586579,
            1.802661997433505,
            -0.284184830428467,
            -0.034772503753779,
            1.79010012161896,
        ]
    )
    solutions = inverse_kinematics(arm_by_table("abb_irb120"), as_pose(pose_by_table("abb_irb120", q)))
    assert len(solutions) == 8
    assert min(apart(q, other) for other in solutions) < 1e-6


def test_what_is_out_of_reach_has_a_reason() -> None:
    arm, R = arm_by_table("abb_irb120"), RollPitchYaw(np.pi, 0, 0)
    far, inside = RigidTransform(R, [1.3, 0.0, 0.3]), RigidTransform(R, [0.0, 0.0, 0.2])
    assert inverse_kinematics(arm, far).shape == inverse_kinematics(arm, inside).shape == (0, 6)
    assert "farther away than all links" in why_unreached(arm, far)
    assert "no joint angles" in why_unreached(arm, inside)
    q = np.array([1.0, -0.3, 0.3, 0.5, 0.6, 0.2])
    X_BF, short = as_pose(pose_by_table("abb_irb120", q)), arm_by_table("abb_irb120", 0.4)
    assert len(inverse_kinematics(arm, X_BF)) > 0
    assert len(inverse_kinematics(short, X_BF)) == 0
    assert "joint 1 would be at 57.3 deg, and its limits are -22.9 to 22.9 deg" in why_unreached(short, X_BF)


@pytest.mark.parametrize("n", [4, 5])
def test_fewer_joints_are_found_from_all_sides(n: int) -> None:
    six = arm_by_table("xarm6")
    limit = six.position_upper[:n]
    arm = replace(six, stack=six.stack[:n], position_lower=-limit, position_upper=limit, velocity_limit=np.ones(n))
    for q in np.random.default_rng(6).uniform(-3.0, 3.0, (30, n)):
        solutions = inverse_kinematics(arm, forward_kinematics(arm, q))
        assert min(apart(q, other) for other in solutions) < 1e-6


def test_limits_beyond_half_a_turn_are_used() -> None:
    arm = replace(arm_by_table("xarm6"), position_lower=np.full(6, 0.5), position_upper=np.full(6, 0.5 + 2.0 * np.pi))
    q = np.array([4.0, 1.2, 5.5, 3.5, 0.9, 6.0])
    solutions = inverse_kinematics(arm, as_pose(pose_by_table("xarm6", q)))
    assert np.abs(solutions - q).max(axis=1).min() < 1e-6
    assert ((solutions >= 0.5) & (solutions <= 0.5 + 2.0 * np.pi)).all()


def test_seven_joints_keep_to_the_angles_they_have() -> None:
    arm = load_chain("franka_panda")
    middle = 0.5 * (arm.position_lower + arm.position_upper)
    for shift in np.random.default_rng(5).uniform(-0.5, 0.5, (5, 7)):
        q = middle + shift
        X_BF = forward_kinematics(arm, q)
        found = nearest_solution(arm, X_BF, q)
        assert found is not None
        np.testing.assert_allclose(found, q, rtol=0, atol=1e-6)
    for q in np.random.default_rng(5).uniform(arm.position_lower, arm.position_upper, (25, 7)):
        X_BF = forward_kinematics(arm, q)
        others = inverse_kinematics(arm, X_BF)
        assert len(others) > 0
        assert ((others >= arm.position_lower) & (others <= arm.position_upper)).all()
        assert all(forward_kinematics(arm, one).IsNearlyEqualTo(X_BF, 1e-8) for one in others)
