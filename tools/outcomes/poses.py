"""Prints a pose in every usual form, and the error of a scanned point at the work point."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.results import export_ur_pose
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance
from weldcal.calibration.geometry.robust import chi2_quantile
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.models.arrays import Array

SCANNER = {
    "X_BC": "pose of the scanner C in the robot's base B",
    "X_FC": "pose of the scanner C in the robot's flange F",
}
"""The scanner's pose in words, by its symbol."""


def pose_rows(pose: object, symbol: str = "X_BC", words: str = "") -> dict[str, str]:
    """Rows for the terminal, by name: a RigidTransform, or its matrix (4, 4) as nested lists; ``words``: its frames."""
    if isinstance(pose, RigidTransform):
        X = pose
    else:
        M = np.asarray(pose, dtype=float)
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(M[:3, :3]), M[:3, 3])
    q = X.rotation().ToQuaternion()
    rows = [" ".join(f"{v:+.6f}" for v in row) for row in X.GetAsMatrix4()]
    return {
        symbol: words or SCANNER.get(symbol, "pose of the scanner in the robot's flange"),
        "position": "  ".join(f"{1e3 * v:+.3f}" for v in X.translation()) + "  mm",
        "rotation vector": "  ".join(f"{v:+.6f}" for v in rotation_vector(X.rotation())) + "  rad",
        "roll pitch yaw": "  ".join(f"{v:+.4f}" for v in np.degrees(X.rotation().ToRollPitchYaw().vector())) + "  deg",
        "quaternion wxyz": "  ".join(f"{v:+.7f}" for v in (q.w(), q.x(), q.y(), q.z())),
        "UR pose": export_ur_pose(X).strip(),
        "4 x 4, m": "\n".join(rows),
    }


@dataclass(frozen=True)
class WorkPoint:
    """The expected error of a scanned point at ``p_B_mm`` in the base: with 95 % probability at most ``error_95_mm``, if the errors are as
    stated; ``unseen_poses`` with a held-out error back it, 95 % of which were within ``held_out_95_mm`` (None: too few)."""

    p_B_mm: tuple[float, float, float]
    error_95_mm: float
    unseen_poses: int
    held_out_95_mm: float | None

    def document(self) -> dict[str, object]:
        """The JSON object."""
        return {
            "p_B_mm": list(self.p_B_mm),
            "error_95_mm": self.error_95_mm,
            "unseen_poses": self.unseen_poses,
            "held_out_95_mm": self.held_out_95_mm,
        }


def radius_95(S: Array) -> float:
    """Distance that an error of covariance ``S`` (3, 3) does not exceed with 95 %, in the square root of its unit.

    It is that of a scaled chi-square with the mean and variance of the squared error (Satterthwaite 1946).
    """
    mean, square = float(np.trace(S)), float(np.trace(S @ S))
    freedom = mean**2 / square if square > 0.0 else 3.0
    return float(np.sqrt(chi2_quantile(0.95, freedom) * mean / freedom))


def work_point_error(estimate: CalibrationEstimate, p_BQ: Array) -> WorkPoint:
    """The error at the point (3,) m in the base, from the estimate's covariance and its held-out errors."""
    radius = radius_95(point_error_covariance(estimate, p_BQ))
    held = estimate.held_out.position_m[estimate.inliers]
    held = 1e3 * held[np.isfinite(held)]
    x, y, z = (float(1e3 * v) for v in p_BQ)
    return WorkPoint((x, y, z), 1e3 * radius, len(held), float(np.percentile(held, 95)) if len(held) else None)
