"""The error budget adds up to what is held out, and names what pays most."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.calibration.eye_on_base.test_solve import make_observations
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.stated_error import ErrorBudget, error_budget
from weldcal.calibration.flange.observation import Observation
from weldcal.models.arrays import Array

SIGMA = 2e-4


def _estimate(n: int, seed: int) -> tuple[CalibrationEstimate, list[Observation]]:
    scans = make_observations(n, seed, sigma=SIGMA)
    return estimate_eye_on_base(scans, SolveConfig(hypotheses=40)), list(scans)


def _row(budget: ErrorBudget, start: str) -> float:
    return next(r.mm for r in budget.rows if r.source.startswith(start))


def test_measured_rows_and_the_arm_s_sheet_make_up_the_held_out_errors() -> None:
    estimate, scans = _estimate(60, 0)
    budget = error_budget(estimate, scans, repeatability_m=1e-4, scale_error=0.0)
    measured = [r.mm for r in budget.rows if r.basis != "assumed"]
    assert budget.held_out_mm == pytest.approx(1e3 * SIGMA * np.sqrt(3.0), rel=0.2)
    # the estimate is surest in the middle, where the budget is stated
    assert np.sqrt(np.sum(np.square(measured))) == pytest.approx(budget.held_out_mm, rel=0.06)
    assert _row(budget, "repeatability") == pytest.approx(0.1)
    assert budget.next.source.startswith("kinematics")
    assert "--refine" in budget.sentence
    quiet = error_budget(estimate, scans, repeatability_m=1e-3, scale_error=0.0)
    assert _row(quiet, "kinematics") == 0.0
    assert quiet.next.source.startswith("repeatability")
    # a scanner that nothing is known of may be all that is left
    unknown = error_budget(estimate, scans, repeatability_m=1e-4)
    assert _row(unknown, "distortion") > 0.2
    assert _row(unknown, "kinematics") < _row(budget, "kinematics")
    assert unknown.total_mm == pytest.approx(budget.total_mm, rel=0.1)


def test_the_scanner_s_part_is_what_knowing_it_would_take_away() -> None:
    estimate, scans = _estimate(20, 1)
    joint = np.zeros((9, 9))
    joint[:6, :6] = estimate.covariance
    joint[6, 6] = 1e-3**2
    joint[5, 6] = joint[6, 5] = 0.5 * 1e-3 * np.sqrt(estimate.covariance[5, 5])
    corrected = replace(estimate, scanner=ScannerCorrection(1.001), joint=joint)
    budget = error_budget(corrected, scans)
    middle = np.array(budget.p_B_mm) / 1e3
    whole = float(np.trace(point_error_covariance(corrected, middle)))
    pose, scanner = _row(budget, "pose"), _row(budget, "distortion")
    assert pose**2 + scanner**2 == pytest.approx(1e6 * whole)
    drawn = _conditional(joint, corrected, middle)
    assert pose == pytest.approx(1e3 * drawn, rel=0.02)


def _conditional(joint: Array, estimate: CalibrationEstimate, p: Array) -> float:
    """Root mean square error of the point where the factor is known: what regression on it leaves of drawn errors."""
    rng = np.random.default_rng(0)
    X = rng.multivariate_normal(np.zeros(9), joint, 40_000)
    arm = p - estimate.X_BC.translation()
    e = np.cross(X[:, :3], arm) + X[:, 3:6]
    slope = e.T @ X[:, 6] / float(X[:, 6] @ X[:, 6])
    left = e - np.outer(X[:, 6], slope)
    return float(np.sqrt((left**2).sum(axis=1).mean()))


def test_without_held_out_errors_the_usual_scatter_counts() -> None:
    estimate, scans = _estimate(12, 2)
    bare = replace(estimate, held_out=replace(estimate.held_out, position_m=np.full(12, np.nan)))
    budget = error_budget(bare, scans)
    assert budget.held_out_mm is None
    assert budget.total_mm > 1e3 * np.sqrt(2.0) * estimate.sigma_position_m
    document = budget.document()
    assert isinstance(document["rows"], list)
    assert len(document["rows"]) == 7
    assert {r.basis for r in budget.rows} <= {"measured", "data sheet", "assumed"}


def test_the_flange_s_tolerance_is_that_of_grade_8() -> None:
    estimate, scans = _estimate(12, 3)
    # ISO 286-1, 50 to 80 mm: IT8 is 46 um
    assert _row(error_budget(estimate, scans), "tolerance") == pytest.approx(46e-3 * np.sqrt(2.0 / 12.0), rel=0.02)
