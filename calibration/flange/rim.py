"""Locates the edges of a flat face: mask crossings in organised clouds, extreme points per sector in unordered ones."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from weldcal.calibration.flange.rays import RayModel
from weldcal.models.arrays import Array

Mask = NDArray[np.bool_]

SMOOTHING_PX = 1.0  # of the face mask before its edge is located
_SECTOR_PITCHES = (
    3.0  # a sector is this many point pitches wide: so narrow that many edge points average, yet none is empty
)


@dataclass(frozen=True)
class FacePixels:
    """Pixels about a face seen through a grid: place under their rays in the plane (N, 2) m, which is on the face,
    ``slide``."""

    points: Array
    on_face: Mask
    slide: Array


@dataclass(frozen=True)
class EdgePoints:
    """Edge points of a face seen through a pixel grid, in the plane's axes.

    ``points`` (N, 2) m; ``step`` (N, 2) m, one step of the grid across the edge; ``slide`` (N, 2), how far along the
    plane a point moves per metre that the plane is raised under its ray; ``beyond`` (N,) m, height of the pixel past
    the edge.
    """

    points: Array
    step: Array
    slide: Array
    beyond: Array


def plane_axes(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors that complete ``normal`` (3,) to a right-handed orthonormal frame; deterministic."""
    x, y, z = (float(v) for v in normal)
    least = min((abs(x), 0), (abs(y), 1), (abs(z), 2))[1]
    # the cross product of the axis that lies flattest with the normal, written out: np.cross costs 20 microseconds
    e = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))[least]
    length = (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) ** 0.5
    a, b, c = e[0] / length, e[1] / length, e[2] / length
    return np.array([a, b, c]), np.array([y * c - z * b, z * a - x * c, x * b - y * a])


def organised_edges(points: Array, face: Mask, rays: RayModel, point: Array, normal: Array) -> EdgePoints:
    """Edge points of the mask ``face`` (H, W) of an organised cloud (H, W, 3), in the plane's axes about ``point``.

    The mask is smoothed (Gaussian) and its level 1/2 is found between neighbours along rows and columns: unbiased at a
    straight edge, and a circle only shrinks a little all round. Pixels that say nothing (see ``unknown_pixels``) take
    no part: a scanner loses pixels at a sharp step and keeps them where a chamfer softens it, which would pull the
    centre to one side.
    """
    axes = np.column_stack(plane_axes(normal))
    known = np.asarray(~unknown_pixels(points), dtype=np.float64)
    total = ndimage.gaussian_filter(known, SMOOTHING_PX, truncate=3.0, mode="nearest")
    level = (
        ndimage.gaussian_filter(face * known, SMOOTHING_PX, truncate=3.0, mode="constant") / np.maximum(total, 1e-3)
        - 0.5
    )
    up = level > 0.0
    v, u = np.nonzero(up[:, 1:] != up[:, :-1])
    q, w = np.nonzero(up[1:, :] != up[:-1, :])
    across = level[v, u] / (level[v, u] - level[v, u + 1])
    down = level[q, w] / (level[q, w] - level[q + 1, w])
    uu, vv = np.concatenate([u + across, w]), np.concatenate([v, q + down])
    half = np.concatenate([np.tile([0.5, 0.0], (len(u), 1)), np.tile([0.0, 0.5], (len(w), 1))])
    ahead = (rays.on_plane(uu + half[:, 0], vv + half[:, 1], point, normal) - point) @ axes
    behind = (rays.on_plane(uu - half[:, 0], vv - half[:, 1], point, normal) - point) @ axes
    middle = rays.on_plane(uu, vv, point, normal)
    off_v = np.concatenate([v, np.where(up[q, w], q + 1, q)])
    off_u = np.concatenate([np.where(up[v, u], u + 1, u), w])
    return EdgePoints(
        points=(middle - point) @ axes,
        step=ahead - behind,
        slide=(middle @ axes) / (middle @ normal)[:, None],
        beyond=(points[off_v, off_u] - point) @ normal,
    )


def face_pixels(points: Array, face: Mask, rays: RayModel, point: Array, normal: Array) -> FacePixels:
    """Pixels of a grid (H, W, 3) labelled on or off the face (all but small gaps), in the plane's axes."""
    axes = np.column_stack(plane_axes(normal))
    v, u = np.nonzero(~unknown_pixels(points))
    on_plane = rays.on_plane(u.astype(float), v.astype(float), point, normal)
    return FacePixels((on_plane - point) @ axes, face[v, u], (on_plane @ axes) / (on_plane @ normal)[:, None])


def unknown_pixels(points: Array) -> Mask:
    """Mask (H, W) of small gaps without a reading, which carry no information on an edge. A gap that holds 3 x 3 pixels
    counts as off the face."""
    gap = np.isnan(points[..., 2])
    void = ndimage.binary_opening(np.pad(gap, 2, constant_values=True), np.ones((3, 3), dtype=bool))[2:-2, 2:-2]
    return np.asarray(gap & ~void)


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


def connected_pixels(mask: Mask) -> NDArray[np.intp]:
    """Connected parts of a pixel mask (H, W): label image, largest part 0, next 1, ...; -1 outside the mask."""
    labels, _ = ndimage.label(mask)
    out = np.full(mask.shape, -1)
    out[mask] = _by_size(np.asarray(labels[mask], dtype=np.intp))
    return out


def _by_size(part: NDArray[np.intp]) -> NDArray[np.intp]:
    values, inverse, counts = np.unique(part, return_inverse=True, return_counts=True)
    rank = np.empty(len(values), dtype=int)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(values))
    return np.asarray(rank[inverse])
