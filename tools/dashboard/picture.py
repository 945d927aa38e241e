"""Draw the newest scan as a small depth picture with its flange, or the wrist camera's newest picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array
from weldcal.systems.jobs.tablet.config import WristPicture
from weldcal.systems.messages import FlangeEstimate, Scan
from weldcal.systems.viewer.live import Moment

WIDTH_PX = 300
_FOUND, _NOTHING = (90, 25, 217), (40, 34, 30)  # BGR
_RING_POINTS = 48


def picture_number(moment: Moment) -> int:
    """The number of the newest picture; 0 where there is none. A page asks for a picture when its number is new."""
    seen, estimate = moment.shown.get("scan"), moment.shown.get("flange_estimate")
    if isinstance(seen, Scan) and seen.points_C.size:
        fitted = isinstance(estimate, FlangeEstimate) and estimate.sequence == seen.sequence
        return 2 * seen.sequence + fitted
    picture = moment.shown.get("picture")
    return picture.sequence if isinstance(picture, WristPicture) else 0


def picture_png(moment: Moment) -> bytes | None:
    """Return the newest picture as a PNG of WIDTH_PX; None where there is none."""
    scan, picture = moment.shown.get("scan"), moment.shown.get("picture")
    if isinstance(scan, Scan) and scan.points_C.size:
        estimate = moment.shown.get("flange_estimate")
        shown = depth_picture(scan, estimate if isinstance(estimate, FlangeEstimate) else None)
    elif isinstance(picture, WristPicture) and picture.sequence:
        shown = _small(picture.grey)
    else:
        return None
    return bytes(cv2.imencode(".png", shown)[1].tobytes())


def depth_picture(scan: Scan, estimate: FlangeEstimate | None) -> NDArray[np.uint8]:
    """Return a depth picture (h, WIDTH_PX, 3) BGR, near bright; around a flange that was found in this scan a ring."""
    step = max(1, scan.points_C.shape[1] // WIDTH_PX)
    points = scan.points_C[::step, ::step]
    z = points[:, :, 2]
    seen = np.isfinite(z)
    grey = np.zeros(z.shape, dtype=np.uint8)
    if seen.any():
        near, far = np.percentile(z[seen], [1.0, 99.0])
        grey[seen] = (235.0 - 165.0 * np.clip((z[seen] - near) / max(far - near, 1e-3), 0.0, 1.0)).astype(np.uint8)
    shown = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    shown[~seen] = _NOTHING
    scale = WIDTH_PX / shown.shape[1]
    size = (WIDTH_PX, max(1, round(shown.shape[0] * scale)))
    shown = np.asarray(cv2.resize(shown, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
    fit = None if estimate is None or estimate.sequence != scan.sequence else estimate.fit
    if fit is not None and fit.outer_radius_m is not None:
        at = _pixels_of(np.asarray(points, dtype=float), _ring(fit.center_C, fit.normal_C, fit.outer_radius_m))
        if at is not None:
            cv2.polylines(shown, [(scale * at).round().astype(np.int32)], True, _FOUND, 2, cv2.LINE_AA)
    return np.asarray(shown, dtype=np.uint8)


def _ring(center: Array, normal: Array, radius_m: float) -> Array:
    """Points (n, 3) m of a circle."""
    u = np.cross(normal, [1.0, 0.0, 0.0])
    u /= np.linalg.norm(u)
    angle = np.linspace(0.0, 2.0 * np.pi, _RING_POINTS, endpoint=False)[:, None]
    return np.asarray(center + radius_m * (np.cos(angle) * u + np.sin(angle) * np.cross(normal, u)))


def _pixels_of(points: Array, ring: Array) -> Array | None:
    """Map points to pixels (n, 2) by the organised cloud's own projection u = a x / z + b; None for few points."""
    v, u = np.nonzero(np.isfinite(points[:, :, 2]))
    if len(u) < 50:
        return None
    p = points[v, u]
    found: list[Any] = []
    for pixel, axis in ((u, 0), (v, 1)):
        ratio = p[:, axis] / p[:, 2]
        factor, *_ = np.linalg.lstsq(np.column_stack([ratio, np.ones(len(ratio))]), pixel.astype(float), rcond=None)
        found.append(factor[0] * ring[:, axis] / ring[:, 2] + factor[1])
    return np.column_stack(found)


def _small(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height = max(1, round(grey.shape[0] * WIDTH_PX / grey.shape[1]))
    return np.asarray(cv2.resize(grey, (WIDTH_PX, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
