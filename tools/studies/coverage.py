"""Do the regions that a calibration states hold the truth as often as they say? Simulated calibrations by the hundred."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.stats import binom, chi2

from weldcal.calibration.observation import Observation
from weldcal.calibration.rigid import exp_rotation, rotation_vector
from weldcal.calibration.solve import SolveConfig, estimate_eye_on_base, point_error_covariance
from weldcal.tools.simulation import Progress, no_progress
from weldcal.tools.studies.flange_frames import facing

Array = NDArray[np.float64]
LEVEL = 0.95


@dataclass(frozen=True)
class Coverage:
    """Of ``runs`` calibrations from ``poses`` sightings each: how often the truth lies within the stated 95 % region of
    X_BC (six dimensions) and of a point at the work point (three); held-out over true error at the flange, both means
    over the runs, with the noise of the scan that is left out in both."""

    poses: int
    runs: int
    pose: float
    point: float
    held_out_over_true: float

    def chance(self) -> tuple[float, float]:
        """Shares between which 99 % of such studies fall where the regions are exact."""
        low, high = (binom.ppf(q, self.runs, LEVEL) / self.runs for q in (0.005, 0.995))
        return float(low), float(high)


def simulated_sightings(
    n: int, rng: np.random.Generator, *, sigma_m: float = 1e-4, sigma_rad: float = 1e-3
) -> tuple[list[Observation], RigidTransform]:
    """Sightings (n) of a flange and the camera's true pose X_BC: arm and scanner are off by ``sigma_m`` and ``sigma_rad`` an
    axis, the fit by what its own covariance says (0.02 to 0.06 mm)."""
    X_BC = RigidTransform(
        RollPitchYaw(rng.uniform(np.array([2.8, -0.3, -3.1]), np.array([3.4, 0.3, 3.1]))), rng.uniform(-0.6, 1.0, 3)
    )
    out = []
    for k in range(n):
        p = np.array([rng.uniform(-0.18, 0.18), rng.uniform(-0.13, 0.13), rng.uniform(0.5, 0.9)])
        X_CR = facing(p, np.radians(rng.uniform(0.0, 30.0)), rng.uniform(0.0, 6.28), rng.uniform(0.0, 6.28))
        A = np.linalg.qr(rng.standard_normal((3, 3)))[0] * rng.uniform(2e-5, 6e-5, 3)
        covariance = A @ A.T
        normal_sigma = rng.uniform(2e-5, 2e-4)
        seen = p + A @ rng.standard_normal(3) + sigma_m * rng.standard_normal(3)
        z = X_CR.rotation().matrix()[:, 2]
        lean = float(np.hypot(sigma_rad, normal_sigma)) * rng.standard_normal(3)
        normal = exp_rotation(lean - z * float(z @ lean)).matrix() @ z
        out.append(Observation(f"p{k}", X_BC @ X_CR, seen, normal, covariance, normal_sigma))
    return out, X_BC


def study_coverage(poses: int, runs: int, seed: int = 0, progress: Progress = no_progress) -> Coverage:
    """Calibrate ``runs`` times from ``poses`` simulated sightings. Deterministic for ``seed``."""
    inside_pose, inside_point = 0, 0
    stated, true = [], []
    limits = chi2.ppf(LEVEL, 6), chi2.ppf(LEVEL, 3)
    for k in range(runs):
        if k % 20 == 0:
            progress(f"calibrations from {poses} scans", k / runs)
        rng = np.random.default_rng([seed, poses, k])
        sightings, X_BC = simulated_sightings(poses, rng)
        estimate = estimate_eye_on_base(sightings, SolveConfig(seed=seed, hypotheses=60))
        e = np.concatenate(
            [
                rotation_vector(X_BC.rotation() @ estimate.X_BC.rotation().inverse()),
                X_BC.translation() - estimate.X_BC.translation(),
            ]
        )
        inside_pose += float(e @ np.linalg.solve(estimate.covariance, e)) < limits[0]
        p_C = np.array([0.02, -0.05, 0.72])
        p_BQ = X_BC @ p_C
        d = p_BQ - estimate.X_BC @ p_C
        inside_point += float(d @ np.linalg.solve(point_error_covariance(estimate, p_BQ), d)) < limits[1]
        # the same noise as a sighting of this run has, at a place that it did not use
        other = np.random.default_rng([seed, poses, k, 2])
        place = other.uniform(np.array([-0.18, -0.13, 0.5]), np.array([0.18, 0.13, 0.9]))
        seen = place + 1e-4 * other.standard_normal(3) + 4e-5 * other.standard_normal(3)
        true.append(float(np.linalg.norm(estimate.X_BC @ seen - X_BC @ place)))
        stated += estimate.held_out.position_m.tolist()
    return Coverage(
        poses, runs, inside_pose / runs, inside_point / runs, float(np.mean(stated) / np.mean(true)) if runs else np.nan
    )
