"""The stated region of X_BC where the scanner has errors that nothing confirms, in worlds drawn here."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from weldcal.calibration.eye_on_base.estimate import point_error_covariance
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly, left_uncorrected
from weldcal.calibration.eye_on_base.solve import SolveConfig
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation

WORLDS, POSES, NOISE_M, NORMAL_RAD = 40, 12, 5e-5, 5e-4
SCALE, GRADIENT_PER_M = 1e-3, 5e-3  # standard deviations of the scanner's own errors


def world(seed: int) -> tuple[RigidTransform, list[Observation]]:
    """True X_BC, and what a scanner with a wrong scale and gradient shows of a flange in many orientations."""
    rng = np.random.default_rng(seed)
    down = Rotation.from_rotvec([np.pi, 0.0, 0.0]) * Rotation.from_rotvec(rng.normal(0.0, 0.2, 3))
    X_BC = RigidTransform(RotationMatrix(down.as_matrix()), [0.65, 0.0, 0.95])
    scale, gradient = 1.0 + rng.normal(0.0, SCALE), rng.normal(0.0, GRADIENT_PER_M, 2)
    observations = []
    for k in range(POSES):
        p = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), rng.uniform(0.55, 0.9)])
        towards = Rotation.from_rotvec([np.pi, 0.0, 0.0]) * Rotation.from_rotvec([*rng.uniform(-0.4, 0.4, 2), 0.0])
        R = towards * Rotation.from_euler("z", rng.uniform(-3.0, 3.0))
        shown = p * (scale + gradient @ p[:2]) + rng.normal(0.0, NOISE_M, 3)
        n = R.as_matrix()[:, 2] + rng.normal(0.0, NORMAL_RAD, 3)
        X_CR = RigidTransform(RotationMatrix(R.as_matrix()), p)
        covariance = NOISE_M**2 * np.eye(3)
        observations.append(Observation(f"p{k}", X_BC @ X_CR, shown, n / np.linalg.norm(n), covariance, NORMAL_RAD))
    return X_BC, observations


def test_the_region_holds_the_truth_although_the_scanner_stays_uncorrected() -> None:
    squares: dict[str, list[float]] = {"rigid": [], "left": []}
    for seed in range(WORLDS):
        X_BC, observations = world(seed)
        rigid, _ = estimate_jointly(observations, correct_scanner=False)
        left = left_uncorrected(rigid, estimate_jointly(observations)[0])
        assert left.X_BC is rigid.X_BC
        assert left.correction is None
        turn = Rotation.from_matrix((X_BC.rotation() @ rigid.X_BC.rotation().inverse()).matrix()).as_rotvec()
        error = np.concatenate([turn, X_BC.translation() - rigid.X_BC.translation()])
        for name, estimate in (("rigid", rigid), ("left", left)):
            squares[name].append(float(error @ np.linalg.solve(estimate.covariance, error)))
    limit = float(chi2.ppf(0.95, 6))
    inside = {name: np.mean(np.array(found) < limit) for name, found in squares.items()}
    assert inside["rigid"] < 0.5, "the scanner's errors are too small for this test"
    assert inside["left"] >= 0.85
    assert np.mean(16.0 * np.array(squares["left"]) < limit) < 0.3, "a region four times too narrow passes"
    assert np.median(squares["left"]) > 1.0, "the region is four times too wide"


def scaled(seed: int, holes: bool) -> tuple[RigidTransform, float, list[Observation], dict[str, HolePattern]]:
    """8 to 20 scans by a scanner whose scale is off by up to 0.3 %, of an arm that is off by 0.03 to 0.2 mm an axis."""
    rng = np.random.default_rng([seed, 5])
    X_BC = RigidTransform(RotationMatrix(Rotation.from_euler("xyz", [2.6, 0.1, 0.4]).as_matrix()), [0.4, -0.7, 0.9])
    n, scale = int(rng.integers(8, 21)), 1.0 + rng.uniform(-3e-3, 3e-3)
    noise, arm = rng.uniform(2e-5, 1.3e-4), rng.uniform(3e-5, 2e-4)
    observations, patterns = [], {}
    for k in range(n):
        p = np.array([*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.55, 0.85)])
        w = rng.normal(size=3)
        w *= np.radians(25.0) * np.sqrt(rng.uniform()) / np.linalg.norm(w)
        R = Rotation.from_rotvec(w) * Rotation.from_euler("zx", [rng.uniform(-1.0, 1.0), np.pi])
        X = X_BC @ RigidTransform(RotationMatrix(R.as_matrix()), p)
        turned = X.rotation() @ RotationMatrix(Rotation.from_rotvec(3e-4 * rng.normal(size=3)).as_matrix())
        stated = RigidTransform(turned, X.translation() + arm * rng.normal(size=3))
        shown = p / scale + noise * rng.normal(size=3)
        n_C = R.as_matrix()[:, 2] + 1e-3 * rng.normal(size=3)
        one = Observation(f"{k}", stated, shown, n_C / np.linalg.norm(n_C), noise**2 * np.eye(3))
        observations.append(one)
        if holes and rng.uniform() < 0.8:
            at = RigidTransform(RotationMatrix(R.as_matrix()), shown)
            ratio = 1.0 / scale + 1e-3 * rng.normal()
            patterns[one.id] = HolePattern(holes_C=np.zeros((4, 3)), center_C=shown, X_CR=at, ratio=ratio, rms_m=0.0)
    return X_BC, scale, observations, patterns


@pytest.mark.parametrize("holes", [True, False])
def test_the_region_is_right_with_and_without_a_correction(holes: bool) -> None:
    """50 scanners, of X_BC and of 20 points that no scan saw; where no correction is chosen as well as where one is."""
    squares, points, chosen = [], [], []
    for seed in range(50):
        X_BC, scale, observations, patterns = scaled(seed, holes)
        e, verdict = estimate_jointly(observations, patterns, config=SolveConfig(allow_coplanar=True))
        if not holes:
            e = left_uncorrected(estimate_jointly(observations, correct_scanner=False)[0], e)
        chosen.append(holes and verdict is not None and verdict.accepted is not None)
        turn = Rotation.from_matrix((X_BC.rotation() @ e.X_BC.rotation().inverse()).matrix()).as_rotvec()
        d = np.concatenate([turn, X_BC.translation() - e.X_BC.translation()])
        squares.append(float(d @ np.linalg.solve(e.covariance, d)))
        rng = np.random.default_rng([seed, 6])
        for p in np.column_stack([rng.uniform(-0.12, 0.12, (20, 2)), rng.uniform(0.58, 0.82, 20)]):
            seen = p / scale if e.scanner is None else e.scanner.points(p / scale)
            off = e.X_BC @ seen - X_BC @ p
            points.append(float(off @ np.linalg.solve(point_error_covariance(e, X_BC @ p), off)))
    of_X, of_points, taken = np.array(squares), np.array(points), np.array(chosen)
    groups = [taken, ~taken] if holes else [~taken]
    for group in groups:
        assert np.mean(of_X[group] < chi2.ppf(0.95, 6)) > 0.86
        assert np.mean(16.0 * of_X[group] < chi2.ppf(0.95, 6)) < 0.3, "a region four times too narrow passes"
        assert np.median(of_X[group]) > 1.2, "the region is four times too wide"
    assert np.mean(of_points < chi2.ppf(0.95, 3)) > 0.9
    assert np.median(of_points) > 0.5, "the region of points is four times too wide"
