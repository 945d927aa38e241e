"""Any circle of the robot calibrates: 50 sets with circles of 40 to 200 mm, and the wrist ring of the flange paper."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.stats import chi2
from typer.testing import CliRunner

from tests.worlds.flange_frames import facing, flange_frame
from weldcal.calibration.data.header import DatasetHeader, Feature
from weldcal.calibration.data.results import load_result
from weldcal.calibration.data.writing import save_dataset
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.flange.fit import fit_flange
from weldcal.calibration.flange.observation import observation_from_fit
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.models.scanners import get_scanner
from weldcal.tools.cli.app import app

X_BC = RigidTransform(RollPitchYaw(np.radians([180.0, 0.0, -90.0])), [-0.65, 0.1, 1.25])
SCANNER = get_scanner("phoxi_m", 824)
SCANS, SETS = 8, 50
REPEAT_M = 3e-5  # of the arm, per axis


def scan(name: str, rng: np.random.Generator) -> tuple[RigidTransform, np.ndarray]:
    """The circle's pose in the base as the arm states it, and a scan of it."""
    p = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.60, 0.78)])
    X_CR = facing(p, np.radians(rng.uniform(0.0, 25.0)), *rng.uniform(0.0, 2.0 * np.pi, 2))
    X_BR = X_BC @ X_CR
    X_BR = RigidTransform(X_BR.rotation(), X_BR.translation() + REPEAT_M * rng.normal(size=3))
    return X_BR, flange_frame(SCANNER, get_flange(name), rng, X_CR=X_CR, clutter=2).points_C


def calibrated(name: str, seed: int) -> CalibrationEstimate:
    rng = np.random.default_rng([seed, 90])
    scans = (scan(name, rng) for _ in range(SCANS))
    standard = get_flange(name)
    observations = [
        observation_from_fit(str(k), X_BR, fit_flange(cloud, standard)) for k, (X_BR, cloud) in enumerate(scans)
    ]
    return estimate_eye_on_base(observations, SolveConfig(leave_one_out=False, hypotheses=60))


def test_the_truth_is_in_the_region_of_46_to_50_of_50_circles() -> None:
    squared = []
    for seed in range(SETS):
        rng = np.random.default_rng([seed, 91])
        outer = rng.uniform(40.0, 200.0)
        found = calibrated(f"ring-{outer:.1f}-{outer * rng.uniform(0.4, 0.7):.1f}", seed)
        turn = rotation_vector(X_BC.rotation() @ found.X_BC.rotation().inverse())
        e = np.concatenate([turn, X_BC.translation() - found.X_BC.translation()])
        squared.append(float(e @ np.linalg.solve(found.covariance, e)))
    assert 46 <= sum(s < chi2.ppf(0.95, 6) for s in squared) <= 50
    # 6 on average where the covariance is right; with sigmas half or twice as large 24 or 1.5
    assert 3.0 < np.mean(squared) < 12.0


def test_a_user_calibrates_by_the_wrist_ring(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    X_FR = RigidTransform([0.0, 0.0, -0.02])  # the ring stands 20 mm behind the flange's face
    scans = {f"s{k:02d}": scan("ring-90-63", rng) for k in range(10)}
    header = DatasetHeader(
        schema=1,
        robot="ur10e",
        flange="ring-90-63",
        scanner="phoxi_m",
        configuration="eye_on_base",
        feature_in_flange=Feature([0.0, 0.0, -0.02], [1.0, 0.0, 0.0, 0.0]),
    )
    poses = {id: X_BR @ X_FR.inverse() for id, (X_BR, _) in scans.items()}
    save_dataset(tmp_path / "scans", header, poses, {id: cloud for id, (_, cloud) in scans.items()})
    done = CliRunner().invoke(app, ["calibrate", str(tmp_path / "scans"), "--out", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout.splitlines()[-1])["n_used"] == 10
    found = load_result(tmp_path / "out")
    at = X_BC.inverse() @ np.mean([X.translation() for X in poses.values()], axis=0)
    assert np.linalg.norm(found.X_BC @ at - X_BC @ at) < 0.15e-3
    assert found.flange == "ring-90-63"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("ring-900-63", "must be 30 to 250 mm wide"),
        ("ring-90-0", "needs a bore"),
        ("ring-90-89", "has no flat face left"),
        ("ring-90-63-70-6-m12", "leaves its flat face"),
        ("ring-90", "or ring-OUTER-BORE in mm"),
    ],
)
def test_a_circle_that_cannot_be_is_refused(name: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        get_flange(name)


def test_a_circle_with_holes() -> None:
    flange = get_flange("Ring-90-63-76-6-M5")
    assert flange.n_holes == len(flange.openings()) == 6
    assert flange.openings()[0] == pytest.approx((0.038, 0.0, 0.0025))
