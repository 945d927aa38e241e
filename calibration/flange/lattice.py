"""Rebuilds the sensor's pixel grid of an unordered cloud from its own projection."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from weldcal.models.arrays import Array

_LOCAL = 400  # points about the middle that show the lattice
_NEIGHBOURS = 8  # of each: they span the lattice where only a third of the points is left
_FIT = 3_000  # points that fix the polynomial
_INSIDE = 0.25  # of a cell: how far a point may lie from its pixel's ray
_MOST = 0.97  # share of the points that must lie so close
_DOUBLE = 0.01  # share of the pixels that may have two points: more are two views, or noise
_CELLS = 60_000_000  # the largest grid: six times the pixels of the largest scanner in use
_THINNED = 0.5  # a scan with fewer neighbours of its pixels
_STEP_M = 0.003  # depth per pixel at which one body ends before another


def rebuild_grid(points: Array) -> Array | None:
    """The organised scan (H, W, 3) m, NaN where nothing was measured, of an unordered cloud (N, 3) in its sensor's
    frame.

    A sensor measures along the rays of its pixels: x/z and y/z of the points lie on a lattice, which a polynomial of
    the third degree bends where a lens does. None where they do not: a cloud of several views, in another frame, or
    noisy across its rays.
    """
    points = points[np.isfinite(points).all(axis=1)]
    z = points[:, 2]
    if len(points) < _LOCAL or not ((z > 0.0).all() or (z < 0.0).all()):
        return None
    ray = points[:, :2] / z[:, None]
    middle = ray[np.argmin(((ray - np.median(ray, axis=0)) ** 2).sum(axis=1))]
    found = _basis(ray, middle)
    if found is None:
        return None
    index = _indices(ray - middle, found)
    if index is None:
        return None
    index -= index.min(axis=0)
    w, h = (index.max(axis=0) + 1).tolist()
    if w * h > _CELLS:
        return None
    cell = index[:, 1] * w + index[:, 0]
    grid = np.full((h * w, 3), np.nan)
    grid[cell] = points
    known = np.isfinite(grid[:, 0])
    if np.count_nonzero(known) < (1.0 - _DOUBLE) * len(points):
        return None
    return grid.reshape(h, w, 3)


def _basis(ray: Array, middle: Array) -> Array | None:
    """The lattice's two shortest steps (2, 2), one a row, the first along x, from rays (N, 2) about a middle (2,)."""
    far = ((ray - middle) ** 2).sum(axis=1)
    some = ray[np.argpartition(far, min(4 * _LOCAL, len(far) - 1))[: 4 * _LOCAL]]
    about = cKDTree(some)
    near = some[np.asarray(about.query(middle, k=_LOCAL)[1])]
    which = np.asarray(about.query(near, k=_NEIGHBOURS + 1)[1])
    d = (some[which[:, 1:]] - near[:, None]).reshape(-1, 2)
    length = np.hypot(d[:, 0], d[:, 1])
    if not length.min() > 0.0:
        return None
    shortest = d[length < 1.2 * np.quantile(length, 0.02)]
    first = _same(shortest, shortest[0])
    area = np.abs(d[:, 0] * first[1] - d[:, 1] * first[0])
    off = area > 0.3 * float(first @ first)
    if not off.any():
        return None
    cell = np.quantile(area[off], 0.02)
    second = d[off & (area < 1.2 * cell)]
    second = _same(second, second[0])
    basis = _reduced(np.array([first, second]))
    steps = d @ np.linalg.inv(basis)
    if np.mean(np.abs(steps - np.rint(steps)).max(axis=1) < _INSIDE) < _MOST:
        return None
    fit = np.rint(steps)
    basis = np.asarray(np.linalg.lstsq(fit, d, rcond=None)[0], dtype=float)
    along = np.abs(basis[:, 0])
    basis = basis[np.argsort(-along, kind="stable")]
    return np.asarray(basis * np.sign([[basis[0, 0]], [basis[1, 1]]]))


def _same(d: Array, like: Array) -> Array:
    """The median of those steps (N, 2) that equal one of them, or its reverse, within a fifth of its length."""
    d = np.where((d @ like)[:, None] < 0.0, -d, d)
    return np.asarray(np.median(d[np.hypot(*(d - like).T) < 0.2 * np.hypot(*like)], axis=0))


def _reduced(basis: Array) -> Array:
    """The shortest basis of the same lattice (Lagrange)."""
    a, b = basis
    for _ in range(10):
        if a @ a > b @ b:
            a, b = b, a
        k = np.rint(float(a @ b) / float(a @ a))
        if k == 0.0:
            break
        b = b - k * a
    return np.array([a, b])


def _indices(ray: Array, basis: Array) -> NDArray[np.intp] | None:
    """Pixel (N, 2) of each ray (N, 2) about the middle: a plane's lattice, or one that grows from the middle and
    bends."""
    at = ray @ np.linalg.inv(basis)
    order = np.argsort((at * at).sum(axis=1), kind="stable")
    for degree in (1, 3):
        count, scale, c = _LOCAL, 1.0, None
        while True:
            count = min(2 * count, len(at))
            inside = order[:count][:: max(1, count // _FIT)]
            found = at[inside] if c is None else _terms(at[inside] / scale, degree) @ c
            whole = np.rint(found)
            close = np.abs(found - whole).max(axis=1) < _INSIDE
            if np.mean(close) < _MOST:
                break
            inside, whole = inside[close], whole[close]
            scale = float(np.abs(at[inside]).max())
            c = np.linalg.lstsq(_terms(at[inside] / scale, degree), whole, rcond=None)[0]
            if count == len(at):
                found = _terms(at / scale, degree) @ c
                index = np.rint(found)
                if np.mean(np.abs(found - index).max(axis=1) < _INSIDE) < _MOST:
                    break
                return np.asarray(index, dtype=np.intp)
    return None


def _terms(at: Array, degree: int) -> Array:
    x, y = at.T
    powers = [[np.ones_like(x), x, x * x, x * x * x], [np.ones_like(y), y, y * y, y * y * y]]
    return np.column_stack([powers[0][i] * powers[1][j] for i in range(degree + 1) for j in range(degree + 1 - i)])


def is_thinned(grid: Array) -> bool:
    """Whether fewer than half of a scan's (H, W, 3) pixels have a measured neighbour beside them, or below them."""
    known = np.isfinite(grid[..., 2])
    count = np.count_nonzero(known)
    beside = np.count_nonzero(known[:, 1:] & known[:, :-1])
    below = np.count_nonzero(known[1:] & known[:-1])
    return bool(count > 0 and min(beside, below) < _THINNED * count)


def interpolated(grid: Array) -> Array:
    """A thinned scan (H, W, 3) with its gaps filled, along the rows and then along the columns.

    x/z, y/z and 1/z are linear across a gap, as they are on a plane; where the depth steps, the nearest one goes on.
    Gaps longer than twice the common one stay.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / grid[..., 2]
        rays = np.stack([grid[..., 0] * inverse, grid[..., 1] * inverse, inverse], axis=-1)
    for _ in range(2):
        rays = np.swapaxes(_along_rows(rays), 0, 1)
    rays[..., 2] = 1.0 / rays[..., 2]
    rays[..., :2] *= rays[..., 2:]
    return np.ascontiguousarray(rays)


def _along_rows(rays: Array) -> Array:
    """Rays and inverse depth (h, w, 3) with the gaps of the rows filled."""
    h, w = rays.shape[:2]
    known = np.flatnonzero(np.isfinite(rays[..., 2]))
    row, column = np.divmod(known, w)
    gap = np.diff(column)
    same = np.diff(row) == 0
    if not (same & (gap > 1)).any():
        return rays
    widest = 2 * int(np.median(gap[same & (gap > 1)]))
    fill = np.flatnonzero(same & (gap > 1) & (gap <= widest))
    out = rays.reshape(-1, 3).copy()
    a, b, g = out[known[fill]], out[known[fill + 1]], gap[fill]
    step = np.abs(1.0 / b[:, 2] - 1.0 / a[:, 2]) > _STEP_M * g
    for k in range(1, widest):
        at = k < g
        share = (k / g[at])[:, None]
        value = (1.0 - share) * a[at] + share * b[at]
        near = np.where(share[:, 0] <= 0.5, a[at, 2], b[at, 2])
        value[:, 2] = np.where(step[at], near, value[:, 2])
        out[known[fill[at]] + k] = value
    return out.reshape(h, w, 3)
