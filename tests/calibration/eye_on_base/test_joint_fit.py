"""X_BC and the scanner's errors are estimated together, and the covariance holds what few poses leave open of both."""

from __future__ import annotations

import numpy as np

from tests.calibration.eye_on_base.test_self_calibration import WRONG, X_BC, _cell
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly
from weldcal.calibration.eye_on_base.solve import estimate_eye_on_base

WORK_C = np.array([0.03, -0.02, 0.45])


def test_a_wrong_scanner_no_longer_shifts_the_work_point() -> None:
    observations, _ = _cell(WRONG, n=10)
    seen = WORK_C.copy()
    for _ in range(20):
        seen = seen + WORK_C - WRONG.points(seen)
    rigid, joint = estimate_eye_on_base(observations), estimate_jointly(observations)
    assert joint.scanner is not None
    truth = X_BC @ WORK_C
    error = float(np.linalg.norm(joint.X_BC @ joint.scanner.points(seen) - truth))
    assert error < 3e-4
    assert float(np.linalg.norm(rigid.X_BC @ seen - truth)) > 2.0 * error


def test_an_outlier_is_left_out_and_its_held_out_error_is_large() -> None:
    observations, _ = _cell(WRONG, n=12)
    bad = observations[4]
    object.__setattr__(bad, "p_CR", bad.p_CR + np.array([0.03, 0.0, 0.0]))
    estimate = estimate_jointly(observations)
    assert np.flatnonzero(~estimate.inliers).tolist() == [4]
    assert estimate.held_out.position_m[4] > 0.02
    assert np.delete(estimate.held_out.position_m, 4).max() < 2e-3
