"""What bounds a flange calibration: the arm's repeatability and the scanner, and how many scans a comparison needs."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.figures.flange.live import live_scenario
from tests.figures.flange.recorded import median_sigma, study_few_scans
from tests.places import SHARED_DATA, needs
from tests.worlds.light_runs import RedrawnStation, bound_covariance, joints_of, redraw
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.flange.observation import Observation
from weldcal.models.arms.kinematics import forward_kinematics, load_arm

DATA = SHARED_DATA / "flange"
Q_HOME = np.deg2rad([180.0, -70.0, 120.0, -50.0, 90.0, 0.0])
X_CB = RigidTransform(RollPitchYaw(3.1, 0.05, -1.5), [0.0, 0.6, 0.9])
WORK = np.array([0.65, 0.0, 0.05])


def _observations(n: int, center_sigma_m: float = 1e-5) -> tuple[Observation, ...]:
    arm, rng = load_arm("ur10e"), np.random.default_rng(0)
    out = []
    for k in range(n):
        X_BF = forward_kinematics(arm, Q_HOME + rng.uniform(-0.25, 0.25, 6))
        p_C, n_C = X_CB @ X_BF.translation(), X_CB.rotation() @ X_BF.rotation().matrix()[:, 2]
        out.append(Observation(f"p{k}", X_BF, p_C, n_C, center_sigma_m**2 * np.eye(3), 1e-5))
    return tuple(out)


def _station(observations: tuple[Observation, ...], repeatability_m: float) -> RedrawnStation:
    arm = load_arm("ur10e")
    return RedrawnStation(arm, joints_of(observations, arm, Q_HOME), repeatability_m, X_CB.inverse(), WORK)


def _bound(observations: tuple[Observation, ...], repeatability_m: float) -> tuple[float, float]:
    """At the work point (m) and of the rotation (rad), rms."""
    least = np.diag(bound_covariance(observations, _station(observations, repeatability_m)))
    return float(np.sqrt(least[3:].sum())), float(np.sqrt(least[:3].sum()))


def test_the_bound_falls_with_the_number_of_scans_and_with_the_arms_repeatability() -> None:
    eight = _observations(8)
    at_work, turn = _bound(eight, 5e-5)
    # eight independent offsets of 0.05 mm: their mean is known to 0.018 mm, a point beside them a little worse
    assert 5e-5 / np.sqrt(8) < at_work < 4.0 * 5e-5 / np.sqrt(8)
    twice = tuple(o for o in eight for _ in range(2))
    # the same eight poses seen twice, each stop its own: half the variance
    assert _bound(twice, 5e-5)[0] == pytest.approx(at_work / np.sqrt(2.0), rel=1e-6)
    # the scanner's own noise is small beside the arm's here: what is left scales with the arm
    assert _bound(eight, 1e-4)[0] == pytest.approx(2.0 * at_work, rel=0.1)
    assert _bound(_observations(8, 1e-4), 5e-5)[0] > 1.3 * at_work
    assert np.degrees(turn) < 0.02


def test_calibrations_with_noise_drawn_anew_err_a_little_more_than_the_bound_and_never_less() -> None:
    eight = _observations(8, 2e-5)
    found = redraw(eight, _station(eight, 5e-5), 60, seed=1)
    at_work, turn = _bound(eight, 5e-5)
    # the rms of 60 draws of three numbers each is known to 6 %; estimated weights cost a part of the information
    assert 0.85 * at_work < np.sqrt(np.mean(found.at_work_m**2)) < 1.5 * at_work
    assert 0.85 * turn < np.sqrt(np.mean(found.rotation_rad**2)) < 1.5 * turn
    assert np.sqrt(np.mean(found.bound_rotation_rad**2)) == pytest.approx(turn, rel=0.2)
    shares = found.within(2.0 * at_work, 2.0 * turn)
    assert shares[0] > 0.5
    assert shares[1] > 0.9
    assert found.within(0.01 * at_work, turn) == (0.0, 0.0)


def test_the_live_target_is_measured_with_that_many_scans_and_that_arm() -> None:
    scenario = live_scenario(0.05, 8)
    assert scenario.robot.repeatability_mm == 0.05  # type: ignore[union-attr]
    assert scenario.calibration.minimum_scans == scenario.calibration.maximum_scans == 8
    assert scenario.scanner.preset == "phoxi_m"  # type: ignore[union-attr]


def test_the_spread_of_a_median_is_that_of_many_medians() -> None:
    rng = np.random.default_rng(1)
    medians = [float(np.median(np.abs(rng.standard_normal(18)))) for _ in range(2000)]
    stated = [median_sigma(np.abs(rng.standard_normal(18)), seed) for seed in range(40)]
    assert np.mean(stated) == pytest.approx(np.std(medians), rel=0.25)


@needs(DATA)
def test_few_scans_calibrate_to_tenths_on_the_scans_not_drawn_and_more_of_them_better() -> None:
    one, four = study_few_scans(DATA / "aubo_i5_phoxi_s", draws=6, sizes=(1, 4))
    assert (one.scans, four.scans, one.refused, four.refused) == (1, 4, 0, 0)
    assert 1e-4 < np.median(four.position_m) < np.median(one.position_m) < 6e-4
    with pytest.raises(TooFewPoses, match="8 usable scans and more, and there are 1"):
        study_few_scans(DATA / "franka_phoxi_m")
