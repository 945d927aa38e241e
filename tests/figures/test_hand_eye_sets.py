"""Other people's hand-eye data: held-out errors beside OpenCV's best, the outlier flagged, the open axis named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from tests.figures.hand_eye.comparison import HandEyeBenchmark, dataset_row, lowest_ratio, run_hand_eye_benchmark
from tests.places import SHARED_DATA, require_data
from weldcal.calibration.hand_eye.opencv_methods import METHODS, opencv_held_out
from weldcal.calibration.hand_eye.pairs.files import read_pairs
from weldcal.models.errors import InputError

DATA = SHARED_DATA / "handeye"


# held-out degrees and millimetres of the best of OpenCV's seven methods per column, as published beside the data
BARS = {
    "ethz_asl_robot_arm_real": (0.6211, 3.625),
    "ethz_asl_robot_arm_sim": (0.2347, 1.218),
    "handeye_4dof": (0.9789, 6.460),
    "handeye_calib_camodocal": (4.1669, 57.304),
    "moveit_calibration": (0.0933, 4.747),
    "multi_camera_workcell_camera1": (0.1339, 1.006),
    "multi_camera_workcell_camera2": (0.1480, 1.721),
    "ros_industrial_charuco_static_camera": (1.4332, 12.365),
    "ros_industrial_circle_grid_camera_on_wrist": (2.9820, 20.914),
    "RWHE_Calib_kuka_1": (0.0580, 1.894),
    "visp_franka_eye_in_hand": (0.6432, 5.623),
}
MARGIN = 1.02
# Two small sets (15 and 8 poses) miss the margin by what docs/hand_eye.md states; a third one, or more on these, is a
# fault.
BEHIND = {"ros_industrial_circle_grid_camera_on_wrist": 1.029, "visp_franka_eye_in_hand": 1.033}


@pytest.fixture(scope="module")
def report() -> HandEyeBenchmark:
    require_data(DATA)
    return run_hand_eye_benchmark(DATA, quick=True)


def test_an_opencv_method_is_ahead_on_two_small_sets_only(report: HandEyeBenchmark) -> None:
    rows = {r.name: r for r in report.rows}
    ratios = {name: max(rows[name].deg / deg, rows[name].mm / mm) for name, (deg, mm) in BARS.items()}
    behind = {name: ratio for name, ratio in ratios.items() if ratio > MARGIN}
    assert set(behind) == set(BEHIND), ratios
    for name, ratio in behind.items():
        assert ratio <= BEHIND[name], f"{name}: {ratio}"


@pytest.mark.parametrize("name", sorted(BEHIND))
def test_no_method_is_ahead_beyond_chance(name: str) -> None:
    path = DATA / name
    require_data(path)
    pairs = read_pairs(path)
    row = dataset_row(name, pairs.F, pairs.G, None)
    assert row.holds
    assert min(row.low_deg, row.low_mm) < 1.0
    # errors that are a tenth larger in every pose are no chance
    assert lowest_ratio(1.1 * np.arange(1.0, 9.0), np.arange(1.0, 9.0)) == pytest.approx(1.1)


def test_opencv_reaches_the_published_bar_on_the_same_folds() -> None:
    path = DATA / "ros_industrial_charuco_static_camera"
    require_data(path)
    pairs = read_pairs(path)
    held = {m: opencv_held_out(m, pairs.F, pairs.G) for m in METHODS}
    deg, mm = min(h.rms_deg for h in held.values()), min(1e3 * h.rms_translation for h in held.values())
    # the bars are printed to four and three decimals
    np.testing.assert_allclose((deg, mm), BARS[path.name], atol=6e-4)


def test_the_outlier_and_the_open_axis_are_named(report: HandEyeBenchmark) -> None:
    rows = {r.name: r for r in report.rows}
    assert rows["handeye_calib_camodocal"].flagged == (36,)
    assert all(not r.flagged for name, r in rows.items() if name != "handeye_calib_camodocal")
    (open_axis,) = rows["handeye_4dof"].unobservable
    assert open_axis.startswith("translation along the common rotation axis (+0.00, +0.00, +1.00)")


def test_the_quick_checks_hold(report: HandEyeBenchmark) -> None:
    for name, (ok, seen) in report.checks.items():
        assert ok, f"{name}: {seen}"


def test_corners_find_the_principal_point_that_hides_the_truth(report: HandEyeBenchmark) -> None:
    rows = {r.name: r for r in report.rows}
    three_sigma = float(chi2.ppf(0.9973, 6))
    for name in ("multi_camera_workcell_camera1", "multi_camera_workcell_camera2"):
        row = rows[name]
        assert row.truth_nees is not None
        assert row.truth_nees_corners is not None
        assert row.truth_nees > three_sigma > row.truth_nees_corners
        assert "principal point shifted" in row.corners


def test_a_folder_without_sets_is_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no sets"):
        run_hand_eye_benchmark(tmp_path)
