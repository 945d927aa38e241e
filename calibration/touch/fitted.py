"""Fits the touched plane or sphere to the scanner's points around a place."""

import numpy as np

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

LEAST_POINTS = 30
_STEPS = 20
_TUKEY = 4.685


def around(points_C: Array, p_C: Array, within_m: float, name: str, least: int = LEAST_POINTS) -> Array:
    """Points (n, 3) m of a cloud at most ``within_m`` from a place (3,) m. Raises InputError for fewer than ``least``."""
    p = np.asarray(points_C, dtype=float).reshape(-1, 3)
    near: Array = p[np.linalg.norm(np.nan_to_num(p, nan=np.inf) - p_C, axis=1) <= within_m]
    if len(near) < least:
        raise InputError(
            f"Touch '{name}': the cloud has {len(near)} points within {1e3 * within_m:.0f} mm of camera_x, camera_y, camera_z, and "
            f"{least} are needed. Correct the place, or raise `within`."
        )
    return np.asarray(near)


def fit_touched_plane(points_C: Array) -> tuple[Array, Array, float]:
    """Point (3,) m, unit normal (3,) towards the camera and its standard deviation (m) of the plane through points (n, 3).

    Total least squares with Tukey's weights, the scale from the median. The deviation is that of the plane's distance where the points are.
    """
    w = np.ones(len(points_C))
    middle, n, scale = points_C.mean(axis=0), np.zeros(3), 0.0
    for _ in range(_STEPS):
        middle = w @ points_C / w.sum()
        away = points_C - middle
        n = np.linalg.eigh((away * w[:, None]).T @ away)[1][:, 0]
        e = away @ n
        scale = max(1.4826 * float(np.median(np.abs(e))), 1e-7)
        w = np.maximum(1.0 - (e / (_TUKEY * scale)) ** 2, 0.0) ** 2
    return middle, n if n @ middle < 0.0 else -n, scale / float(np.sqrt(w.sum()))


def fit_touched_sphere(
    points_C: Array, radius_m: float, correction: ScannerCorrection | None = None
) -> tuple[Array, float]:
    """Centre (3,) m, as the scanner gives it, and its standard deviation (m) of a sphere of known radius through points (n, 3) of its near side.

    Gauss-Newton on distances with Tukey's weights; the points are corrected first, because the radius is the true one, and the centre is
    returned uncorrected. The deviation is the largest of the three axes.
    """
    p = points_C if correction is None else correction.points(points_C)
    middle = p.mean(axis=0)
    c = middle + radius_m * middle / np.linalg.norm(middle)  # behind what is seen
    w, scale, N = np.ones(len(p)), 1.0, np.eye(3)
    for _ in range(_STEPS):
        v = p - c
        d = np.linalg.norm(v, axis=1)
        e, J = d - radius_m, -v / d[:, None]
        scale = max(1.4826 * float(np.median(np.abs(e))), 1e-7)
        w = np.maximum(1.0 - (e / (_TUKEY * scale)) ** 2, 0.0) ** 2
        N = (J * w[:, None]).T @ J
        c = c - np.linalg.solve(N + 1e-9 * np.eye(3), (J * w[:, None]).T @ e)
    sigma = scale * float(np.sqrt(1.0 / max(np.linalg.eigvalsh(N)[0], 1e-9)))
    if correction is None:
        return c, sigma
    raw = c.copy()
    for _ in range(_STEPS):  # the correction is nearly the identity: a fixed point
        raw = raw + (c - correction.points(raw))
    return raw, sigma
