"""Prints a pose: position in mm, rotation vector, and the form that a UR controller reads."""

from pydrake.math import RigidTransform

from weldcal.calibration.data.results import export_ur_pose
from weldcal.calibration.geometry.se3 import rotation_vector


def pose_rows(
    X: RigidTransform, name: str = "X_BC", meaning: str = "pose of the scanner in the robot's base"
) -> dict[str, str]:
    """Rows for the terminal, by name."""
    w = rotation_vector(X.rotation())
    return {
        name: meaning,
        "position": "  ".join(f"{1e3 * v:+.3f}" for v in X.translation()) + "  mm",
        "rotation vector": "  ".join(f"{v:+.6f}" for v in w) + "  rad",
        "UR pose": export_ur_pose(X).strip(),
    }
