"""Several sensors in one solution: worlds with a wrong arm, exact ones, another target, repeats, and a public cell."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from tests.calibration.hand_eye.poses import Array, noise, random_poses
from tests.figures.hand_eye.several import drawn, errors, made, public_cell, solved
from tests.places import SHARED_DATA, require_data
from weldcal.calibration.data.stated_pose import read_stated_pose
from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.geometry.se3 import difference, inverse, moved
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.several import SensorPairs, SensorsTogether, solve_together
from weldcal.calibration.hand_eye.solve import HandEyeConfig, solve_problem
from weldcal.tools.cli.app import build_app


def rig(
    seed: int, n: int = 12, sensors: int = 2, turn: float = 0.0, shift: float = 0.0, shared: bool = True
) -> tuple[list[PosePairs], Array]:
    """Cameras that ride on one flange before one target, and their poses X_FC (sensors, 4, 4)."""
    rng = np.random.default_rng(seed)
    X, Y = random_poses(sensors, rng), random_poses(1, rng)[0]
    F = random_poses(n, rng)
    pairs = []
    for k in range(sensors):
        mine = F if shared or not k else random_poses(n, rng)
        G = inverse(mine @ X[k]) @ Y @ noise(n, rng, turn, shift)
        pairs.append(PosePairs(source=f"c{k}", robot=mine, camera=G, mode="eye_in_hand"))
    return pairs, X


def together(pairs: list[PosePairs]) -> SensorsTogether:
    config = HandEyeConfig(folds=0)
    results = [solve_problem(full_problem(p.F, p.G, p.H), config=config) for p in pairs]
    return solve_together([SensorPairs(name=p.source, pairs=p, result=r) for p, r in zip(pairs, results, strict=True)])


@pytest.mark.parametrize("corners", [False, True], ids=["poses", "corners"])
def test_camera_to_camera_is_nearer_than_by_two_solutions_and_its_region_is_right(corners: bool) -> None:
    found = [[errors(f, X) for f in solved(pairs)] for pairs, X in (made(s, corners=corners) for s in range(10, 16))]
    both, apart = (np.array(part) for part in zip(*found, strict=True))
    assert np.median(both[:, 0]) < 0.8 * np.median(apart[:, 0])
    # the mean of six squares of six numbers: a variance that is four times too large or too small lies outside
    assert 2.5 < both[:, 2].mean() < 18.0


@pytest.mark.parametrize(("sensors", "shared"), [(2, True), (3, True), (2, False)])
def test_exact_poses_give_the_truth(sensors: int, shared: bool) -> None:
    pairs, X = rig(3, sensors=sensors, shared=shared)
    found = together(pairs)
    np.testing.assert_allclose(found.X, X, atol=1e-7)
    assert found.shared == (12 if shared else 0)
    assert found.names == tuple(f"c{k}" for k in range(sensors))


def test_noise_of_the_sensors_and_of_the_robot_are_told_apart() -> None:
    pairs, _ = rig(5, n=60, turn=1e-3, shift=2e-4)
    rng = np.random.default_rng(6)
    wrong = noise(60, rng, 2e-3, 1e-3)  # as both cameras find the target, so that the robot is off
    pairs = [replace(p, camera=p.camera @ wrong) for p in pairs]
    found = together(pairs)
    np.testing.assert_allclose(found.common, (2e-3, 1e-3), rtol=0.25)
    # a large common error hides which of the two is the better one
    np.testing.assert_allclose(np.sqrt((found.noise**2).mean(axis=0)), (1e-3, 2e-4), rtol=0.25)


def test_the_covariance_between_two_sensors_is_that_of_their_poses() -> None:
    pairs, _ = rig(7, turn=1e-3, shift=1e-3)
    found = together(pairs)
    rng = np.random.default_rng(0)
    L = np.linalg.cholesky(found.covariance[:12, :12])
    X_ij, S = found.between(0, 1)
    drawn_ = []
    for _ in range(4000):
        e = L @ rng.normal(size=12)
        drawn_.append(difference(X_ij, inverse(moved(found.X[0], e[:6])) @ moved(found.X[1], e[6:])))
    np.testing.assert_allclose(np.cov(np.array(drawn_).T), S, atol=0.1 * float(np.diag(S).max()))


def test_repeats_of_a_pose_count_once() -> None:
    pairs, _ = rig(8, turn=1e-3, shift=1e-3)
    thrice = [replace(p, robot=np.repeat(p.robot, 3, axis=0), camera=np.repeat(p.camera, 3, axis=0)) for p in pairs]
    one, three = together(pairs), together(thrice)
    np.testing.assert_allclose(three.X, one.X, atol=1e-9)
    np.testing.assert_allclose(three.covariance, one.covariance, rtol=1e-3, atol=1e-12)


def test_a_sensor_that_saw_another_target_is_named() -> None:
    pairs, _ = rig(9, turn=1e-3, shift=1e-3)
    other = moved(np.eye(4), np.array([0.0, 0.1, 0.0, 0.02, 0.0, 0.0]))
    pairs[1] = replace(pairs[1], camera=pairs[1].camera @ other)
    with pytest.raises(InconsistentPoses, match="do not show one target"):
        together(pairs)


def written(folder: Path, pairs: list[PosePairs], *, mode: str = "eye_on_base") -> list[str]:
    for p in pairs:
        (folder / p.source).mkdir(parents=True)
        more = {k: v for k in ("img", "obj", "K", "dist") if (v := getattr(p, k)) is not None}
        np.savez(folder / p.source / "pairs.npz", A=p.robot, B=p.camera, mode=mode, **more)
    return [str(folder / p.source) for p in pairs]


def compared_data(folder: Path) -> frozenset[str]:
    return read_stated_pose(folder).data


def run(*words: object) -> tuple[int, str, str]:
    done = CliRunner().invoke(build_app(), [str(word) for word in ("hand-eye", "ax-yb", *words)])
    return done.exit_code, done.stdout, done.stderr


def test_the_command_writes_a_result_for_each_sensor_and_the_poses_between(tmp_path: Path) -> None:
    pairs, X = made(20, corners=False)
    files = written(tmp_path, pairs)
    code, stdout, stderr = run(*files, "--json", "--out", tmp_path / "out")
    assert code == 0, stderr
    summary = json.loads(stdout)
    (between,) = summary["between"]
    assert (between["parent"], between["child"]) == ("camera1", "camera2")
    whole = yaml.safe_load((tmp_path / "out" / "together.yaml").read_text())
    np.testing.assert_allclose(whole["between"][0]["matrix"], X, atol=2e-3)
    own = yaml.safe_load((tmp_path / "out" / "camera2" / "hand_eye.yaml").read_text())
    np.testing.assert_allclose(own["poses"]["X_BC"]["matrix"], summary["sensors"][1]["X"], atol=1e-9)
    assert own["method"] == "together with camera1"
    assert (
        "--child-frame-id camera2_optical_frame"
        in (tmp_path / "out" / "camera2" / "X_BC.static_transform.sh").read_text()
    )
    # the file of the other sensor is part of the data of both
    first, second = (compared_data(tmp_path / "out" / name) for name in ("camera1", "camera2"))
    assert first == second
    assert len(first) == 2
    assert "From camera1 to camera2" in (tmp_path / "out" / "report.html").read_text()


def test_mistakes_are_one_sentence(tmp_path: Path) -> None:
    pairs, _ = made(20, corners=False)
    files = written(tmp_path, pairs)
    ridden = written(tmp_path / "ridden", rig(3, turn=1e-3, shift=1e-3)[0][:1], mode="eye_in_hand")
    (tmp_path / "robot.csv").write_text("x,y,z,qx,qy,qz,qw\n" + "0.1,0.2,0.3,0,0,0,1\n" * 5)
    for words, sentence in (
        ((files[0], ridden[0]), "('camera1' is eye_on_base, 'c0' is eye_in_hand): solve each mounting by itself."),
        ((files[0], files[0]), "given twice"),
        ((files[0], shutil.copytree(files[0], tmp_path / "copy")), "Two files hold the same poses"),
        ((*files, "--robot", "ur10e"), "--robot and --refine go with one file"),
        ((files[0], tmp_path / "robot.csv"), "Each of several files holds the pairs of one sensor;"),
    ):
        code, _, stderr = run(*words, "--out", tmp_path / "out")
        assert code == 1
        assert sentence in " ".join(stderr.split())
        assert not (tmp_path / "out").exists()


def test_a_public_cell_is_nearer_to_its_truth_together() -> None:
    folder = SHARED_DATA / "handeye"
    require_data(folder / "multi_camera_workcell_camera1")
    pairs, truth = public_cell(folder)
    found = np.array([[errors(f, truth) for f in solved(drawn(pairs, 15, seed))] for seed in range(100, 105)])
    assert np.median(found[:, 0, 0]) < 0.6 * np.median(found[:, 1, 0])
