"""Depth of the landmarks from a plane fitted to the tablet's pixels of a depth image."""

import cv2
import numpy as np

from weldcal.calibration.errors import LandmarksNotFound
from weldcal.calibration.geometry.robust import TUKEY
from weldcal.models.arrays import Array

_LEAST_PIXELS = 50


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
        w = np.clip(1.0 - (r / (TUKEY * scale)) ** 2, 0.0, None)
        better = np.linalg.lstsq(w[:, None] * A, w * inverse, rcond=None)[0]
        settled = bool(np.abs(better - plane).max() < 1e-12)
        plane = better
        if settled:
            break
    rays = (uv_px - centre_px) / focal_px
    return np.asarray(1.0 / (np.c_[rays, np.ones(len(rays))] @ plane))
