"""Prints a pose in every usual form, and the error of a scanned point at the work point."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.results import export_ur_pose
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance
from weldcal.calibration.geometry.quantiles import chi2_quantile
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.models.arrays import Array


def pose_rows(pose: object, symbol: str = "X_BC") -> dict[str, str]:
    """Rows for the terminal, by name, of X_BC or X_FC: a RigidTransform, or its matrix (4, 4) as nested lists."""
    if isinstance(pose, RigidTransform):
        X = pose
    else:
        M = np.asarray(pose, dtype=float)
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(M[:3, :3]), M[:3, 3])
    q = X.rotation().ToQuaternion()
    rows = [" ".join(f"{v:+.6f}" for v in row) for row in X.GetAsMatrix4()]
    return {
        symbol: "pose of the scanner in the robot's base"
        if symbol == "X_BC"
        else "pose of the scanner in the robot's flange",
        "position": "  ".join(f"{1e3 * v:+.3f}" for v in X.translation()) + "  mm",
        "rotation vector": "  ".join(f"{v:+.6f}" for v in rotation_vector(X.rotation())) + "  rad",
        "roll pitch yaw": "  ".join(f"{v:+.4f}" for v in np.degrees(X.rotation().ToRollPitchYaw().vector())) + "  deg",
        "quaternion wxyz": "  ".join(f"{v:+.7f}" for v in (q.w(), q.x(), q.y(), q.z())),
        "UR pose": export_ur_pose(X).strip(),
        "4 x 4, m": rows[0],
        **{" " * k: row for k, row in enumerate(rows[1:], start=1)},
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


def work_point_error(estimate: CalibrationEstimate, p_BQ: Array) -> WorkPoint:
    """The error at the point (3,) m in the base, from the estimate's covariance and its held-out errors.

    The 95 % radius is that of a scaled chi-square with the mean and variance of the squared error (Satterthwaite 1946).
    """
    S = point_error_covariance(estimate, p_BQ)
    mean, square = float(np.trace(S)), float(np.trace(S @ S))
    freedom = mean**2 / square if square > 0.0 else 3.0
    radius = float(np.sqrt(chi2_quantile(0.95, freedom) * mean / freedom))
    held = estimate.held_out.position_m[estimate.inliers]
    held = 1e3 * held[np.isfinite(held)]
    x, y, z = (float(1e3 * v) for v in p_BQ)
    return WorkPoint((x, y, z), 1e3 * radius, len(held), float(np.percentile(held, 95)) if len(held) else None)


def work_rows(document: object) -> dict[str, str]:
    """The row for the terminal of a WorkPoint's JSON object; none for anything else."""
    if not isinstance(document, Mapping):
        return {}
    p = ", ".join(f"{v:.0f}" for v in document["p_B_mm"])
    held = document["held_out_95_mm"]
    n = document["unseen_poses"]
    backed = (
        "no pose could be held out"
        if held is None
        else f"backed by {n} poses, each unseen by its calibration: 95 % within {held:.3f} mm"
    )
    return {"error at the work point": f"{document['error_95_mm']:.3f} mm at 95 % (at {p} mm in the base; {backed})"}


def job_rows(summary: Mapping[str, object]) -> dict[str, str]:
    """The rows of a job that calibrated: its pose, and the error at the work point; none where it has no pose."""
    return {} if summary.get("X_BC") is None else pose_rows(summary["X_BC"]) | work_rows(summary.get("work_point"))
