"""The flange is found wherever it is seen, never where it is not, whole or in part, in every size; regions hold the
truth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from tests.calibration.flange.face import face_points
from tests.worlds.flange_frames import facing, flange_frame, hidden_frame
from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import FlangeGuess, fit_flange
from weldcal.models.flanges import STANDARDS, get_flange
from weldcal.models.scanners import get_scanner

Array = NDArray[np.float64]
ISO_50 = "iso9409-1-50-4-m6"
HALF_MPX = get_scanner("phoxi_m", 824)


def _segmented(name: str, seed: int = 0, spacing_m: float = 0.0004) -> tuple[Array, RigidTransform]:
    """The flat face of a flange alone, as points in no order, with 0.05 mm of noise."""
    X_CR = facing(np.array([0.05, -0.03, 0.5]), 0.2, 1.0, 0.4)
    rng = np.random.default_rng(seed)
    p = face_points(get_flange(name), spacing_m)
    p = p + rng.uniform(-0.5, 0.5, p.shape) * [spacing_m, spacing_m, 0.0] + 5e-5 * rng.standard_normal(p.shape)
    return rng.permutation((X_CR @ p.T).T), X_CR


@pytest.mark.parametrize("name", sorted(STANDARDS))
def test_every_size_of_the_table_is_found_among_clutter(name: str) -> None:
    standard = get_flange(name)
    X_CR = facing(np.array([0.02, -0.01, 0.7]), 0.25, 2.0, 0.5)
    frame = flange_frame(HALF_MPX, standard, np.random.default_rng(1), X_CR=X_CR, clutter=3)
    found = fit_flange(frame.points_C, standard)
    # a third of a pixel's 0.78 mm
    assert np.linalg.norm(found.center_C - X_CR.translation()) < 2.5e-4


@pytest.mark.parametrize("name", [ISO_50, "iso9409-1-31.5-4-m5", "tool-ring-63", "wrist-ring-90"])
def test_a_segmented_cloud_gives_the_centre_whatever_the_order_of_its_points(name: str) -> None:
    points, X_CR = _segmented(name)
    a = fit_flange(points, get_flange(name))
    b = fit_flange(points[::-1], get_flange(name))
    # edge points lie up to one spacing inside the edge, in some 60 sectors: 0.4 mm / sqrt(12) / sqrt(30)
    assert np.linalg.norm(a.center_C - X_CR.translation()) < 6e-5
    assert np.linalg.norm(a.center_C - b.center_C) < 3e-5
    assert (fit_flange(points, get_flange(name)).center_C == a.center_C).all()


def test_halves_of_a_cloud_agree_within_their_stated_noise() -> None:
    points, _ = _segmented(ISO_50, spacing_m=0.00035)
    half = len(points) // 2
    a, b = (fit_flange(p, get_flange(ISO_50)) for p in (points[:half], points[half:]))
    spread = np.sqrt(np.trace(a.center_covariance) + np.trace(b.center_covariance))
    # the spread holds the pull of a chamfer, too, 0.03 mm an axis, which has no part in the difference
    assert np.linalg.norm(a.center_C - b.center_C) < 3.0 * spread < 2.5e-4


def test_a_flange_of_which_a_third_is_missing_is_still_found() -> None:
    points, X_CR = _segmented(ISO_50)
    in_R = (X_CR.inverse() @ points.T).T
    found = fit_flange(points[in_R[:, 0] > -0.012], get_flange(ISO_50))
    assert np.linalg.norm(found.center_C - X_CR.translation()) < 1e-4
    assert found.coverage < 0.75


def test_the_wide_end_of_a_ball_is_no_small_flange() -> None:
    # its cap, cut by a plane, is a ring of the right size; scanned coarsely at a metre its bend hides in the noise
    small = get_flange("iso9409-1-31.5-4-m5")
    for k in (0, 4, 8):
        frame = hidden_frame("plate", HALF_MPX, small, np.random.default_rng([0, k]), share=0.9)
        with pytest.raises(FlangeNotFound):
            fit_flange(frame.points_C, small)


def test_a_tracked_flange_is_where_the_whole_frame_shows_it() -> None:
    standard = get_flange(ISO_50)
    frame = flange_frame(HALF_MPX, standard, np.random.default_rng(4))
    whole = fit_flange(frame.points_C, standard)
    last = FlangeGuess(whole.center_C + np.array([0.001, -0.001, 0.002]), 0.05, whole.normal_C)
    tracked = fit_flange(frame.points_C, standard, guess=last)
    assert np.linalg.norm(tracked.center_C - whole.center_C) < 2e-5 + np.sqrt(np.trace(whole.center_covariance))


def test_a_tube_of_the_flanges_size_is_refused_for_what_it_lacks() -> None:
    points, X_CR = _segmented("tool-ring-63")
    in_R = (X_CR.inverse() @ points.T).T
    tube = points[np.hypot(in_R[:, 0], in_R[:, 1]) > 0.026]
    with pytest.raises(FlangeNotFound):
        fit_flange(tube, get_flange(ISO_50))
