"""What a result states of the errors of its arm: written with it, and the error of new scans that follows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.dataset import Dataset, joint_angles
from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import flange_poses, log_rotation
from weldcal.calibration.refinement.kinematics_fit import ArmErrors, KinematicsFit
from weldcal.models.arms.chain import Chain, load_chain
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

_SAME_M, _SAME_RAD = (
    1e-4,
    float(np.radians(0.01)),
)  # what a controller rounds, and less than a factory calibration changes


def require_joint_angles(data: Dataset, ids: Sequence[str], arm: Chain, stated: Array) -> Array:
    """Joint angles (n, arm.n) rad that lead the arm to the stated flange poses (n, 4, 4).

    Raises DatasetError without angles, InputError where they lead elsewhere: to another arm, or to one whose controller
    has a factory calibration of its own.
    """
    q = joint_angles(data, ids, arm.n)
    if q is None:
        raise DatasetError(
            f"poses.csv or pairs.csv in '{data.folder.name}' has no joint angles: add the columns q1 to q{arm.n}"
            " (radians), or omit --refine."
        )
    reached = flange_poses(arm, q, np.zeros((arm.n, 6)))
    off_m = float(np.linalg.norm(stated[:, :3, 3] - reached[:, :3, 3], axis=1).max())
    turn = log_rotation(np.swapaxes(reached[:, :3, :3], 1, 2) @ stated[:, :3, :3])
    if off_m > _SAME_M or float(np.linalg.norm(turn, axis=1).max()) > _SAME_RAD:
        raise InputError(
            f"The joint angles lead this {arm.name} up to {1e3 * off_m:.2f} mm from the stated poses. A real controller"
            " computes with the factory calibration of its arm: give that file (--kinematics). Else check the robot's"
            " name, radians, and that the TCP is zero."
        )
    return q


def arm_document(fit: KinematicsFit) -> dict[str, Any]:
    """The errors as plain types for calibration.yaml (rad, m), with the covariance of X_BC, scanner factors and errors
    / prior."""
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
    """Derivatives (n, 3, p) of positions of new scans by what the result estimated, and its covariance (p, p); None
    where it states none.

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
