"""Boards that are bent, stretched and printed unevenly: camera and hand-eye pose are as far off as is stated."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.stats import f as f_distribution
from typer.testing import CliRunner

from tests.calibration.hand_eye import rendering as draw
from tests.calibration.hand_eye.made_boards import Made, Seen, seen
from weldcal.calibration.data.camera_file import CameraFile, camera_document, read_camera
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import difference, moved
from weldcal.calibration.hand_eye.pictures.boards import parse_board
from weldcal.calibration.hand_eye.pictures.bundle import Bundle, Corners, adjust
from weldcal.calibration.hand_eye.pictures.camera import CameraEstimate, camera_of
from weldcal.calibration.hand_eye.pictures.search import Picture
from weldcal.calibration.recorded_hand_eye import HandEyeOptions, calibrate_recorded
from weldcal.tools.cli.app import app

BOARD = parse_board("chessboard:9x6:20")
TRUE = np.array([draw.K[0, 0], draw.K[1, 1], draw.K[0, 2], draw.K[1, 2], *draw.DIST])


def solved(world: Seen, seed: int, *, eye_in_hand: bool) -> Bundle:
    """The adjustment from a start that is off."""
    rng = np.random.default_rng(seed + 1_000_000)
    return adjust(
        Corners(robot=world.robot, img=world.img, obj=world.obj, eye_in_hand=eye_in_hand),
        moved(world.X, rng.normal(0.0, 3e-3, 6)),
        moved(world.Y, rng.normal(0.0, 3e-3, 6)),
        np.diag([1.01, 1.01, 1.0]) @ draw.K,
        np.append(0.9 * draw.DIST, 0.0),
        free=np.arange(8),
        sigma_px=0.3,
        sigma_rad=1e-3,
        sigma_m=1e-3,
    )


def pictures(world: Seen) -> list[Picture]:
    return [Picture(name=f"{k:02d}.png", points=uv, size=draw.SIZE, thumbnail=b"") for k, uv in enumerate(world.img)]


def square(e: np.ndarray, C: np.ndarray) -> float:
    return float(e @ np.linalg.solve(C, e))


def camera_error(camera: CameraFile) -> np.ndarray:
    return (camera.numbers - np.append(TRUE, 0.0))[:8]


def test_the_stated_region_of_the_corners_holds_the_truth_as_often_as_it_says() -> None:
    """On 60 boards of three forms with errors of the robot, and X no worse than the best method of OpenCV."""
    inside, X_squares, K_squares, ours, theirs = [], [], [], [], []
    for seed in range(60):
        hand, form = bool(seed % 2), ("cylinder", "saddle", "wave")[seed % 3]
        world = seen(seed, Made(form=form, arm="each", deg=0.05, mm=0.3), eye_in_hand=hand)
        found = solved(world, seed, eye_in_hand=hand)
        e = difference(found.X, world.X)
        X_squares.append(square(e, found.covariance[:6, :6]) / 6.0)
        inside.append(X_squares[-1] < f_distribution.ppf(0.95, 6, found.degrees_of_freedom))
        K_squares.append(square(camera_error(CameraFile(found.K, found.distortion, None)), found.camera_covariance) / 8)
        ours.append(float(np.linalg.norm(e[3:])))
        turns, shifts = [], []
        for points in world.img:
            _, w, t = cv2.solvePnP(world.obj, points, found.K, found.distortion)
            turns.append(cv2.Rodrigues(w)[0])
            shifts.append(t)
        B = world.robot if hand else np.linalg.inv(world.robot)
        best = np.inf
        for method in (cv2.CALIB_HAND_EYE_TSAI, cv2.CALIB_HAND_EYE_PARK, cv2.CALIB_HAND_EYE_DANIILIDIS):
            _, t = cv2.calibrateHandEye(B[:, :3, :3], B[:, :3, 3], turns, shifts, method=method)
            best = min(best, float(np.linalg.norm(np.ravel(t) - world.X[:3, 3])))
        theirs.append(best)
    # 2.5 standard deviations of 60 draws about 95 % and about the mean of F(6, 30 to 60), 1.03 to 1.07
    assert np.mean(inside) >= 0.87
    assert 0.85 < np.mean(X_squares) < 1.25
    assert 0.80 < np.mean(K_squares) < 1.25
    # even against the method that happens to be best in each world
    assert np.sqrt(np.mean(np.square(ours))) <= 1.05 * np.sqrt(np.mean(np.square(theirs)))


def test_an_arm_with_links_that_are_off_is_not_taken_for_noise() -> None:
    """Its errors are smooth: twenty poses are not twenty independent ones."""
    squares, alike = [], []
    for seed in range(24):
        world = seen(seed, Made(form="saddle"), eye_in_hand=True)
        found = solved(world, seed, eye_in_hand=True)
        squares.append(square(difference(found.X, world.X), found.covariance[:6, :6]) / 6.0)
        alike.append(found.alike)
    # few and large errors: a standard deviation that is right to a factor of 1.5
    assert 0.44 < np.mean(squares) < 2.25
    assert np.mean(alike) > 0.7


def test_a_board_as_the_file_states_it_costs_little() -> None:
    """The board's terms have priors, so that a perfect board gives a region that is less than twice too wide."""
    squares = []
    for seed in range(24):
        ideal = Made(sag=0.0, scale=0.0, skew=0.0, point_m=0.0, shake_px=0.0, px=0.15, arm="each", deg=0.05, n=14)
        world = seen(seed, ideal, eye_in_hand=bool(seed % 2))
        found = solved(world, seed, eye_in_hand=bool(seed % 2))
        squares.append(square(difference(found.X, world.X), found.covariance[:6, :6]) / 6.0)
    assert 0.35 < np.mean(squares) < 1.25


def test_the_camera_alone_is_as_far_off_as_is_stated() -> None:
    """And OpenCV's standard deviations of the same pictures are several times too small."""
    squares, flat, held = [], [], []
    for seed in range(30):
        world = seen(seed, Made(form=("cylinder", "saddle", "wave")[seed % 3], arm="each", n=14))
        found = camera_of(pictures(world), BOARD)
        e = camera_error(found.camera)
        squares.append(square(e, found.bundle.camera_covariance[:8, :8]) / 8.0)
        held.append(found.held_out_px)
        obj = [world.obj.astype(np.float32)] * len(world.img)
        img = [uv.astype(np.float32) for uv in world.img]
        of = cv2.calibrateCameraExtended(obj, img, draw.SIZE, None, None, flags=cv2.CALIB_FIX_K3)  # type: ignore[call-overload]
        flat.append(((of[1][0, 0] - TRUE[0]) / float(np.ravel(of[5])[0])) ** 2)
    assert 0.70 < np.mean(squares) < 1.40
    assert np.mean(flat) > 4.0
    # corners of 0.08 px and a shake of 0.05 px, of both coordinates
    assert 0.10 < np.sqrt(np.mean(np.square(held))) < 0.16


def test_the_shape_of_the_board_is_found() -> None:
    how = Made(form="saddle", sag=6e-3, arm="each", n=25)
    world = seen(3, how)
    found = camera_of(pictures(world), BOARD).bundle
    real = world.true - world.true.mean(axis=0)
    fit = world.obj + found.shape
    fit = fit - fit.mean(axis=0)
    bent = [p[:, 2] - np.c_[p[:, :2], np.ones(len(p))] @ np.linalg.lstsq(np.c_[p[:, :2], np.ones(len(p))], p[:, 2], rcond=None)[0] for p in (real, fit)]  # fmt: skip
    assert np.ptp(bent[0]) > 5e-4
    # the sag to a tenth of what the terms may be
    np.testing.assert_allclose(bent[1], bent[0], atol=1.5e-4)
    flat = world.obj[:, :2] - world.obj[:, :2].mean(axis=0)
    of_real, of_fit = (np.linalg.lstsq(flat, p[:, :2], rcond=None)[0] for p in (real, fit))
    stretch = [M[0, 0] / M[1, 1] - 1.0 for M in (of_real, of_fit)]
    assert abs(stretch[0]) > 2e-3
    # a tenth of a pixel over 54 corners and 25 pictures, and fx against fy
    assert stretch[1] == pytest.approx(stretch[0], abs=1e-3)


@pytest.fixture(scope="module")
def estimate() -> CameraEstimate:
    return camera_of(pictures(seen(5, Made(arm="each", n=16))), BOARD)


def test_a_camera_file_holds_its_covariance(estimate: CameraEstimate, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(camera_document(estimate.camera)))
    found = read_camera(path)
    np.testing.assert_allclose(found.numbers, estimate.camera.numbers)
    assert found.covariance is not None
    np.testing.assert_allclose(found.covariance, estimate.camera.covariance, rtol=1e-9, atol=1e-15)
    assert found.size == draw.SIZE
    assert list(found.free) == list(estimate.free)


@pytest.mark.parametrize(("change", "said"), [(lambda C: C[:-1], "72 numbers"), (lambda C: -C, "not positive")])
def test_a_covariance_that_is_none_is_refused(change, said: str, estimate: CameraEstimate, tmp_path: Path) -> None:
    wrong = camera_document(replace(estimate.camera, covariance=change(estimate.camera.covariance)))
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(wrong))
    with pytest.raises(DatasetError, match=said):
        read_camera(tmp_path / "camera.yaml")


def test_a_camera_that_has_changed_is_named() -> None:
    """One of 12 that has not is named at most, and each with 1 % more focal length is."""
    named, missed = 0, 0
    for seed in range(12):
        how = Made(arm="each", n=14)
        old = camera_of(pictures(seen(seed, how)), BOARD).camera
        again = pictures(seen(seed + 500, how))
        named += camera_of(again, BOARD, ("old.yaml", old)).change.changed  # type: ignore[union-attr]
        longer = replace(old, K=np.diag([1.01, 1.01, 1.0]) @ old.K)
        if seed < 3:
            change = camera_of(again, BOARD, ("old.yaml", longer)).change
            assert change is not None
            missed += not change.changed
            assert "The camera is not as old.yaml states it" in change.sentence
    assert named <= 1
    assert missed == 0


def corner_file(folder: Path, world: Seen, **more: object) -> Path:
    folder.mkdir(exist_ok=True)
    arrays = {"A": world.robot, "img": world.img, "obj": world.obj, "size": draw.SIZE, "mode": "eye_in_hand"} | more
    np.savez(folder / "pairs.npz", **{k: v for k, v in arrays.items() if v is not None})  # type: ignore[arg-type]
    return folder


def test_corners_of_another_detector_need_neither_poses_nor_camera(tmp_path: Path) -> None:
    world = seen(2, Made(arm="each", n=16))
    found = calibrate_recorded(corner_file(tmp_path / "set", world), HandEyeOptions(corners=None))
    assert found.pictures is not None
    assert found.pictures.bundle.K[0, 0] == pytest.approx(draw.K[0, 0], abs=3.0)
    e = difference(np.asarray(found.result.X.GetAsMatrix4()), world.X)
    assert square(e, found.result.covariance["X"]) < 22.5  # 99.9 % of chi-squared with six
    some = world.img.copy()
    some[3, :50] = np.nan
    less = calibrate_recorded(corner_file(tmp_path / "set", world, img=some), HandEyeOptions(corners=None))
    assert "Fewer than 8 points" in less.corners


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"size": None}, "add 'size'"),
        ({"mode": None}, "does not say where the camera is"),
        ({"img": np.zeros((3, 5, 2))}, r"\(poses, points, 2\)"),
        ({"obj": np.random.default_rng(0).normal(size=(54, 3))}, "one plane"),
    ],
)
def test_corners_that_do_not_belong_together_are_a_sentence(more: dict, said: str, tmp_path: Path) -> None:
    world = seen(2, Made(arm="each", n=6))
    with pytest.raises(DatasetError, match=said):
        calibrate_recorded(corner_file(tmp_path / "set", world, **more), HandEyeOptions(corners=None))


def test_the_uncertainty_of_a_camera_file_goes_through(estimate: CameraEstimate, tmp_path: Path) -> None:
    world = seen(5, Made(arm="each", n=16))
    folder = corner_file(tmp_path / "set", world)
    sigma = {}
    for name, camera in (("with", estimate.camera), ("without", replace(estimate.camera, covariance=None))):
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump(camera_document(camera)))
        found = calibrate_recorded(folder, HandEyeOptions(corners=None, intrinsics=path))
        assert f"The camera is as {name}.yaml states it" in found.corners
        sigma[name] = float(np.sqrt(np.trace(found.result.covariance["X"][3:, 3:])))
    alone = calibrate_recorded(folder, HandEyeOptions(corners=None))
    sigma["none"] = float(np.sqrt(np.trace(alone.result.covariance["X"][3:, 3:])))
    assert sigma["without"] < sigma["with"] < 1.02 * sigma["none"]


def test_the_command_writes_a_camera_that_hand_eye_takes(tmp_path: Path) -> None:
    drawing = draw.draw_chessboard(9, 6, 20)
    world = draw.world(drawing, 7, 10)
    draw.write_pictures(tmp_path / "shots", drawing, world, 7, sub=2)
    draw.write_robot(tmp_path / "both" / "poses.txt", world.robot)
    draw.write_pictures(tmp_path / "both", drawing, world, 7, sub=2)

    def run(*words: str) -> dict:
        done = CliRunner().invoke(app, [*words, "--json"])
        assert done.exit_code == 0, done.output
        return json.loads(done.stdout.splitlines()[-1])

    made = ("camera", str(tmp_path / "shots"), "--board", "chessboard:9x6:20")
    found = run(*made, "--out", str(tmp_path / "out"))
    camera = read_camera(tmp_path / "out" / "camera.yaml")
    assert camera.covariance is not None
    sigma = np.sqrt(np.diag(camera.covariance)[:4])
    assert (np.abs(camera.numbers[:4] - TRUE[:4]) < 4.0 * sigma).all()
    assert sigma[0] < 10.0
    assert found["pictures"] == 10
    file = f"intrinsics={tmp_path / 'out' / 'camera.yaml'}"
    again = run(*made, "--as", file, "--out", str(tmp_path / "again"))
    assert again["changed"] is False
    used = run("hand-eye", "ax-yb", str(tmp_path / "both"), "--mounting", "eye_in_hand", "--board", "chessboard:9x6:20",
               "--as", file, "--out", str(tmp_path / "X"))  # fmt: skip
    assert used["camera_changed"] is False
    assert "The camera is as camera.yaml states it" in used["corners"]
