"""Poses of a mounting and the scanner's correction are as far off as they state, with errors of scanner and arm in the
world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.worlds.light_runs import MountedWorld, mounted_plan, mounted_world
from weldcal.calibration.data.scanner_correction import correction_of
from weldcal.calibration.geometry.se3 import IDENTITY, exp_rotation, pose
from weldcal.calibration.planning import mounting_estimate as estimate
from weldcal.calibration.planning.mounting_estimate import (
    MountingResult,
    expected_after,
    expected_error,
    solve_mounting,
)
from weldcal.calibration.planning.mounting_poses import work_point
from weldcal.calibration.planning.mounting_scene import LENGTH_M
from weldcal.models.arrays import Array

SEEDS = range(1000, 1040)


def point_error(world: MountedWorld, result: MountingResult) -> tuple[Array, Array]:
    """Error (3,) m of a scanned point at the best distance, and its stated covariance."""
    p = work_point(world.scene)
    seen = world.device.measured(p)
    return result.place(seen) - world.true.X_LC @ p, result.point_covariance(seen)


@pytest.mark.parametrize("name", ["eye_in_hand", "eye_on_arm"])
def test_the_stated_error_is_neither_too_small_nor_too_large(name: str) -> None:
    """Half or double the covariance makes the mean 2 or 0.5; its standard deviation is 0.09 (pose) and 0.13 (point)."""
    poses, points = [], []
    for seed in SEEDS:
        world = mounted_world(name, seed)
        result = solve_mounting(world.scene, world.seen)
        e, S = point_error(world, result)
        poses.append(result.normalised_error("X", world.true.X_LC) / 6.0)
        points.append(e @ np.linalg.solve(S, e) / 3.0)
    assert 0.7 < np.mean(poses) < 1.4
    assert 0.6 < np.mean(points) < 1.6


def test_a_scanner_on_the_wrist_finds_its_own_scale_and_gradient() -> None:
    """The world's scanner measures 0.2 % short, with a gradient of 1.3 % per metre of x."""
    found, sigma = [], []
    for seed in SEEDS[:12]:
        world = mounted_world("eye_in_hand", seed)
        result = solve_mounting(world.scene, world.seen)
        found.append(result.correction.values[:3])
        sigma.append(np.sqrt(np.diag(result.with_factors)[6:9]))
        assert result.undetermined == ()
    off = np.mean(found, axis=0) - [1.002, -0.013, 0.0]
    # the warp has a share of its own: 0.1 mm at 650 mm is 0.015 %
    assert np.abs(off[0]) < 1.5e-4
    assert np.abs(off[1:]).max() < 5e-4
    assert np.max(sigma, axis=0)[0] < 2e-4  # a tenth of what is usual


def test_a_gap_in_the_views_is_named() -> None:
    """A scanner under the forearm has the foot in the middle of its image, from left to right: it cannot show a bend
    along x."""
    world = mounted_world("eye_on_arm_base", 0)
    assert solve_mounting(world.scene, world.seen).undetermined == ("bend in x",)


def test_a_better_arm_is_trusted_more_and_a_worse_one_less() -> None:
    world = mounted_world("eye_in_hand", 3)
    errors = [
        expected_error(scene, solve_mounting(scene, world.seen))[0]
        for scene in (replace(world.scene, arm_error_m=size) for size in (1e-4, 4e-4, 1.6e-3))
    ]
    assert errors[0] < 0.8 * errors[1] < 0.8 * 0.8 * errors[2]


def test_an_arm_that_is_worse_than_stated_shows() -> None:
    world = mounted_world("eye_in_hand", 3)
    result = solve_mounting(replace(world.scene, arm_error_m=5e-5), world.seen)
    assert result.arm_error_m > 7e-5


def test_a_gross_error_is_left_out() -> None:
    world = mounted_world("eye_in_hand", 5)
    bad = world.seen[4]
    o = replace(bad.observation, p_CM=bad.observation.p_CM + np.array([0.0, 0.02, 0.0]))
    seen = [*world.seen[:4], replace(bad, observation=o), *world.seen[5:]]
    result = solve_mounting(world.scene, seen)
    assert list(np.flatnonzero(~result.inliers)) == [4]
    e, S = point_error(world, result)
    assert e @ np.linalg.solve(S, e) < 16.3  # 99.9 %


def test_held_out_errors_are_those_of_new_scans() -> None:
    """Scans that the calibration did not have lie as far from their prediction as its held-out errors say."""
    held, new = [], []
    for seed in SEEDS[:10]:
        world = mounted_world("eye_in_hand", seed, scans=18)
        result = solve_mounting(world.scene, world.seen[:14], folds=5)
        held.append(np.mean(result.held_out.translation**2))
        belief = world.scene.believing(result.poses)
        new.append([estimate.off_prediction(belief, s, result.correction)[0] ** 2 for s in world.seen[14:]])
    assert 0.6 < np.sqrt(np.mean(held) / np.mean(new)) < 1.5


def test_one_more_scan_would_help_as_much_as_predicted() -> None:
    world = mounted_world("eye_in_hand", 7, scans=9)
    plan = mounted_plan("eye_in_hand")[3]
    result = solve_mounting(world.scene, world.seen[:8])
    belief = world.scene.believing(result.poses)
    predicted = expected_after(belief, result, world.seen[:8], plan[8:])
    before, after = (expected_error(belief, solve_mounting(world.scene, world.seen[:n]))[0] for n in (8, 9))
    assert (predicted < before).all()
    assert predicted[0] == pytest.approx(after, rel=0.25)


@pytest.mark.parametrize("name", ["eye_in_hand", "eye_on_arm", "eye_on_arm_base", "co_manipulation", "eye_on_base"])
def test_the_derivatives_are_those_of_the_equation(name: str) -> None:
    world = mounted_world(name, 2, scans=5)
    scene, true, m, K = world.scene, world.true, 12 if name == "co_manipulation" else 6, 6
    data = estimate._data(scene, world.seen)
    X, Y, Z = (np.asarray(P.GetAsMatrix4()) for P in (true.X_LC, true.X_BD or true.X_HR, true.X_HR))
    state = (X, Y, Z if scene.two else IDENTITY)
    factors = np.zeros(K)  # a normal's derivative is taken there: what the factors change of it is a hundredth of that
    links, _ = estimate._links(scene, data.poses, state)
    _, J = estimate._rows(data, state, correction_of(factors, data.field))

    def residuals(change: Array) -> Array:
        moved = data.problem.step(state, change[:m])
        return estimate._rows(data, moved, correction_of(factors + change[m : m + K], data.field))[0]

    for j in range(m + K):
        step = 1e-5 * np.eye(m + K)[j]
        slope = (residuals(step) - residuals(-step)) / 2e-5
        assert np.abs(slope - J[:, :, j]).max() < 0.01 * max(0.5, np.abs(slope).max())
    # an arm whose links err: its poses in place of the reported ones
    k = 0
    for second, arm in ((False, scene.arm), (True, scene.arm_2)):
        if arm is None:
            continue
        for joint in range(6):
            for part in range(6):
                errors = np.zeros(6)
                errors[part] = 1e-5 * (LENGTH_M if part > 2 else 1.0)
                stack = arm.stack.copy()
                stack[joint] = pose(exp_rotation(errors[:3]), errors[3:]) @ stack[joint]
                bent = replace(scene, **{"arm_2" if second else "arm": replace(arm, stack=stack)})
                o = [bent.observation(s.pose.q, s.pose.q_2, s.observation.p_CM, s.observation.n_CM) for s in world.seen]
                other = replace(data, problem=bent.problem(o))
                slope = estimate._rows(other, state, correction_of(np.zeros(6), data.field))[0]
                slope = (slope - estimate._rows(data, state, correction_of(np.zeros(6), data.field))[0]) / 1e-5
                if np.abs(slope).max() < 1e-6:
                    continue  # it moves scanner and circle alike
                assert np.abs(slope - links[:, :, k] / scene.sizes[int(second)][0]).max() < 0.02
                k += 1
    assert k == links.shape[2]
