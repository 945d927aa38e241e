"""What a result states of the errors of its arm: written with it, and the error of new scans that follows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.refinement.kinematics_fit import ArmErrors, KinematicsFit
from weldcal.models.arms.chain import load_chain
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError


def arm_document(fit: KinematicsFit) -> dict[str, Any]:
    """The errors as plain types for calibration.yaml (rad, m), with the covariance of X_BC, scanner factors and errors / prior."""
    found = fit.errors
    return {
        "names": list(found.names),
        "which": [int(i) for i in found.which],
        "prior": [float(v) for v in found.scale],
        "values": [float(v) for v in fit.values],
        "sigma": [float(v) for v in fit.sigma],
        "covariance": [[float(v) for v in row] for row in fit.covariance],
    }


def shared_error(
    result: CalibrationResult,
    kinematics: Path,
    correction: ScannerCorrection | None,
    observations: Sequence[Observation],
    q: Array,
) -> tuple[Array, Array] | None:
    """Derivatives (n, 3, p) of positions of new scans by what the result estimated, and its covariance (p, p); None where it states none.

    ``observations`` (n) as seen, with the poses that the arm of ``kinematics`` reaches at q (n, joints).

    Raises:
        InputError: what the result states of its arm cannot be read.
    """
    if result.arm_errors is None:
        return None
    correction = correction or ScannerCorrection()
    try:
        which = np.array(result.arm_errors["which"], dtype=int)
        scale = np.array(result.arm_errors["prior"], dtype=float)
        covariance = np.array(result.arm_errors["covariance"], dtype=float)
        size = 6 + len(correction.values) + len(which)
        if covariance.shape != (size, size) or scale.shape != which.shape or not np.isfinite(covariance).all():
            raise ValueError("sizes differ")
        arm = load_chain(result.robot, kinematics)
        if which.min() < 0 or which.max() >= 6 * arm.n:
            raise ValueError("no joint of this arm")
    except (KeyError, TypeError, ValueError) as problem:
        raise InputError(
            "The arm's errors (arm_errors) in the result cannot be read; run 'weldcal calibrate --refine' again."
        ) from problem
    errors = ArmErrors(arm, which, scale, tuple(str(i) for i in which))
    fit = KinematicsFit(
        X_BC=result.X_BC,
        correction=correction,
        u=np.zeros(len(which)),
        covariance=covariance,
        sigma_position_m=1.0,
        sigma_normal_rad=1.0,
        redundancy=1.0,
        errors=errors,
    )
    return fit.sensitivity(observations, q)[:, :3], covariance
