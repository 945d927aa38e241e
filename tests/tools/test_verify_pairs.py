"""Results of other programs are judged on pairs, and both sides of the rule hold; the pairs are made here."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import weldcal
from tests.calibration.hand_eye import rendering as draw
from tests.calibration.hand_eye.stated_forms import FORMS, truth, write
from tests.documents.scans import X_BC, write_scans
from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.hand_eye.pairs.judging import judge_pose
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig
from weldcal.calibration.verified_pairs import PairsOptions
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.report.verify_pairs import CANNOT_TELL, PairsReport
from weldcal.tools.verified import verify_dataset, verify_on_pairs

Array = NDArray[np.float64]
NOISE_RAD, NOISE_M = np.radians(0.05), 3e-4


def _pose(vector: Array, p: Array) -> Array:
    X = np.zeros((*np.shape(p)[:-1], 4, 4))
    X[..., :3, :3], X[..., :3, 3], X[..., 3, 3] = Rotation.from_rotvec(vector).as_matrix(), p, 1.0
    return X


def pairs(n: int, seed: int, X: Array, noise: float = 1.0) -> tuple[Array, Array, Array]:
    """Robot poses, camera poses of a target half a metre away, and the target's pose: A X B = Y up to the noise of
    B."""
    rng = np.random.default_rng(seed)
    B = _pose(0.3 * rng.normal(size=(n, 3)), [0.0, 0.0, 0.5] + 0.05 * rng.normal(size=(n, 3)))
    Y = _pose(rng.normal(size=3), 0.5 * rng.normal(size=3))
    A = Y @ np.linalg.inv(X @ B)
    error = _pose(noise * NOISE_RAD * rng.normal(size=(n, 3)), noise * NOISE_M * rng.normal(size=(n, 3)))
    return A, B @ error, Y


def saved(folder: Path, n: int, seed: int, X: Array, mode: str = "eye_in_hand", noise: float = 1.0) -> Path:
    A, B, _ = pairs(n, seed, X, noise)
    words = {"mode": mode} if mode else {}
    np.savez(folder / "pairs.npz", A=A, B=B, **words)  # type: ignore[arg-type]
    return folder / "pairs.npz"


def moved(X: Array, mm: float, seed: int) -> Array:
    """The pose, displaced by so many millimetres in a random direction."""
    step = np.random.default_rng(seed).normal(size=3)
    out = X.copy()
    out[:3, 3] += 1e-3 * mm * step / np.linalg.norm(step)
    return out


def verdict(result: Path, data: Path, limit_mm: float | None = None, mounting: str | None = None) -> PairsReport:
    return verify_on_pairs(result, data, None, PairsOptions(mounting=mounting), limit_mm=limit_mm)


@pytest.mark.parametrize("form", FORMS)
def test_a_right_result_is_accepted_in_every_form(form: str, tmp_path: Path) -> None:
    X = truth(1)
    found = verdict(write(form, X, tmp_path), saved(tmp_path, 16, 1, X))
    assert found.verdict.verdict == "use it", found.verdict.reason
    assert np.abs(found.judgement.X - X).max() < 2e-6


@pytest.mark.parametrize("form", ["easy_handeye", "MoveIt 2 launch", "URDF", "matrix txt", "quaternion wxyz first"])
def test_a_result_two_millimetres_off_is_not_accepted_in_any_form(form: str, tmp_path: Path) -> None:
    X = truth(1)
    found = verdict(write(form, moved(X, 2.0, 0), tmp_path), saved(tmp_path, 16, 1, X))
    assert found.verdict.verdict == "do not use"
    assert found.judgement.off_mm == pytest.approx(2.0, abs=0.8)


def test_both_sides_of_the_rule_hold_over_seeds(tmp_path: Path) -> None:
    runs, accepted, refused = 60, 0, 0
    for seed in range(runs):
        X = truth(seed)
        A, B, _ = pairs(16, 1000 + seed, X)
        problem = full_problem(A, B)
        config = HandEyeConfig(folds=0)
        _, right = judge_pose(problem, [X], None, config)
        _, wrong = judge_pose(problem, [moved(X, 2.0, seed)], None, config)
        accepted += not right.rejected
        refused += wrong.rejected
    # 1 % false alarms: 60 runs have three or fewer of them with 99.7 %
    assert accepted >= runs - 3
    assert refused >= 0.95 * runs


def test_too_few_or_noisy_pairs_cannot_tell(tmp_path: Path) -> None:
    X = truth(2)
    result = write("matrix txt", X, tmp_path)
    noisy = verdict(result, saved(tmp_path, 8, 3, X, noise=5.0))
    assert noisy.verdict.verdict == CANNOT_TELL
    assert noisy.judgement.shown_mm > 2.0
    assert noisy.first.verdict == "use with care"
    few = verdict(result, saved(tmp_path, 2, 3, X))
    assert few.verdict.verdict == CANNOT_TELL
    assert "no solution of their own" in few.verdict.reason


def test_a_limit_moves_the_rule_both_ways(tmp_path: Path) -> None:
    X = truth(4)
    data = saved(tmp_path, 16, 5, X)
    right, wrong = write("matrix txt", X, tmp_path), write("easy_handeye", moved(X, 2.0, 1), tmp_path)
    assert verdict(right, data, limit_mm=0.2).verdict.verdict == CANNOT_TELL
    assert verdict(wrong, data, limit_mm=5.0).verdict.verdict == "use with care"
    assert verdict(wrong, data, limit_mm=1.0).verdict.verdict == "do not use"


def test_inverse_target_and_turned_axes_are_named(tmp_path: Path) -> None:
    X = truth(6)
    A, B, Y = pairs(16, 7, X)
    np.savez(tmp_path / "pairs.npz", A=A, B=B, mode="eye_in_hand")
    optical_in_body = np.eye(4)
    optical_in_body[:3, :3] = Rotation.from_euler("ZYX", [-90, 0, -90], degrees=True).as_matrix()
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    for stated, words in (
        (np.linalg.inv(X), "The inverse of RESULT fits: 0"),
        (Y, "RESULT as the pose of the target fits"),
        (X @ np.linalg.inv(optical_in_body), "RESULT with the axes of the optical frame"),
        (turned @ X, "carries the camera turned by 180 degrees about z fits"),
    ):
        np.savetxt(tmp_path / "X.txt", stated)
        found = verdict(tmp_path / "X.txt", tmp_path / "pairs.npz").verdict
        assert found.verdict == "do not use"
        assert words in found.reason


def test_the_other_mounting_is_named(tmp_path: Path) -> None:
    X = truth(8)
    result = write("matrix txt", X, tmp_path)
    data = saved(tmp_path, 16, 9, X, mode="")
    assert verdict(result, data).mounting.name == "eye_in_hand"  # RESULT fits in one mounting only
    with pytest.raises(
        InconsistentPoses, match=r"RESULT fits them as eye_in_hand, within .* give --mounting eye_in_hand"
    ):
        verdict(result, data, mounting="eye_on_base")
    eye_on_base = write("easy_handeye", X, tmp_path)
    eye_on_base.write_text(eye_on_base.read_text().replace("eye_on_hand: true", "eye_on_hand: false"))
    found = verdict(eye_on_base, data, mounting="eye_in_hand").verdict
    assert found.verdict == "do not use"
    assert "RESULT is for the mounting eye_on_base" in found.reason


def test_a_result_of_the_same_pairs_is_no_verification(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    saved(tmp_path, 24, 11, truth(10))
    run = CliRunner().invoke(app, ["hand-eye", "ax-yb", "pairs.npz", "--out", "own"])
    assert run.exit_code == 0, run.output
    for result in ("own", "own/hand_eye.json"):
        run = CliRunner().invoke(app, ["verify", result, "pairs.npz", "--json", "--out", f"v{len(result)}"])
        assert run.exit_code == 0
        assert json.loads(run.stdout.splitlines()[-1])["verdict"] == "not a verification"
    A, B, _ = pairs(24, 12, truth(10))
    np.savez("pairs.npz", A=A, B=B)
    run = CliRunner().invoke(app, ["verify", "own", "pairs.npz", "--json", "--out", "new"])
    assert json.loads(run.stdout.splitlines()[-1])["verdict"] == "use it"
    assert (tmp_path / "new" / "report.html").is_file()


def test_the_exit_code_is_one_for_do_not_use_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    X = truth(12)
    saved(tmp_path, 14, 13, X)
    write("easy_handeye", X, tmp_path)
    write("matrix txt", moved(X, 3.0, 0), tmp_path)
    assert CliRunner().invoke(app, ["verify", "eye.yaml", "pairs.npz"]).exit_code == 0
    run = CliRunner().invoke(app, ["verify", "eMc.txt", "pairs.npz"])
    assert run.exit_code == 1
    assert "do not use" in run.stderr


def test_verify_from_python_takes_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    X = truth(14)
    found = weldcal.verify(write("URDF", X, tmp_path), saved(tmp_path, 14, 15, X))
    assert found.verdict.verdict == "use it"


def test_the_flange_and_the_names_of_a_result_without_dataset_yaml(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, seed in (("scans", 0), ("others", 1)):
        write_scans(tmp_path / name, 5, seed)
        (tmp_path / name / "dataset.yaml").unlink()
    weldcal.calibrate("scans", out="result", flange="iso9409-1-50-4-m6", correct_scanner=False)
    report = weldcal.verify("result", "others", out="verified")  # the result knows the flange
    assert report.verdict.verdict in ("use it", "use with care")
    for name in ("result", "verified"):
        page = (tmp_path / name / "report.html").read_text()
        assert ", , flange" not in page
        assert ">flange iso9409-1-50-4-m6" in page


def test_a_camera_beside_the_robot_is_judged_too(tmp_path: Path) -> None:
    X, (_, B, Y) = truth(16), pairs(16, 17, truth(16))
    robot = X @ B @ np.linalg.inv(Y)  # X_BF of a target on the flange at Y
    np.savez(tmp_path / "pairs.npz", A=robot, B=B, mode="eye_on_base")
    right, wrong = write("matrix txt", X, tmp_path), write("quaternion", moved(X, 2.0, 2), tmp_path)
    assert verdict(right, tmp_path / "pairs.npz").verdict.verdict == "use it"
    assert verdict(wrong, tmp_path / "pairs.npz").verdict.verdict == "do not use"


def test_kalibr_states_the_body_in_the_camera_and_the_inverse_is_named(tmp_path: Path) -> None:
    X = truth(18)
    found = verdict(
        write("Kalibr", np.asarray(np.linalg.inv(X), dtype=np.float64), tmp_path), saved(tmp_path, 16, 19, X)
    ).verdict
    assert found.verdict == "do not use"
    assert found.reason.startswith("The inverse of RESULT fits: 0.")


def test_a_result_is_judged_on_pictures_of_a_board(tmp_path: Path) -> None:
    """Rendered pictures: the true pose is used; one that is 6 mm off is not, and the command that solves anew runs as
    printed."""
    drawing = draw.draw_chessboard(9, 6, 20)
    world = draw.world(drawing, 7, 20)
    shots = tmp_path / "shots"
    draw.write_pictures(shots, drawing, world, 7, sub=2)
    draw.write_robot(shots / "robot.csv", world.robot)
    call = ["verify", "", str(shots), "--board", "chessboard:9x6:20", "--json", "--out", ""]
    found = {}
    for name, X in (("right", world.X), ("wrong", moved(world.X, 6.0, 1))):
        call[1], call[-1] = str(write("matrix txt", X, tmp_path)), str(tmp_path / name)
        done = CliRunner().invoke(app, call)
        found[name] = done.exit_code, json.loads(done.stdout.splitlines()[-1])["verdict"]
    assert found == {"right": (0, "use it"), "wrong": (1, "do not use")}
    page = (tmp_path / "wrong" / "report.html").read_text()
    assert "--mounting eye_in_hand --board chessboard:9x6:20" in page


@pytest.mark.parametrize("form", ["URDF", "quaternion wxyz first", "matrix txt"])
def test_a_pose_of_any_file_is_judged_on_scans(form: str, tmp_path: Path) -> None:
    """The errors at the flange are those of the written pose: none beyond the noise where it is the truth, and 5 mm
    where it is that far off."""
    data = write_scans(tmp_path / "scans", 4, 0)
    medians = {}
    for mm in (0.0, 5.0):
        path = write(form, moved(np.asarray(X_BC.GetAsMatrix4()), mm, 3), tmp_path)
        out = tmp_path / f"verified_{mm:.0f}"
        done = CliRunner().invoke(app, ["verify", str(path), str(data), "--limit-mm", "1", "--json", "--out", str(out)])
        found = json.loads(done.stdout.splitlines()[-1])
        assert done.exit_code == (1 if mm else 0), done.output
        medians[mm] = found["position_error_mm"]["median"]
    assert medians[0.0] < 0.5
    assert medians[5.0] == pytest.approx(5.0, abs=0.5)


def test_a_camera_on_the_flange_is_not_judged_on_scans_of_the_flange(tmp_path: Path) -> None:
    path = write("easy_handeye", truth(1), tmp_path)
    with pytest.raises(InputError, match=r"camera on the flange.*--board"):
        verify_dataset(path, write_scans(tmp_path / "scans", 2, 0), tmp_path / "out")
