"""Studies of simulated flanges: found wherever one shows, and stated regions hold the truth."""

from __future__ import annotations

import pytest
from scipy.stats import binom

from tests.figures.flange.coverage import study_coverage
from tests.figures.flange.scans import FLANGE, HALF_MPX, counted, fit_one
from tests.worlds.flange_frames import WAYS
from tests.worlds.light_runs import study_light_runs
from weldcal.models.errors import InputError
from weldcal.systems.scenario.loading import load_scenario


def test_found_in_every_frame_that_shows_it_and_in_none_that_does_not() -> None:
    study = counted("whole", [fit_one(HALF_MPX, FLANGE, (3, k), "whole") for k in range(12)])
    assert (study["found"], study["mistaken"]) == (12, 0)
    # 0.07 mm rms over 500 frames; of 12, chi-square with 24 degrees of freedom allows 1.4 times that at 99.9 %
    assert study["rms_mm"] < 0.1
    assert counted("empty", [fit_one(HALF_MPX, FLANGE, (3, 1, k), "empty") for k in range(8)])["imagined"] == 0


@pytest.mark.parametrize("way", WAYS)
def test_a_flange_half_hidden_is_found_whatever_hides_it(way: str) -> None:
    found = [fit_one(HALF_MPX, FLANGE, (2, k), way) for k in range(4)]
    assert [f["reason"] for f in found] == [None] * 4
    assert all(f["coverage"] < 0.6 for f in found)
    # 0.13 mm rms over 30 frames each; of 4, chi-square with 8 degrees of freedom allows 1.8 times that at 99.9 %
    assert counted(way, found)["rms_mm"] < 0.24


@pytest.mark.parametrize("name", ["iso9409-1-80-6-m8", "wrist-ring-90"])
def test_half_of_a_larger_one_is_found_as_well(name: str) -> None:
    assert [fit_one(HALF_MPX, name, (4, k), "plate")["reason"] for k in range(2)] == [None] * 2


def test_the_stated_region_of_a_calibration_holds_the_truth_as_often_as_it_says() -> None:
    study = study_coverage(8, 60, seed=1)
    low, high = study.chance()
    assert low <= study.pose <= high
    assert low <= study.point <= high
    # leave-one-out at the poses against fresh places in the same field, each mean of 60 runs to a few per cent
    assert 0.85 < study.held_out_over_true < 1.15


@pytest.mark.parametrize("name", ["tablet", "eye_in_hand"])
def test_a_scenario_without_a_scanner_in_the_base_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="needs a simulated arm and a scanner that is fixed in the base"):
        study_light_runs(load_scenario(name), 10)


def test_in_the_imperfect_cell_the_stated_region_holds_the_error() -> None:
    """The world's warp and the arm's errors are drawn from models that the estimator does not contain."""
    runs = 16
    found = study_light_runs(load_scenario("s_groove"), runs, seed=3)
    # with a chance of one in a thousand a study of exact regions finds fewer inside
    assert found.inside.sum() >= binom.ppf(1e-3, runs, 0.95)
    assert found.error_m.mean() < 0.15e-3
    assert found.rigid_m.mean() > 1e-3
    assert (found.expected_m <= 0.15e-3 + 1e-9).all() or found.scans.max() == 12
