"""The estimate of X_BC with its covariance, residuals and held-out errors, and the error of a scanned point."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import chi2_quantile, f_quantile
from weldcal.calibration.geometry.se3 import skew
from weldcal.models.arrays import Array

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class HeldOut:
    """Errors of each pose under a calibration that never saw it: position at the flange centre (n,) m, tilt (n,) rad.

    ``tilt_rad`` is NaN where no normal was seen. Poses refused as outliers keep their (large) error.
    """

    position_m: Array
    tilt_rad: Array


@dataclass(frozen=True, kw_only=True)
class CalibrationEstimate:
    """Pose of the camera in the base with its covariance, residuals and held-out errors.

    ``covariance`` (6, 6), order [rotation; translation], is of X_BC = (exp(dtheta) R, p + dp). dtheta (rad) is a
    rotation on the base side about the camera origin. dp (m) is the displacement of the camera origin. Both are in B.
    ``position_residuals_m`` (n,) and ``tilt_residuals_rad`` (n,; NaN without a normal) are in the order of the
    observations. The covariance is enlarged so that its Gaussian 95 % region is right for few poses, too. Where the
    scanner's errors were estimated, it contains their uncertainty. ``joint`` (6 + K, 6 + K) is then the covariance of
    X_BC and the K factors of ``scanner`` together. A ``scanner`` that changes nothing was not found wrong.
    ``sigma_position_m`` and ``sigma_normal_rad`` (per axis) are the spread of robot and scanner together beyond the
    noise of the fits, estimated from the residuals.
    """

    X_BC: RigidTransform
    covariance: Array
    inliers: Flags
    position_residuals_m: Array
    tilt_residuals_rad: Array
    held_out: HeldOut
    sigma_position_m: float
    sigma_normal_rad: float
    unobservable: tuple[str, ...]
    warnings: tuple[str, ...]
    scanner: ScannerCorrection | None = None
    joint: Array | None = None

    @property
    def correction(self) -> ScannerCorrection | None:
        """The correction to apply to scans; None where the scanner is taken as it is."""
        return self.scanner if self.scanner is not None and self.scanner.changes else None


def point_error_covariance(estimate: CalibrationEstimate, p_BQ: Array) -> Array:
    """Return the covariance (..., 3, 3) m^2, in B, of the base positions of scanned points at ``p_BQ`` (..., 3) m.

    With a scanner correction, X_BC and correction err together: where both were seen, much of either cancels.
    """
    p = np.asarray(p_BQ, dtype=float)
    R, along = estimate.X_BC.rotation().matrix(), p - estimate.X_BC.translation()
    J = np.concatenate([-skew(along), np.broadcast_to(np.eye(3), (*p.shape, 3))], axis=-1)
    if estimate.joint is None or estimate.scanner is None:
        return np.asarray(J @ estimate.covariance @ np.swapaxes(J, -1, -2))
    J = np.concatenate([J, along[..., :, None] * estimate.scanner.terms(along @ R)[..., None, :]], axis=-1)
    return np.asarray(J @ estimate.joint @ np.swapaxes(J, -1, -2))


def sigma_at(estimate: CalibrationEstimate, p_BQ: Array) -> float:
    """Return the standard deviation (3-D, m) of a scanned point at ``p_BQ`` (3,) m."""
    return float(np.sqrt(np.trace(point_error_covariance(estimate, p_BQ))))


def with_scanner(
    estimate: CalibrationEstimate,
    scanner: ScannerCorrection,
    X_BC: RigidTransform,
    joint: Array | None,
    redundancy: float,
) -> CalibrationEstimate:
    """Return the estimate with a corrected scanner and the camera's pose that goes with it.

    Their ``joint`` covariance is widened for spreads that were estimated with that ``redundancy``.
    """
    joint = np.zeros((9, 9)) if joint is None else joint * few_residuals(redundancy)
    return replace(estimate, X_BC=X_BC, scanner=scanner, joint=joint, covariance=joint[:6, :6])


def few_residuals(redundancy: float) -> float:
    """Factor by which a 95 % region widens because its scale was estimated with that redundancy (F to chi-square)."""
    return 6.0 * f_quantile(0.95, 6, redundancy) / chi2_quantile(0.95, 6)


def corrected_observation(correction: ScannerCorrection, o: Observation) -> Observation:
    """Return an observation with the scanner's correction applied to its centre p_CR (m) and its normal n_C."""
    return replace(
        o, p_CR=correction.points(o.p_CR), n_C=None if o.n_C is None else correction.normals(np.asarray(o.p_CR), o.n_C)
    )
