"""The stated region of X_BC where the scanner has errors that nothing confirms, in worlds drawn here."""

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly, left_uncorrected
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
