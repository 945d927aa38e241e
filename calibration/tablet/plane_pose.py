"""Where the tablet lies before the camera (PnP with intrinsics), and which point of it a pixel shows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.tablet.errors import LandmarksNotFound
from weldcal.calibration.tablet.touches import check_layout

Array = NDArray[np.float64]


def tablet_pose(rays: Array, landmark_m: Array) -> RigidTransform:
    """X_CT of the tablet (x right, y down the screen, z into it) from rays (n, 2) of its landmarks (n, 2) m.

    The plane's two-fold start is OpenCV's IPPE, of which the pose with the smaller reprojection error is refined by its
    Levenberg-Marquardt. Raises TooFewLandmarks, CollinearLandmarks, and LandmarksNotFound where no pose explains the rays.
    """
    check_layout(landmark_m)
    points = np.c_[landmark_m, np.zeros(len(landmark_m))]
    middle = points.mean(axis=0)
    found, turns, shifts, _ = cv2.solvePnPGeneric(
        points - middle, np.ascontiguousarray(rays), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    if not found:
        raise LandmarksNotFound("No pose of the tablet explains where its landmarks were seen; check their order.")
    turn, shift = cv2.solvePnPRefineLM(points - middle, rays, np.eye(3), None, turns[0], shifts[0])
    R = RotationMatrix.ProjectToRotationMatrix(cv2.Rodrigues(turn)[0])
    X = RigidTransform(R, np.ravel(shift) - R.matrix() @ middle)
    if (X @ middle)[2] <= 0.0:
        raise LandmarksNotFound("The tablet would lie behind the camera; check the order of its landmarks.")
    return X


def tablet_points(X_CT: RigidTransform, rays: Array) -> Array:
    """Points (m, 2) m of the tablet that are seen along rays (m, 2): depth by the tablet's plane, not by its pixels."""
    R, p = X_CT.rotation().matrix(), X_CT.translation()
    directions = np.c_[rays, np.ones(len(rays))]
    depth = (R[:, 2] @ p) / (directions @ R[:, 2])
    return np.asarray(((depth[:, None] * directions - p) @ R)[:, :2])
