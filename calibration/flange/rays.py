"""Models the viewing rays of an organised scan over its pixels: quadratic, or pinhole where that fits."""

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array

Mask = NDArray[np.bool_]

_BENT = 0.05  # pixels: a lens that bends rays more is for the careful way, which knows quadratics


class RayModel:
    """Viewing rays of an organised cloud as a smooth function of the pixel: x/z and y/z are quadratics in (u, v).

    Exact for a pinhole scanner, whose noise moves a point along its ray; the quadratic absorbs a lens locally.
    """

    def __init__(self, points: Array, valid: Mask) -> None:
        v, u = np.nonzero(valid)
        p = points[v, u]
        stride = max(1, len(u) // 1500)
        self._origin = np.array([u.mean(), v.mean()])
        self._scale = max(float(np.ptp(u)), float(np.ptp(v)), 1.0)
        basis = self._basis(u[::stride], v[::stride])
        ray = p[::stride, :2] / p[::stride, 2:]
        self._coefficients = np.linalg.lstsq(basis, ray, rcond=None)[0]

    def _basis(self, u: Array | NDArray[np.intp], v: Array | NDArray[np.intp]) -> Array:
        a, b = (u - self._origin[0]) / self._scale, (v - self._origin[1]) / self._scale
        return np.column_stack([np.ones(len(a)), a, b, a * a, a * b, b * b])

    def grid(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Rays x/z and y/z, each (len(v), len(u)), of a whole grid of pixels."""
        a, b = (u - self._origin[0]) / self._scale, ((v - self._origin[1]) / self._scale)[:, None]
        c = self._coefficients.T
        x, y = ((k[0] + k[1] * a + k[3] * a * a) + b * (k[2] + k[4] * a) + k[5] * (b * b) for k in c)
        return x, y

    def on_plane(self, u: Array, v: Array, point: Array, normal: Array) -> Array:
        """Points (N, 3) m where the rays through pixels (u, v) meet a plane."""
        ray = np.column_stack([self._basis(u, v) @ self._coefficients, np.ones(len(u))])
        return np.asarray(ray * (float(point @ normal) / (ray @ normal))[:, None])


def _sampled(cloud: Array, across: int) -> tuple[Array, Array] | None:
    """Of some ``across`` x ``across`` pixels those that were measured: (1, u, v) (n, 3) and points (n, 3)."""
    H, W = cloud.shape[:2]
    dv, du = max(1, H // across), max(1, W // across)
    p = cloud[dv // 2 :: dv, du // 2 :: du]
    A = np.ones((*p.shape[:2], 3))
    A[..., 1] = np.arange(du // 2, W, du)
    A[..., 2] = np.arange(dv // 2, H, dv)[:, None]
    seen = p[..., 2] == p[..., 2]
    A, p = A[seen], p[seen]
    return (A, p) if len(p) >= 12 else None


def _pinhole(A: Array, p: Array) -> Array | None:
    """Coefficients (3, 2) of rays (x/z, y/z) = (1, u, v) @ them, least squares."""
    try:
        return np.asarray(np.linalg.solve(A.T @ A, A.T @ (p[:, :2] / p[:, 2:])))
    except np.linalg.LinAlgError:
        return None


def pinhole_window(cloud: Array, center: Array, reach: float) -> tuple[tuple[slice, slice], Array | None] | None:
    """Rectangle of the pixels that may show a ball of radius ``reach`` m about a centre, by a pinhole through a few of
    all pixels; and their rays, as ``pinhole_rays`` gives them, where that pinhole fits the whole image."""
    some = _sampled(cloud, 12)
    if some is None or not float(center[2]) > 2.0 * reach:
        return None
    c = _pinhole(*some)
    if c is None:
        return None
    det = c[1, 0] * c[2, 1] - c[2, 0] * c[1, 1]
    if det == 0.0:
        return None
    a, b = center[0] / center[2] - c[0, 0], center[1] / center[2] - c[0, 1]
    at = ((a * c[2, 1] - b * c[2, 0]) / det, (b * c[1, 0] - a * c[1, 1]) / det)
    # a ball is seen a little wider than its middle's distance says
    wide = reach / (float(center[2]) - reach)
    low = [int(np.floor(x - wide / abs(k))) for x, k in zip(at, (c[1, 0], c[2, 1]), strict=True)]
    high = [int(np.ceil(x + wide / abs(k))) + 1 for x, k in zip(at, (c[1, 0], c[2, 1]), strict=True)]
    if min(low) < 0 or high[0] > cloud.shape[1] or high[1] > cloud.shape[0]:
        return None  # cut by the image's border: partly hidden
    rays = None
    off = some[0] @ c - some[1][:, :2] / some[1][:, 2:]
    if float(np.abs(off).max()) < _BENT * float(np.abs(c[1:]).max()):
        rays = np.zeros((3, 3))
        rays[:, :2], rays[0, 2] = c, 1.0
        rays[0, :2] += low[0] * c[1] + low[1] * c[2]
    return (slice(low[1], high[1]), slice(low[0], high[0])), rays


def pinhole_rays(grid: Array) -> Array | None:
    """Coefficients (3, 3) of the viewing rays (x/z, y/z, 1) = (1, u, v) @ them; None where they are not a pinhole's."""
    some = _sampled(grid, 10)
    c = None if some is None else _pinhole(*some)
    if some is None or c is None:
        return None
    if not float(np.abs(some[0] @ c - some[1][:, :2] / some[1][:, 2:]).max()) < _BENT * float(np.abs(c[1:]).max()):
        return None
    out = np.zeros((3, 3))
    out[:, :2], out[0, 2] = c, 1.0
    return out
