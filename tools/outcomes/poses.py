"""Prints a pose: position in mm, rotation vector, and the form that a UR controller reads."""

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.results import export_ur_pose
from weldcal.calibration.geometry.se3 import rotation_vector


def pose_rows(pose: object, symbol: str = "X_BC") -> dict[str, str]:
    """Rows for the terminal, by name, of X_BC or X_FC: a RigidTransform, or its matrix (4, 4) as nested lists."""
    if isinstance(pose, RigidTransform):
        X = pose
    else:
        M = np.asarray(pose, dtype=float)
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(M[:3, :3]), M[:3, 3])
    return {
        symbol: "pose of the scanner in the robot's base"
        if symbol == "X_BC"
        else "pose of the scanner in the robot's flange",
        "position": "  ".join(f"{1e3 * v:+.3f}" for v in X.translation()) + "  mm",
        "rotation vector": "  ".join(f"{v:+.6f}" for v in rotation_vector(X.rotation())) + "  rad",
        "UR pose": export_ur_pose(X).strip(),
    }
