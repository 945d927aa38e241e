"""Where the points near a plane lie and how they spread, weighted by their distance from it, compiled for many at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.compiled import compiled

Single = NDArray[np.float32]

_ONE, _ZERO = np.float32(1.0), np.float32(0.0)


@compiled(any_order=True)
def weighted_moments(p: Single, d: Single, limit: float) -> tuple[float, Single, NDArray[np.float64]]:
    """Of points (3, N) m at distances (N,) m from a plane, with Tukey's weights: the mean weight, the middle (3,) m and the
    covariance (3, 3) m^2. ``limit`` m is where a point's weight ends. In single precision, so the points must be about their middle."""
    n = p.shape[1]
    k = np.float32(1.0 / limit)
    s = sx = sy = sz = xx = xy = xz = yy = yz = zz = _ZERO
    for i in range(n):
        t = d[i] * k
        w = max(_ONE - t * t, _ZERO)
        w *= w
        x, y, z = p[0, i], p[1, i], p[2, i]
        wx, wy, wz = w * x, w * y, w * z
        s += w
        sx += wx
        sy += wy
        sz += wz
        xx += wx * x
        xy += wx * y
        xz += wx * z
        yy += wy * y
        yz += wy * z
        zz += wz * z
    total = max(float(s), 1e-30)
    a, b, c = float(sx) / total, float(sy) / total, float(sz) / total
    moments = np.empty((3, 3))
    moments[0, 0], moments[1, 1], moments[2, 2] = xx / total - a * a, yy / total - b * b, zz / total - c * c
    moments[0, 1] = moments[1, 0] = xy / total - a * b
    moments[0, 2] = moments[2, 0] = xz / total - a * c
    moments[1, 2] = moments[2, 1] = yz / total - b * c
    return float(s) / n, np.array([a, b, c], dtype=np.float32), moments
