"""The error that a calibration states for scans it did not use: the limit for the median of some of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import TERMS, ScannerCorrection
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import skew
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

FALSE_ALARM = 0.01  # of verifications of a good calibration that exceed the limit
_DRAWS = 6_000  # the limit's own error is then 1 to 2 %
_SEED = 1
_LEAST_FREE = 3.0  # as of one pose to spare: the 95 % quantile of F(3, m) is 9 with 3 spare numbers, and 216 with one
USUAL_FIELD_M = 1.5e-4  # the usual spread of solve.py: a maker's arm and a scanner
"""Spread per axis of what an arm leaves of a calibration from place to place."""
USUAL_TURN_RAD = float(np.radians(10.0))
"""Angle over which that is alike."""


def stated_median_limit(
    result: CalibrationResult,
    observations: Sequence[Observation],
    correction: ScannerCorrection | None,
    scatter_m: Array | None = None,
    shared: tuple[Array, Array] | None = None,
) -> float | None:
    """Limit (mm) that the median error at these new observations (n) exceeds by chance in FALSE_ALARM of verifications.

    The median of n errors has no closed form where all share the calibration's own error, so it is simulated. One error
    of pose and scanner correction is drawn from their joint covariance for all scans. For each scan the spread of robot
    and scanner and the noise of its fit are drawn. The spread was estimated from few residuals, so its square is drawn
    as well (scaled inverse chi-square). ``scatter_m`` (n,) m per axis: the spread that a local field leaves at each
    scan. ``shared``: for errors of the arm, derivatives (n, 3, p) of the positions and the covariance (p, p) in place
    of the result's. The 95 % percentile of the stated held-out errors counts where it is larger. None where the result
    states no error at all. Deterministic.
    """
    stated = result.held_out_mm.get("p95")
    floor = float(stated) if stated is not None and np.isfinite(stated) else None
    if not result.sigma_position_mm > 0.0 or not observations:
        return floor
    rng = np.random.default_rng(_SEED)
    whole, correction = joint_terms(result, correction)
    J = np.array([_sensitivity(result, o, correction) for o in observations])
    if shared is not None:
        J, whole = shared
    values, vectors = np.linalg.eigh(0.5 * (whole + whole.T))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    used = sum(p.used for p in result.poses)
    free = max(3.0 * used - 6.0, _LEAST_FREE)
    own = np.array([np.zeros((3, 3)) if o.center_covariance is None else o.center_covariance for o in observations])
    R = result.X_BC.rotation().matrix()
    fits = np.linalg.cholesky(R @ own @ R.T + 1e-18 * np.eye(3))
    medians = np.empty(_DRAWS)
    for first in range(0, _DRAWS, 1000):
        k, n = slice(first, first + 1000), len(observations)
        together = (rng.standard_normal((1000, root.shape[1])) @ root.T @ J.reshape(3 * n, -1).T).reshape(1000, n, 3)
        own_sigma = 1e-3 * result.sigma_position_mm * np.ones(n) if scatter_m is None else scatter_m
        sigma = own_sigma * np.sqrt(free / rng.chisquare(free, 1000))[:, None]
        scatter = sigma[:, :, None] * rng.standard_normal((1000, n, 3))
        noise = np.swapaxes(np.swapaxes(rng.standard_normal((1000, n, 3)), 0, 1) @ np.swapaxes(fits, 1, 2), 0, 1)
        error = together + scatter + noise
        medians[k] = np.median(np.sqrt(np.vecdot(error, error)), axis=1)
    limit = 1e3 * float(np.quantile(medians, 1.0 - FALSE_ALARM))
    return limit if floor is None else max(limit, floor)


def joint_terms(
    result: CalibrationResult, correction: ScannerCorrection | None
) -> tuple[Array, ScannerCorrection | None]:
    """Return the covariance (6 + K, 6 + K) of X_BC and correction, and the correction with its K terms.

    The correction changes nothing where the scanner was not found wrong. Where the two do not fit: the covariance of
    X_BC alone, and None.
    """
    joint = result.joint_covariance
    if joint is not None and correction is None and len(joint) - 6 in TERMS.values():
        correction = ScannerCorrection.unchanged(len(joint) - 6)
    if joint is None or correction is None or len(joint) != 6 + len(correction.values):
        return result.covariance, None
    return joint, correction


def observed_document(
    observations: Sequence[Observation], X_FR: RigidTransform | None = None, joints: Sequence[Array] = ()
) -> dict[str, Any]:
    """Return the poses that a calibration used, for CalibrationResult.observed.

    They are the feature in the base, the observed centre and normal, and the joints where they are known.
    """
    X = X_FR or RigidTransform()
    return {
        "feature_xyz": [float(v) for v in X.translation()],
        "feature_wxyz": [float(v) for v in X.rotation().ToQuaternion().wxyz()],
        "xyz": [[float(v) for v in o.p_BR] for o in observations],
        "wxyz": [[float(v) for v in o.X_BR.rotation().ToQuaternion().wxyz()] for o in observations],
        "camera": [[float(v) for v in o.p_CR] for o in observations],
        "normals": [None if o.n_C is None else [float(v) for v in o.n_C] for o in observations],
        "joints": [[float(v) for v in q] for q in joints],
    }


def orientations_of(observations: Sequence[Observation], X_FR: RigidTransform | None = None) -> dict[str, Any]:
    """Summarise the feature's orientations in the base for CalibrationResult.orientations.

    They are the mean and the largest angle (deg) from it, with the feature's orientation on the flange where X_FR turns
    it.
    """
    turned = Rotation.from_matrix(np.array([o.X_BR.rotation().matrix() for o in observations]))
    mean = turned.mean()
    x, y, z, w = (float(v) for v in mean.as_quat())
    found: dict[str, Any] = {
        "wxyz": [w, x, y, z],
        "spread_deg": float(np.degrees((mean.inv() * turned).magnitude().max())),
    }
    if X_FR is not None and not X_FR.rotation().IsNearlyIdentity():
        found["feature_wxyz"] = [float(v) for v in X_FR.rotation().ToQuaternion().wxyz()]
    return found


def feature_rotation(result: CalibrationResult) -> RotationMatrix:
    """Orientation on the flange of the feature that was measured. Raises InputError where it cannot be read."""
    wxyz = (result.orientations or {}).get("feature_wxyz")
    try:
        return RotationMatrix() if wxyz is None else RotationMatrix(Quaternion(np.array(wxyz, dtype=float)))
    except (TypeError, ValueError, RuntimeError) as problem:
        raise InputError("The orientations in the result cannot be read; run 'weldcal calibrate' again.") from problem


def scatter_elsewhere(result: CalibrationResult, observations: Sequence[Observation]) -> Array | None:
    """Spread (n,) m per axis of new scans, grown where the flange is turned beyond the orientations of the calibration.

    The arm's error at one orientation says nothing about another orientation. There its usual size is added, with the
    covariance over angles that a local field has before any scan (0.15 mm per axis, 10 degrees). None where the result
    does not hold its orientations. Raises InputError where they cannot be read.
    """
    if result.orientations is None:
        return None
    try:
        w, x, y, z = (float(v) for v in result.orientations["wxyz"])
        mean, spread = Rotation.from_quat([x, y, z, w]), np.radians(float(result.orientations["spread_deg"]))
    except (KeyError, TypeError, ValueError) as problem:
        raise InputError("The orientations in the result cannot be read; run 'weldcal calibrate' again.") from problem
    turned = Rotation.from_matrix(np.array([o.X_BR.rotation().matrix() for o in observations]))
    beyond = np.maximum((mean.inv() * turned).magnitude() - spread, 0.0)
    unknown = USUAL_FIELD_M**2 * (1.0 - np.exp(-0.5 * (beyond / USUAL_TURN_RAD) ** 2))
    return np.asarray(np.sqrt((1e-3 * result.sigma_position_mm) ** 2 + unknown))


def _sensitivity(result: CalibrationResult, o: Observation, correction: ScannerCorrection | None) -> Array:
    """How the base position of an observed centre moves with pose and, where there is one, correction (3, 6 + K)."""
    p = np.asarray(result.X_BC @ o.p_CR)
    J = np.hstack([-skew(p - result.X_BC.translation()), np.eye(3)])
    if correction is None:
        return np.asarray(J)
    return np.hstack([J, np.outer(result.X_BC.rotation() @ o.p_CR, correction.terms(o.p_CR))])
