"""Another pen on a camera that was calibrated before: as exact as a full calibration, and sure of what it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.calibration.tablet.test_wrist import GRID, X_BT, X_FC, visit
from tests.calibration.tablet.visit import csv_options, rows_of, run, write, write_visit
from weldcal.calibration.errors import EqualRotations, TooFewLandmarks
from weldcal.calibration.tablet.result import TabletResult, load_tablet_result, save_tablet_result
from weldcal.calibration.tablet.wrist.fit import WristFit, WristTouches, fit_wrist, measured_point, move
from weldcal.calibration.tablet.wrist.known_camera import KnownCamera, fit_pen, moved_camera

NEW_PEN = np.array([0.003, -0.028, 0.131])
NOISE = {"touch_m": 0.15e-3, "pixel": 0.15}
MOST_WORSE = 1.2
By = Literal["touches", "picture"]


def two_visits(seed: int, tilt: float) -> tuple[KnownCamera, WristTouches]:
    """The camera by a first visit with another pen, and the second visit."""
    first = fit_wrist(visit(tilt=tilt, seed=1000 + seed, **NOISE), leave_one_out=False)
    return KnownCamera(first.X_FC, first.covariance, "first"), visit(tilt=tilt, seed=seed, p_FP=NEW_PEN, **NOISE)


def pen(known: KnownCamera, data: WristTouches, by: By) -> WristFit:
    return fit_pen(replace(data, views=()) if by == "touches" else data, known, leave_one_out=False)


def unseen_mm(fit: WristFit, tilt: float, seed: int, *, elsewhere: bool) -> float:
    """Mean miss of the new pen at 20 points that nobody touched, each looked at by the camera: from where the picture
    was taken, or from ``elsewhere``, with the camera turned and leaning by up to 12 deg."""
    rng, misses = np.random.default_rng([seed, 1]), []
    middle = X_BT.multiply(np.r_[GRID[4], 0.0])
    for p in rng.uniform([0.0, 0.0], GRID.max(axis=0), (20, 2)):
        X_BF = RigidTransform(RollPitchYaw(np.pi, 0.0, -1.0), [0.5, -0.1, 0.40])
        turn = RollPitchYaw(np.pi + rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(-np.pi, np.pi))
        if elsewhere:
            R = turn.ToRotationMatrix()
            X_BF = RigidTransform(
                R, middle - (R @ X_FC.rotation()).multiply([0.0, 0.0, 0.3]) - R.multiply(X_FC.translation())
            )
        p_B = X_BT.multiply(np.r_[p, 0.0])
        p_C = (X_BF @ X_FC).inverse().multiply(p_B)
        lean = np.radians(tilt) * rng.uniform(-1.0, 1.0, 2)
        R = RollPitchYaw(np.pi + lean[0], lean[1], rng.uniform(-np.pi, np.pi)).ToRotationMatrix()
        tip = measured_point(fit, X_BF, p_C[:2] / p_C[2]) + R.multiply(NEW_PEN - fit.p_FP)
        misses.append(np.linalg.norm((tip - p_B) @ X_BT.rotation().matrix()[:, :2]))
    return 1e3 * float(np.mean(misses))


@pytest.mark.parametrize(
    ("by", "tilt", "elsewhere"),
    [
        ("touches", 12.0, True),
        ("picture", 12.0, True),
        ("picture", 12.0, False),
        ("picture", 3.0, False),
        ("picture", 0.0, False),
    ],
)
def test_another_pen_touches_as_well_as_after_a_full_calibration(by: By, tilt: float, elsewhere: bool) -> None:
    whole, kept = [], []
    for seed in range(30):
        known, data = two_visits(seed, tilt)
        fit = pen(known, data, by)
        assert fit.X_FC.IsExactlyEqualTo(known.X_FC)
        np.testing.assert_array_equal(fit.covariance, known.covariance)
        kept.append(unseen_mm(fit, tilt, seed, elsewhere=elsewhere))
        whole.append(unseen_mm(fit_wrist(data, leave_one_out=False), tilt, seed, elsewhere=elsewhere))
    assert np.mean(kept) < MOST_WORSE * np.mean(whole)


@pytest.mark.parametrize("by", ["touches", "picture"])
def test_the_pen_is_as_sure_as_it_says(by: By) -> None:
    squares = []
    for seed in range(40):
        fit = pen(*two_visits(seed, 12.0), by)
        e = fit.p_FP - NEW_PEN
        squares.append(e @ np.linalg.solve(fit.pen_covariance, e))
    # chi-square with 3 degrees of freedom, its variance estimated: mean 3 to 3.6, its standard error 0.5
    assert 3.3 - 1.3 < np.mean(squares) < 3.3 + 1.3


def test_an_upright_pen_has_its_length_from_the_picture() -> None:
    first = fit_wrist(visit(tilt=12.0, seed=1000, **NOISE), leave_one_out=False)
    known = KnownCamera(first.X_FC, first.covariance, "first")
    data = visit(tilt=0.0, p_FP=NEW_PEN, **NOISE)
    by_touches, by_picture = pen(known, data, "touches"), pen(known, data, "picture")
    assert "tilt the hand" in by_touches.unobservable[0]
    assert "--image" in by_touches.unobservable[1]
    assert by_picture.unobservable == ()
    np.testing.assert_allclose(by_picture.p_FP, NEW_PEN, atol=3.0 * np.sqrt(by_picture.pen_covariance[2, 2]))
    assert np.sqrt(by_picture.pen_covariance[2, 2]) < 1e-3


def test_a_camera_that_did_not_move_is_not_doubted_and_one_that_did_is() -> None:
    for seed in range(40):
        known, data = two_visits(seed, 12.0)
        free = fit_wrist(data, leave_one_out=False)
        assert moved_camera(free, known) == ()
        for step in ([0.0, 0.009, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.002, 0.0]):
            (sentence,) = moved_camera(free, replace(known, X_FC=move(known.X_FC, np.array(step))))
            assert "without --known-camera" in sentence


def test_what_fixes_no_pen_is_refused() -> None:
    known, data = two_visits(0, 12.0)
    assert fit_pen(data.pick(np.isin(np.arange(9), [0, 2, 4, 6])), known).p_FP == pytest.approx(NEW_PEN, abs=2e-3)
    with pytest.raises(TooFewLandmarks):
        fit_pen(data.pick(np.arange(9) < 3), known)
    with pytest.raises(EqualRotations):
        fit_pen(replace(data, X_BF=(data.X_BF[0],) * 9, views=()), known)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder of a full calibration."""
    folder = write_visit(tmp_path_factory.mktemp("first"))
    code, _, output = run(*csv_options(folder), "--image", folder / "picture.png", "--out", folder / "out")
    assert code == 0, output
    return folder / "out"


def test_files_of_touches_alone_give_the_pen(first: Path, tmp_path: Path) -> None:
    visit = write_visit(tmp_path, NEW_PEN)
    poses = write(tmp_path / "alone.csv", [row for row in rows_of(visit / "poses.csv") if row["landmark"] != "camera"])
    code, said, output = run(
        visit / "touches.csv", "--poses", poses, "--known-camera", first, "--out", tmp_path / "out"
    )
    assert code == 0, output
    np.testing.assert_allclose(said["p_FP_mm"], 1e3 * NEW_PEN, atol=0.3)
    assert (said["model"], said["warnings"], said["unobservable"]) == ("pen", [], [])
    assert said["leave_one_out_mm"] < 0.2
    kept, former = load_tablet_result(tmp_path / "out"), load_tablet_result(first)
    assert kept.X_FC_covariance == former.X_FC_covariance
    for name in ("camera.urdf.xacro", "ur_pose.script"):
        assert (tmp_path / "out" / name).read_text() == (first / name).read_text()


def test_a_moved_camera_is_named_and_the_advice_works(first: Path, tmp_path: Path) -> None:
    moved = move(X_FC, np.array([0.0, 0.02, 0.0, 0.003, 0.0, 0.0]))
    visit = write_visit(tmp_path, NEW_PEN, moved)
    given = [*csv_options(visit), "--image", visit / "picture.png", "--out"]
    code, said, output = run(*given, tmp_path / "pen", "--known-camera", first)
    assert code == 0, output
    assert "without --known-camera" in said["warnings"][0]
    np.testing.assert_allclose(said["p_FP_mm"], 1e3 * NEW_PEN, atol=0.3)
    code, said, output = run(*given, tmp_path / "anew")
    assert code == 0, output
    assert said["warnings"] == []
    assert RigidTransform(np.array(said["X_FC"])).IsNearlyEqualTo(moved, 2e-2)
    code, said, output = run(*given, tmp_path / "again", "--known-camera", tmp_path / "anew")
    assert (code, said["model"], said["warnings"]) == (0, "pen_and_picture", []), output


def test_what_holds_no_camera_is_refused(tmp_path: Path) -> None:
    visit = write_visit(tmp_path, NEW_PEN)
    planar = TabletResult(model="pnp", parameters={}, covariance=[[0.0]], residual_mm=[0.0], leave_one_out_mm=[])
    save_tablet_result(planar, tmp_path)
    code, _, output = run(*csv_options(visit), "--seen", visit / "seen.csv", "--known-camera", tmp_path)
    assert code != 0
    assert "does not hold the camera's pose" in output
