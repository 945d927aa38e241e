"""Locates the edges of a flat face in a cloud without a pixel grid: the extreme points of each sector."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from weldcal.models.arrays import Array

# point pitches of a sector: so narrow that many edge points average, yet none is empty
_SECTOR_PITCHES = 3.0


def plane_axes(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors that complete ``normal`` (3,) to a right-handed orthonormal frame; deterministic."""
    x, y, z = (float(v) for v in normal)
    least = min((abs(x), 0), (abs(y), 1), (abs(z), 2))[1]
    # the cross product of the axis that lies flattest with the normal, written out: np.cross costs 20 microseconds
    e = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))[least]
    length = (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) ** 0.5
    a, b, c = e[0] / length, e[1] / length, e[2] / length
    return np.array([a, b, c]), np.array([y * c - z * b, z * a - x * c, x * b - y * a])


def sector_edges(xy: Array, center: Array, pitch: float, *, outer: bool, band: tuple[float, float]) -> Array:
    """Outermost (or innermost) points per sector about ``center`` of a face given as points (N, 2) m; (K, 2).

    Only points at a radius within ``band`` [m] count. The edge is found short by a fraction of the pitch all round,
    which changes the radius and not the centre.
    """
    d = xy - center
    rho = np.hypot(d[:, 0], d[:, 1])
    near = (rho > band[0]) & (rho < band[1])
    if not near.any():
        return np.zeros((0, 2))
    d, rho, xy = d[near], rho[near], xy[near]
    radius = 0.5 * (band[0] + band[1])
    sectors = sector_count(radius, pitch)
    sector = np.floor((np.arctan2(d[:, 1], d[:, 0]) + np.pi) / (2.0 * np.pi) * sectors).astype(int) % sectors
    order = np.lexsort((-rho if outer else rho, sector))
    first = np.unique(sector[order], return_index=True)[1]
    return np.asarray(xy[order[first]])


def sector_count(radius: float, pitch: float) -> int:
    """Number of sectors for an edge of that radius (m) and point pitch (m)."""
    return int(np.clip(2.0 * np.pi * radius / (_SECTOR_PITCHES * pitch), 24, 720))


def coverage(points: Array, center: Array, sectors: int = 72) -> float:
    """Share (0..1) of the directions about ``center`` in which at least one of the points (N, 2) lies."""
    if len(points) == 0:
        return 0.0
    d = points - center
    sector = np.floor((np.arctan2(d[:, 1], d[:, 0]) + np.pi) / (2.0 * np.pi) * sectors).astype(int) % sectors
    return len(np.unique(sector)) / sectors


def connected_parts(xy: Array, cell: float) -> NDArray[np.intp]:
    """Label (N,) of the connected part each point (N, 2) m belongs to, on a raster of ``cell`` [m]; largest
    part is 0."""
    grid = np.floor((xy - xy.min(axis=0)) / cell).astype(int) + 1
    image = np.zeros(grid.max(axis=0) + 2, dtype=bool)
    image[grid[:, 0], grid[:, 1]] = True
    labels, _ = ndimage.label(image, structure=np.ones((3, 3)))
    return _by_size(np.asarray(labels[grid[:, 0], grid[:, 1]], dtype=np.intp))


def _by_size(part: NDArray[np.intp]) -> NDArray[np.intp]:
    values, inverse, counts = np.unique(part, return_inverse=True, return_counts=True)
    rank = np.empty(len(values), dtype=int)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(values))
    return np.asarray(rank[inverse])
