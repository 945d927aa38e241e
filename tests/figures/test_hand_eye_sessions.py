"""One camera on one arm in ten sessions: the stated covariance of X holds the scatter between them."""

from pathlib import Path

import numpy as np
import pytest

from tests.figures.hand_eye.one_camera import REGION, SESSIONS, hand_eye_sessions, nees, scatter, sessions
from tests.figures.harness import Run
from tests.places import SHARED_DATA, require_data
from weldcal.calibration.geometry.se3 import moved


def test_the_scatter_of_ten_sessions_is_as_stated() -> None:
    require_data(SHARED_DATA / SESSIONS)
    found = sessions(SHARED_DATA / SESSIONS)
    value, inside = nees(found)
    # the 95 % range of chi-squared with 54 degrees of freedom, over them
    assert 0.66 <= value <= 1.41
    assert inside >= 8
    fx = np.array([s.fx for s in found])
    assert fx[:, 0].std(ddof=1) < 1.45 * np.sqrt((fx[:, 1] ** 2).mean())
    # no method of OpenCV is better held out by more than 2 %
    assert max(s.ahead for s in found) < 0.02
    assert np.mean([s.mean_px[0] / s.mean_px[1] for s in found]) < 1.0


@pytest.mark.parametrize(("factor", "low", "high"), [(1.0, 0.7, 1.3), (4.0, 10.0, 25.0)])
def test_poses_that_scatter_more_than_stated_are_noticed(factor: float, low: float, high: float) -> None:
    rng = np.random.default_rng(0)
    sigma = np.array([1e-3, 2e-3, 1e-3, 1e-3, 3e-3, 1e-3])
    X = np.array([moved(np.eye(4), factor * sigma * rng.normal(size=6)) for _ in range(60)])
    square, _ = scatter(X, np.tile(np.diag(sigma**2), (60, 1, 1)))
    assert low < square.sum() / (6.0 * 59) < high
    assert ((square < REGION).mean() > 0.85) == (factor == 1.0)


def test_without_the_data_the_figure_says_so(tmp_path: Path) -> None:
    run = Run(out=tmp_path)
    hand_eye_sessions(run)
    assert run.text == [f"hand-eye-sessions: left out, for --data names no folder with {SESSIONS}."]
