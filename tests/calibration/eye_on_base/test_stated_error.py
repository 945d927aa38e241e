"""The limit of a verification: exceeded as rarely as it says by calibrations as good as they state, and by worse ones
at once."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from typer.testing import CliRunner

from tests.calibration.eye_on_base.test_solve import X_BC, make_observations
from tests.calibration.eye_on_base.test_tcp import _pairs
from weldcal.calibration.data.results import CalibrationResult, PoseRecord, export_ur_pose, load_result, save_result
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.stated_error import (
    FALSE_ALARM,
    orientations_of,
    scatter_elsewhere,
    stated_median_limit,
)
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.verified_scans import VerifyOptions
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.report.first_screen import pose_rows
from weldcal.tools.verified import verify_dataset

SIGMA = 2e-4


def calibrated(n: int, seed: int) -> CalibrationResult:
    estimate = estimate_eye_on_base(
        make_observations(n, seed, sigma=SIGMA), SolveConfig(leave_one_out=False, hypotheses=40)
    )
    return CalibrationResult(
        X_BC=estimate.X_BC,
        covariance=estimate.covariance,
        held_out_mm={},
        tilt_deg={},
        poses=tuple(PoseRecord(id=str(k), used=True) for k in range(n)),
        sigma_position_mm=1e3 * estimate.sigma_position_m,
    )


@pytest.fixture(scope="module")
def good() -> list[CalibrationResult]:
    """150 calibrations from 8 to 15 scans; they do not depend on how many new scans judge them."""
    return [calibrated(8 + seed % 8, seed) for seed in range(150)]


def test_an_error_of_rotation_and_one_of_translation_cancel_where_the_flange_was_measured() -> None:
    """One milliradian about the place of the flange: nothing there, and a tenth of a millimetre 0.1 m beside it."""
    here = make_observations(1, 3)[0]
    arm = np.asarray(here.p_BR - X_BC.translation())
    lever = np.array([[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]])
    # a turn w about the place p moves the camera's origin by w x (origin - p) = p' x w
    A = np.vstack([1e-3 * np.eye(3), 1e-3 * lever])
    result = CalibrationResult(
        X_BC=X_BC,
        covariance=A @ A.T,
        held_out_mm={},
        tilt_deg={},
        poses=tuple(PoseRecord(id=str(k), used=True) for k in range(20)),
        sigma_position_mm=1e-4,
    )
    at_flange = stated_median_limit(result, [replace(here, center_covariance=None)], None)
    assert at_flange is not None
    assert at_flange < 0.01
    beside = replace(here, X_BR=RigidTransform(here.X_BR.rotation(), here.p_BR + np.array([0.1, 0.0, 0.0])))
    moved = replace(beside, p_CR=np.asarray(X_BC.inverse() @ beside.p_BR), center_covariance=None)
    limit = stated_median_limit(result, [moved], None)
    assert limit is not None
    assert 0.1 < limit < 0.5


@pytest.mark.parametrize("new", [1, 5, 20])
def test_good_calibrations_exceed_the_limit_as_rarely_as_said(new: int, good: list[CalibrationResult]) -> None:
    over = 0
    for seed, result in enumerate(good):
        fresh = make_observations(new, 10_000 + seed, sigma=SIGMA)
        limit = stated_median_limit(result, fresh, None)
        assert limit is not None
        over += 1e3 * float(np.median(position_errors(result.X_BC, fresh))) > limit
    # binomial at 1 %: seven or more of 150 are one chance in a thousand
    assert FALSE_ALARM == 0.01
    assert over < 7


def test_the_limit_is_no_wider_than_the_stated_error_asks() -> None:
    """With many poses nothing but the scatter is left: the 99 % quantile of the median of n chi variables."""
    result = replace(calibrated(400, 1), covariance=np.zeros((6, 6)), sigma_position_mm=1e3 * SIGMA)
    rng = np.random.default_rng(0)
    for n in (1, 9):
        drawn = np.median(np.linalg.norm(SIGMA * rng.standard_normal((200_000, n, 3)), axis=2), axis=1)
        limit = stated_median_limit(result, make_observations(n, 2), None)
        assert limit == pytest.approx(1e3 * np.quantile(drawn, 0.99), rel=0.03)


def test_a_wider_stated_percentile_counts_and_nothing_stated_gives_no_limit() -> None:
    result, fresh = calibrated(10, 3), make_observations(6, 4)
    assert stated_median_limit(replace(result, held_out_mm={"p95": 3.5}), fresh, None) == 3.5
    assert stated_median_limit(replace(result, sigma_position_mm=0.0), fresh, None) is None
    assert (
        stated_median_limit(replace(result, held_out_mm={"p95": float("nan")}, sigma_position_mm=0.0), fresh, None)
        is None
    )


def test_the_region_grows_where_the_flange_is_turned_beyond_the_calibration() -> None:
    """An arm that errs by 0.15 mm per axis and orientation: the limit of one scan holds at the orientation of the
    calibration and at others."""
    rng, over = np.random.default_rng(3), []
    for seed in range(60):
        scans = make_observations(14, seed, sigma=1e-4, turn=0.0)
        estimate = estimate_eye_on_base(scans, SolveConfig(leave_one_out=False, hypotheses=40))
        result = CalibrationResult(
            X_BC=estimate.X_BC,
            covariance=estimate.covariance,
            held_out_mm={},
            tilt_deg={},
            poses=tuple(PoseRecord(id=str(k), used=True) for k in range(14)),
            sigma_position_mm=1e3 * estimate.sigma_position_m,
            orientations=orientations_of(scans),
        )
        (new,) = make_observations(1, 10_000 + seed, sigma=1e-4, turn=0.0)
        same = scatter_elsewhere(result, [new])
        assert same == pytest.approx(estimate.sigma_position_m, rel=1e-6)
        turn = RigidTransform(RotationMatrix.MakeZRotation(np.radians(50.0)), np.zeros(3))
        shift = np.asarray(result.X_BC.rotation().matrix().T @ (1.5e-4 * rng.standard_normal(3)))
        turned = replace(new, X_BR=new.X_BR @ turn, p_CR=new.p_CR + shift)
        limit = stated_median_limit(result, [turned], None, scatter_elsewhere(result, [turned]))
        assert limit is not None
        over.append(1e3 * float(position_errors(result.X_BC, [turned])[0]) > limit)
    assert sum(over) <= 3
    assert scatter_elsewhere(replace(result, orientations=None), [turned]) is None
    with pytest.raises(InputError, match="orientations in the result"):
        scatter_elsewhere(replace(result, orientations={"wxyz": [1.0]}), [turned])


def verified(tmp_path: Path, result: CalibrationResult, seed: int = 5, n: int = 8) -> tuple[Path, Path]:
    folder = tmp_path / "result"
    folder.mkdir(exist_ok=True)
    save_result(result, folder)
    return folder, _pairs(tmp_path / f"new{seed}", make_observations(n, seed, sigma=SIGMA, normals=False))


@pytest.mark.parametrize(
    ("shift_mm", "options", "verdict", "code"),
    [
        (0.0, (), "use it", 0),
        (3.0, (), "do not use", 1),
        (3.0, ("--limit-mm", "5"), "use it", 0),
        (0.0, ("--limit-mm", "0.01"), "do not use", 1),
    ],
)
def test_verify_gives_a_verdict_and_ends_with_1_where_it_is_no(
    tmp_path: Path, shift_mm: float, options: tuple[str, ...], verdict: str, code: int
) -> None:
    result = calibrated(14, 20)
    pushed = RigidTransform(result.X_BC.rotation(), result.X_BC.translation() + np.array([0.0, 1e-3 * shift_mm, 0.0]))
    folder, data = verified(tmp_path, replace(result, X_BC=pushed))
    out = tmp_path / "out"
    run = CliRunner().invoke(app, ["verify", str(folder), str(data), *options, "--out", str(out), "--json"])
    said = json.loads(run.stdout.splitlines()[-1])
    assert (run.exit_code, said["state"], said["verdict"]) == (code, "done", verdict), run.output
    assert (said["position_error_mm"]["median"] > said["limit_mm"]) == bool(code)
    assert f"{said['limit_mm']:.3f} mm" in said["reason"]
    assert json.loads((out / "verification.json").read_text())["verdict"] == verdict
    page = (out / "report.html").read_text().replace('<span class="option">--limit-mm</span>', "--limit-mm")
    assert page.index(said["reason"]) < page.index("Limit of the median") < page.index("All scans")
    assert verdict.capitalize() in page
    assert (f"The verdict is: {verdict}" in run.stderr) == bool(code)


def test_few_new_scans_and_concerns_leave_it_at_care(tmp_path: Path) -> None:
    folder, data = verified(tmp_path, calibrated(14, 20), n=3)
    few = verify_dataset(folder, data, tmp_path / "few").verdict
    assert few.verdict == "use with care"
    assert "fewer than 4 new scans" in few.reason
    other = replace(calibrated(14, 20), robot="ur5e")
    folder, data = verified(tmp_path, other, seed=6)
    named = verify_dataset(folder, data, tmp_path / "other").verdict
    assert named.verdict == "use with care"
    assert "'ur5e'" in named.reason
    folder, data = verified(tmp_path, replace(calibrated(14, 20), sigma_position_mm=0.0), seed=7)
    silent = verify_dataset(folder, data, tmp_path / "silent").verdict
    assert (silent.verdict, silent.limit_mm) == ("use with care", None)
    assert "--limit-mm" in silent.reason


def test_the_scans_of_the_calibration_are_no_verification(tmp_path: Path) -> None:
    folder, data = verified(tmp_path, calibrated(14, 20))
    hashes = {"pairs.csv": verify_dataset(folder, data, tmp_path / "first").hashes["pairs.csv"]}
    save_result(replace(load_result(folder), data_hashes=hashes), folder)
    run = CliRunner().invoke(app, ["verify", str(folder), str(data), "--out", str(tmp_path / "out"), "--json"])
    said = json.loads(run.stdout.splitlines()[-1])
    assert run.exit_code == 0, run.output
    assert said["verdict"] == "not a verification"
    assert "Take new scans" in said["reason"]


def test_the_terminal_prints_the_verdict_and_the_pose(tmp_path: Path) -> None:
    _, data = verified(tmp_path, calibrated(14, 20), n=12)
    _, new = verified(tmp_path, calibrated(14, 20), seed=9)
    result = tmp_path / "made"
    made = CliRunner().invoke(app, ["calibrate", str(data), "--out", str(result)])
    judged = CliRunner().invoke(app, ["verify", str(result), str(new), "--out", str(tmp_path / "out")])
    found = load_result(result).X_BC
    x, y, z = 1e3 * found.translation()
    for run, symbol in ((made, "X_BC"), (judged, "X_BC, judged")):
        assert f"{symbol} {x:.3f}, {y:.3f}, {z:.3f} mm; rotation vector" in " ".join(run.stdout.split())
    assert judged.stdout.startswith("verify: use it")
    every = CliRunner().invoke(app, ["verify", str(result), str(new), "--out", str(tmp_path / "all"), "-v"])
    text = " ".join(every.stdout.split())
    assert f"position {x:+.3f} {y:+.3f} {z:+.3f} mm" in text
    assert f"UR pose {export_ur_pose(found).strip()}" in text
    assert "verdict use it" in text
    live = pose_rows(found.GetAsMatrix4().tolist())
    assert live["UR pose"] == export_ur_pose(found).strip()


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan")])
def test_a_limit_that_is_none_is_refused(tmp_path: Path, limit: float) -> None:
    with pytest.raises(InputError, match="limit must be a positive number"):
        verify_dataset(tmp_path, tmp_path, tmp_path / "out", VerifyOptions(limit_mm=limit))
