"""Two results of one truth are called the same as often as their regions say, and a shift is named with its axis."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from weldcal.calibration.compared_results import compare_results, compare_stated
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.data.stated_pose import StatedPose, read_stated_pose
from weldcal.calibration.hand_eye.exports import Provenance, export_hand_eye
from weldcal.calibration.hand_eye.mountings import get_mounting
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.solve import HandEyeConfig
from weldcal.calibration.recorded_hand_eye import solve_pairs
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app

Array = NDArray[np.float64]
WORK = np.array([0.05, -0.03, 0.62])
DRAWS = 200
USUAL = range(180, 199)  # 90 to 99 of 100
WORDS = ("scanner's x", "scanner's y", "optical axis")


def truth(rng: np.random.Generator) -> Array:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(0.0, 0.6, 3)
    return X


def spread(X: Array) -> Array:
    """Factor (6, 6) of the errors [rotation; origin] of a pose that is known best at the work point."""
    L = np.diag([2e-4, 1.5e-4, 3e-4, 8e-5, 12e-5, 6e-5])
    for k in range(3):  # a turn about the work point moves the origin the other way
        L[3:, k] = np.cross(L[:3, k], -X[:3, :3] @ WORK)
    return L


def displaced(X: Array, error: Array) -> Array:
    Y = X.copy()
    Y[:3, :3], Y[:3, 3] = Rotation.from_rotvec(error[:3]).as_matrix() @ X[:3, :3], X[:3, 3] + error[3:]
    return Y


def saved(path: Path, X: Array, C: Array | None, symbol: str = "X_BC", **more: Any) -> Path:
    """A result with what the comparison reads."""
    tree = {"schema": 1, symbol: {"matrix": X.tolist()}, "observed": {"camera": [WORK.tolist()]}, **more}
    tree["data_sha256"] = more.get("data_sha256", {"dataset.yaml": "one header", "clouds/1": path.name})
    if C is not None:
        tree["covariance"] = {"matrix": C.tolist()}
    path.write_text(yaml.safe_dump(tree))
    return path


@pytest.fixture
def known(tmp_path: Path) -> StatedPose:
    return read_stated_pose(saved(tmp_path / "a.yaml", truth(np.random.default_rng(0)), np.eye(6)))


def drawn(known: StatedPose, name: str, X: Array, C: Array, **more: Any) -> StatedPose:
    return replace(known, readings=(replace(known.readings[0], X=X),), covariance=C, data=frozenset([name]), **more)


@pytest.mark.parametrize(("factor", "usual"), [(1.0, True), (4.0, False), (0.25, False)])
def test_results_of_one_truth_are_the_same_as_often_as_stated(known: StatedPose, factor: float, usual: bool) -> None:
    rng, same = np.random.default_rng(1), 0
    for _ in range(DRAWS):
        X = truth(rng)
        L = [spread(X), 1.7 * spread(X)]
        one, other = (
            drawn(known, str(k), displaced(X, f @ rng.normal(size=6)), factor * f @ f.T) for k, f in enumerate(L)
        )
        same += not compare_stated(one, other).differ
    assert (same in USUAL) == usual, same


@pytest.mark.parametrize("what", ["shift", "turn"])
def test_a_change_of_five_sigma_is_named_with_its_axis(known: StatedPose, what: str) -> None:
    rng, right = np.random.default_rng(2), 0
    for trial in range(100):
        X = truth(rng)
        L = spread(X)
        axis = trial % 3
        a = X[:3, axis]
        C = 2.0 * L @ L.T
        u = np.concatenate([np.zeros(3), a] if what == "shift" else [a, np.zeros(3)])
        size = 5.0 * np.sqrt(u @ C @ u)
        one = drawn(known, "1", displaced(X, L @ rng.normal(size=6)), L @ L.T)
        other = drawn(known, "2", displaced(displaced(X, size * u), L @ rng.normal(size=6)), L @ L.T)
        found = compare_stated(one, other)
        named = found.direction.startswith("a turn") == (what == "turn") and WORDS[axis] in found.direction
        right += found.differ and named
    assert right >= 95, right


def test_corrections_count_with_their_covariance(known: StatedPose) -> None:
    rng, same, alone = np.random.default_rng(3), 0, 0
    true = np.array([1.002, 0.01, -0.02])
    for _ in range(DRAWS):
        X, both = truth(rng), []
        lever = X[:3, :3] @ WORK
        for k in range(2):
            e = np.array([5e-4, 2e-3, 2e-3]) * rng.normal(size=3)
            # the scans show places of points, so that an error of the correction pulls the origin along
            pull = np.outer(-lever, [1.0, WORK[0], WORK[1]])
            L = np.zeros((9, 9))
            L[:6, :6], L[6:, 6:] = spread(X), np.diag([5e-4, 2e-3, 2e-3])
            L[3:6, 6:] = pull @ L[6:, 6:]
            error = np.concatenate([spread(X) @ rng.normal(size=6) + np.concatenate([np.zeros(3), pull @ e]), e])
            scale, gx, gy = true + error[6:]
            both.append(
                drawn(
                    known,
                    str(k),
                    displaced(X, error[:6]),
                    (L @ L.T)[:6, :6],
                    correction=ScannerCorrection(float(scale), (float(gx), float(gy))),
                    joint=L @ L.T,
                )
            )
        found = compare_stated(*both)
        assert found.corrected
        same += not found.differ
        bare = compare_stated(*(replace(one, joint=None) for one in both))
        assert not bare.corrected
        assert "without the corrections" in bare.notes[0]
        alone += not bare.differ
    assert same in USUAL, same
    assert alone in USUAL, alone


def recorded(rng: np.random.Generator, X: Array, n: int = 14) -> PosePairs:
    """A board half a metre before a camera on the flange: random turns and places, noise of the camera alone."""
    B = np.tile(np.eye(4), (n, 1, 1))
    B[:, :3, :3] = Rotation.from_rotvec(0.35 * rng.normal(size=(n, 3))).as_matrix()
    B[:, :3, 3] = [0.0, 0.0, 0.5] + 0.06 * rng.normal(size=(n, 3))
    A = truth(rng) @ np.linalg.inv(X @ B)
    B[:, :3, :3] @= Rotation.from_rotvec(8e-4 * rng.normal(size=(n, 3))).as_matrix()
    B[:, :3, 3] += 3e-4 * rng.normal(size=(n, 3))
    return PosePairs(source="made", robot=A, camera=B, mode="eye_in_hand")


def test_two_calibrations_from_observations_agree_as_stated(tmp_path: Path) -> None:
    rng, squares, same = np.random.default_rng(4), [], 0
    X, few = truth(rng), HandEyeConfig(folds=0)
    for trial in range(40):
        paths = []
        for k in range(2):
            found = solve_pairs(recorded(rng, X), few)
            folder = tmp_path / f"{trial}-{k}"
            folder.mkdir()
            export_hand_eye(found, get_mounting("eye_in_hand"), folder, Provenance("made", folder.name))
            paths.append(folder)
        compared = compare_results(*paths)
        squares.append(compared.square / 6.0)
        same += not compared.differ
    assert same in range(35, 41)
    assert 0.7 < np.mean(squares) < 1.6, "four times the variance, or a quarter of it, is outside"


def test_the_command_names_what_differs(tmp_path: Path) -> None:
    X = truth(np.random.default_rng(5))
    C = spread(X) @ spread(X).T
    moved = X.copy()
    moved[:3, 3] += 2e-3 * X[:3, 2]
    one, same, other = (
        saved(tmp_path / f"{k}.yaml", Y, C) for k, Y in enumerate([X, displaced(X, np.full(6, 1e-5)), moved])
    )
    run = CliRunner()
    agrees = run.invoke(app, ["compare", str(one), str(same), "--json"])
    assert agrees.exit_code == 0
    assert json.loads(agrees.stdout)["verdict"] == "the same within their regions"
    differs = run.invoke(app, ["compare", str(one), str(other)])
    assert differs.exit_code == 1
    assert differs.stdout.startswith("compare: they differ")
    assert "+2.000 mm along the optical axis" in differs.stdout
    assert "they differ" in differs.stderr


def test_a_comparison_without_a_test_is_one_sentence(tmp_path: Path) -> None:
    X = truth(np.random.default_rng(6))
    C = spread(X) @ spread(X).T
    one, carried = saved(tmp_path / "1.yaml", X, C), saved(tmp_path / "2.yaml", X, C, "X_FC")
    again = saved(tmp_path / "3.yaml", displaced(X, np.full(6, 1e-3)), C, data_sha256={"clouds/1": "1.yaml"})
    with pytest.raises(InputError, match="states no covariance"):
        compare_results(one, saved(tmp_path / "4.yaml", X, None))
    with pytest.raises(InputError, match="X_BC and X_FC"):
        compare_results(one, carried)
    shared = CliRunner().invoke(app, ["compare", str(one), str(again), "--json"])
    assert shared.exit_code == 0
    assert json.loads(shared.stdout)["verdict"] == "no comparison"
    assert "data in common" in json.loads(shared.stdout)["reason"]


def test_profilers_are_compared_from_their_files(tmp_path: Path) -> None:
    X = truth(np.random.default_rng(7))
    C = spread(X) @ spread(X).T
    paths = [
        saved(tmp_path / f"{k}.yaml", Y, C, "X_FS", data_sha256=str(k))
        for k, Y in enumerate([X, displaced(X, np.array([5e-3, 0.0, 0.0, 0.0, 0.0, 0.0]))])
    ]
    found = compare_results(*paths)
    assert found.differ
    assert found.origin_deg == pytest.approx(np.degrees(5e-3))
