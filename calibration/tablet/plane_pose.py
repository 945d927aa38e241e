"""Pose of the tablet in the camera (PnP with intrinsics), and the tablet point that a pixel shows."""

import cv2
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.errors import LandmarksNotFound
from weldcal.calibration.tablet.touches import check_layout
from weldcal.models.arrays import Array


def tablet_pose(rays: Array, landmark_m: Array) -> RigidTransform:
    """X_CT of the tablet (x right, y down the screen, z into it) from rays (n, 2) of its landmarks (n, 2) m.

    Starts are OpenCV's IPPE (a plane's two poses) and SQPnP (also where three of four landmarks lie on a line, which
    leaves no homography); each is refined by Levenberg-Marquardt, and the one with the smallest reprojection error in
    front of the camera is taken. Raises TooFewLandmarks, CollinearLandmarks, and LandmarksNotFound where no pose
    explains the rays.
    """
    check_layout(landmark_m)
    points = np.c_[landmark_m, np.zeros(len(landmark_m))]
    middle = points.mean(axis=0)
    centred, rays = points - middle, np.ascontiguousarray(rays, dtype=float)
    best: tuple[float, RigidTransform] | None = None
    for method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP):
        try:
            _, turns, shifts, _ = cv2.solvePnPGeneric(centred, rays, np.eye(3), None, flags=method)
        except cv2.error:  # rays that are all one, or NaN
            continue
        for start in zip(turns, shifts, strict=True):
            if not np.isfinite(start).all():
                continue
            turn, shift = cv2.solvePnPRefineLM(centred, rays, np.eye(3), None, *start)
            R = RotationMatrix.ProjectToRotationMatrix(cv2.Rodrigues(turn)[0])
            p_C = centred @ R.matrix().T + np.ravel(shift)
            if not (p_C[:, 2] > 0.0).all():
                continue
            error = float(np.linalg.norm(p_C[:, :2] / p_C[:, 2:] - rays))
            if best is None or error < best[0]:
                best = error, RigidTransform(R, np.ravel(shift) - R.matrix() @ middle)
        if best is not None:
            return best[1]
    raise LandmarksNotFound("No pose of the tablet explains where its landmarks were seen; check their order.")


def tablet_points(X_CT: RigidTransform, rays: Array) -> Array:
    """Points (m, 2) m of the tablet that are seen along rays (m, 2): depth by the tablet's plane, not by its pixels."""
    R, p = X_CT.rotation().matrix(), X_CT.translation()
    directions = np.c_[rays, np.ones(len(rays))]
    depth = (R[:, 2] @ p) / (directions @ R[:, 2])
    return np.asarray(((depth[:, None] * directions - p) @ R)[:, :2])
