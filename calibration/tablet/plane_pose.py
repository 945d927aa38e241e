"""Pose of the tablet in the camera, by PnP or by a depth image, and the tablet point that a pixel shows."""

import cv2
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.errors import LandmarksNotFound
from weldcal.calibration.tablet.touches import check_layout
from weldcal.models.arrays import Array

_LEAST_PIXELS = 50
_TUKEY = 4.685  # as geometry/robust.py, which needs Numba


def tablet_pose(rays: Array, landmark_m: Array) -> RigidTransform:
    """X_CT of the tablet (x right, y down the screen, z into it) from rays (n, 2) of its landmarks (n, 2) m.

    Starts are OpenCV's IPPE (a plane's two poses) and SQPnP (also where three of four landmarks lie on a line, which
    leaves no homography). Each is refined by Levenberg-Marquardt, and the one with the smallest reprojection error in
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
    raise LandmarksNotFound("No pose of the tablet fits the landmarks in the image: check their order.")


def tablet_points(X_CT: RigidTransform, rays: Array) -> Array:
    """Return points (m, 2) m of the tablet on rays (m, 2): depth by the tablet's plane, not by its pixels."""
    R, p = X_CT.rotation().matrix(), X_CT.translation()
    directions = np.c_[rays, np.ones(len(rays))]
    depth = (R[:, 2] @ p) / (directions @ R[:, 2])
    return np.asarray(((depth[:, None] * directions - p) @ R)[:, :2])


def plane_depth(depth_m: Array, uv_px: Array, focal_px: Array, centre_px: Array) -> Array:
    """Depths (n,) m of the landmarks at ``uv_px`` (n, 2) from a depth image (h, w) m, 0 or NaN where there is none.

    On a plane the inverse depth is linear in the pixel: 1 / z = a x + b y + c along rays (x, y, 1). It is fitted to
    every pixel within the landmarks' hull by reweighted least squares (Tukey), so that glare and flying pixels do not
    count. Raises LandmarksNotFound where fewer than 50 pixels there have a depth.
    """
    inside = np.zeros(depth_m.shape, dtype=np.uint8)
    cv2.fillConvexPoly(inside, cv2.convexHull(np.round(uv_px).astype(np.int32)), 1)
    v, u = np.nonzero((inside > 0) & np.isfinite(depth_m) & (depth_m > 0.0))
    if len(u) < _LEAST_PIXELS:
        raise LandmarksNotFound(
            f"Only {len(u)} pixels between the landmarks have a depth; tilt the camera a little, or use PnP, which"
            " needs none."
        )
    A = np.c_[(np.c_[u, v] - centre_px) / focal_px, np.ones(len(u))]
    inverse = 1.0 / depth_m[v, u].astype(float)
    # from the median: many wrong pixels must not tilt the first plane
    plane = np.array([0.0, 0.0, float(np.median(inverse))])
    for _ in range(15):
        r = inverse - A @ plane
        scale = max(1.4826 * float(np.median(np.abs(r))), 1e-9)
        w = np.clip(1.0 - (r / (_TUKEY * scale)) ** 2, 0.0, None)
        better = np.linalg.lstsq(w[:, None] * A, w * inverse, rcond=None)[0]
        settled = bool(np.abs(better - plane).max() < 1e-12)
        plane = better
        if settled:
            break
    rays = (uv_px - centre_px) / focal_px
    return np.asarray(1.0 / (np.c_[rays, np.ones(len(rays))] @ plane))
