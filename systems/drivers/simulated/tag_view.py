"""Draws what the finger camera sees: the perspective image of the printed tag on its white plate, before the
membrane."""

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.models.arrays import Array
from weldcal.models.tool import FingerCamera, WeldingTool
from weldcal.systems.bodies.tool import SOFT, TAG_PLATE_DEPTH_M, printed_tag, tool_tag

Pixels = NDArray[np.uint8]
_SUBPIXEL_BITS = 8


class TagView:
    """The tag of a tool in a pinhole camera. All that is seen is flat, so its picture is a homography of the print.

    A renderer takes ten times as long for the same picture.
    """

    def __init__(self, tool: WeldingTool, camera: FingerCamera) -> None:
        self._X_KF = tool.X_FK.inverse()
        self._K, self._size = camera.camera_matrix, (camera.height, camera.width)
        self._print, size = printed_tag(tool_tag(tool))
        h, w = self._print.shape
        # the outer corners of the print's first and last texels, clockwise from the upper left
        self._texels = np.array([[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]], dtype=np.float32)
        square = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
        self._print_M, self._plate_M = (
            0.5 * size * square,
            0.5 * tool.tag_plate_m * square - [0.0, 0.0, TAG_PLATE_DEPTH_M],
        )

    def picture(self, X_FM: RigidTransform) -> Pixels:
        """The grey picture (H, W) of the tag whose frame M (x right, y up, z out of the print) is at X_FM in the flange
        frame."""
        X_KM = self._X_KF @ X_FM
        found = np.full(self._size, round(255 * SOFT[1]), dtype=np.uint8)
        plate = np.round(self._pixels(X_KM, self._plate_M) * 2**_SUBPIXEL_BITS).astype(np.int32)
        cv2.fillConvexPoly(found, plate, 255, cv2.LINE_AA, _SUBPIXEL_BITS)
        corners = self._pixels(X_KM, self._print_M)
        # only where the print is: to go over the whole picture takes ten times as long
        low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2, 0)
        high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 3, (found.shape[1], found.shape[0]))
        if (low >= high).any():
            return found
        H = cv2.getPerspectiveTransform(self._texels, corners.astype(np.float32))
        H = np.array([[1.0, 0.0, -low[0]], [0.0, 1.0, -low[1]], [0.0, 0.0, 1.0]]) @ H
        seen = found[low[1] : high[1], low[0] : high[0]]
        size = (seen.shape[1], seen.shape[0])
        cv2.warpPerspective(self._print, H, size, seen, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
        return found

    def _pixels(self, X_KM: RigidTransform, corners_M: Array) -> Array:
        """Pixels (4, 2) of corners (4, 3) m in M; the centre of the first pixel is (0, 0)."""
        p = corners_M @ X_KM.rotation().matrix().T + X_KM.translation()
        return np.asarray((p @ self._K.T)[:, :2] / p[:, 2:])
