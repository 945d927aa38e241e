"""Every mounting finds its camera from poses, from points, and from points with normals; directions are told in
words."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from tests.calibration.hand_eye.poses import Array, noise, random_poses
from weldcal.calibration.geometry.se3 import IDENTITY, as_transform, inverse, pose
from weldcal.calibration.hand_eye.mountings import MOUNTINGS, TargetObservation, get_mounting, problem_of
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_problem
from weldcal.calibration.planning.next_pose import next_pose, view_of
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.errors import InputError
from weldcal.models.scanners import get_scanner

TURN, SHIFT = np.radians(0.05), 2e-4
QUICK = HandEyeConfig(folds=0)


def make_observations(name: str, kind: str, n: int = 20) -> tuple[list[TargetObservation], dict[str, RigidTransform]]:
    """Samples of a mounting written with its own equation in frames, not with the solver's F and H."""
    rng = np.random.default_rng(list(MOUNTINGS).index(name))
    X_BF, X_BL, X_DE = (random_poses(n, rng) for _ in range(3))
    X, Y, Z = random_poses(3, rng, 1.5)
    target = {
        "eye_in_hand": lambda: inverse(X_BF @ X) @ Y,
        "eye_on_base": lambda: inverse(X) @ X_BF @ Y,
        "eye_on_arm_target_on_flange": lambda: inverse(X_BL @ X) @ X_BF @ Y,
        "eye_on_arm_target_on_base": lambda: inverse(X_BL @ X) @ Y,
        "co_manipulation": lambda: inverse(X_BF @ X) @ Y @ X_DE @ Z,
    }[name]()
    X_CM = target @ noise(n, rng, TURN, SHIFT)
    samples = [
        TargetObservation(
            X_BF=as_transform(X_BF[i]),
            p_CM=X_CM[i, :3, 3],
            n_CM=X_CM[i, :3, 2] if kind == "normals" else None,
            R_CM=RotationMatrix(as_transform(X_CM[i]).rotation()) if kind == "poses" else None,
            X_BL=as_transform(X_BL[i]) if "arm" in name else None,
            X_DE=as_transform(X_DE[i]) if name == "co_manipulation" else None,
        )
        for i in range(n)
    ]
    truth = {k: as_transform(p) for k, p in zip("XYZ", (X, Y, Z), strict=True) if k in MOUNTINGS[name].unknowns}
    return samples, truth


def calibrate(
    name: str, samples: list[TargetObservation], known: dict[str, RigidTransform] | None = None
) -> HandEyeResult:
    known, mounting = known or {}, get_mounting(name)
    X, Y, Z = (np.asarray(known[k].GetAsMatrix4()) if k in known else IDENTITY for k in "XYZ")
    problem = problem_of(mounting, samples, known)
    return solve_problem(problem, (X, Y, Z), config=QUICK, equation=mounting.equation, labels=mounting.labels)


@pytest.mark.parametrize("name", list(MOUNTINGS))
def test_full_poses_find_all_unknowns(name: str) -> None:
    samples, truth = make_observations(name, "poses")
    result = calibrate(name, samples)
    assert set(result.poses) == set(truth)
    for letter, X in truth.items():
        assert result.normalised_error(letter, X) < result.region(0.999)


@pytest.mark.parametrize("name", list(MOUNTINGS))
@pytest.mark.parametrize("kind", ["points", "normals"])
def test_a_flange_or_mounting_circle_as_target_finds_the_camera(name: str, kind: str) -> None:
    # the paper's way: the feature's place on the robot is known, only its centre (and normal) is seen
    samples, truth = make_observations(name, kind)
    last = max(truth)
    known = {last: truth[last]}
    result = calibrate(name, samples, known)
    assert set(result.poses) == set(truth) - {last}
    assert result.normalised_error("X", truth["X"]) < result.region(0.999)


def test_poses_points_and_normals_go_together() -> None:
    samples, truth = make_observations("eye_in_hand", "poses")
    points, _ = make_observations("eye_in_hand", "points")
    normals, _ = make_observations("eye_in_hand", "normals")
    mixed = samples[:8] + points[8:14] + normals[14:]
    result = calibrate("eye_in_hand", mixed)
    assert result.normalised_error("X", truth["X"]) < result.region(0.999)
    assert np.isnan(result.rotation_rad[8:14]).all()
    assert np.isfinite(result.rotation_rad[:8]).all()


def test_mountings_say_their_directions() -> None:
    assert get_mounting("eye_on_base").labels["X"] == "pose of the camera in the base frame: X_BC"
    for m in MOUNTINGS.values():
        assert all(u.symbol in m.equation and u.symbol in m.sketch for u in m.unknowns.values())
    with pytest.raises(InputError, match="choose one of eye_in_hand"):
        get_mounting("eye_in_foot")
    samples, _ = make_observations("eye_on_arm_target_on_base", "poses", 6)
    with pytest.raises(InputError, match="pose of the link"):
        calibrate("eye_on_arm_target_on_base", [TargetObservation(X_BF=s.X_BF, p_CM=s.p_CM) for s in samples])


def test_the_next_pose_keeps_its_promise() -> None:
    rng = np.random.default_rng(3)
    F = random_poses(6, rng, 0.2)
    X, Y = random_poses(2, rng, 1.5)

    def seen(F: Array) -> Array:
        return inverse(F @ X) @ Y @ noise(len(F), rng, TURN, SHIFT)

    problem = full_problem(F, seen(F))
    mounting = get_mounting("eye_in_hand")
    samples = [
        TargetObservation(X_BF=as_transform(a), p_CM=b[:3, 3], R_CM=as_transform(b).rotation())
        for a, b in zip(F, problem.G, strict=True)
    ]
    result = calibrate("eye_in_hand", samples)
    advice = next_pose(problem, result, mounting, (IDENTITY,) * 3)
    assert advice is not None
    assert advice.X_BF is not None
    assert advice.sigma_after < advice.sigma_before
    # taken, it shows the target where it was promised
    there = inverse(np.asarray(advice.X_BF.GetAsMatrix4()) @ X) @ Y
    assert np.linalg.norm(there[:3, 3] - advice.X_CM.translation()) < 0.02
    # and a calibration with it is surer than with a repeated pose
    more = np.concatenate([F, [advice.X_BF.GetAsMatrix4()]])
    again = np.concatenate([F, F[:1]])
    sigmas = []
    for poses in (more, again):
        G = inverse(poses @ X) @ Y @ noise(len(poses), np.random.default_rng(4), TURN, SHIFT)
        both = [
            TargetObservation(X_BF=as_transform(a), p_CM=b[:3, 3], R_CM=as_transform(b).rotation())
            for a, b in zip(poses, G, strict=True)
        ]
        found = calibrate("eye_in_hand", both)
        sigmas.append(np.trace(found.covariance["X"][3:, 3:]) / found.sigma_translation**2)
    assert sigmas[0] < sigmas[1]


def test_the_next_pose_is_seen_by_the_camera_and_reached_by_the_arm() -> None:
    rng = np.random.default_rng(5)
    arm, scanner = load_chain("ur10e"), get_scanner("phoxi_s")
    q = np.array([0.3, -1.4, 1.7, -1.9, -1.5, 0.4]) + rng.uniform(-0.25, 0.25, (8, 6))
    F = np.array([forward_kinematics(arm, each).GetAsMatrix4() for each in q])
    X = random_poses(1, rng, 0.1, 0.02)[0]
    Y = F[0] @ X @ pose(np.eye(3), np.array([0.0, 0.0, scanner.optimum_m]))
    problem = full_problem(F, inverse(F @ X) @ Y @ noise(8, rng, TURN, SHIFT))
    result = solve_problem(problem, config=QUICK)
    mounting, known = get_mounting("eye_in_hand"), (IDENTITY,) * 3
    view = view_of(problem.G, scanner=scanner)
    advice = next_pose(problem, result, mounting, known, arm=arm, view=view)
    assert advice is not None
    assert advice.X_BF is not None
    assert advice.q is not None
    np.testing.assert_allclose(
        forward_kinematics(arm, advice.q).GetAsMatrix4(), np.asarray(advice.X_BF.GetAsMatrix4()), atol=1e-8
    )
    assert (advice.q >= arm.position_lower).all()
    assert (advice.q <= arm.position_upper).all()
    p = advice.X_CM.translation()
    assert scanner.near_m <= p[2] <= scanner.far_m
    u, v = scanner.fx * p[0] / p[2] + scanner.cx, scanner.fy * p[1] / p[2] + scanner.cy
    assert 0.0 < u < scanner.width
    assert 0.0 < v < scanner.height
    assert "Within reach and limits of ur10e" in advice.sentence()
    # an arm that is too short for the poses so far is no judge of the next one, and that is said
    other = next_pose(problem, result, mounting, known, arm=load_chain("ur3e"), view=view)
    assert other is not None
    assert "ur3e does not reach the poses so far" in other.sentence()
