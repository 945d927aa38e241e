"""A cropped scan: points alone, or points with their pixel grid and viewing rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from weldcal.calibration.flange.rays import RayModel
from weldcal.calibration.flange.rim import (
    EdgePoints,
    FacePixels,
    connected_parts,
    connected_pixels,
    face_pixels,
    organised_edges,
    plane_axes,
)
from weldcal.calibration.geometry.plane import PlaneFit
from weldcal.models.arrays import Array

Mask = NDArray[np.bool_]
Labels = NDArray[np.intp]

_STEP_M = 0.003  # depth between neighbouring pixels (or gap between points) that separates two bodies
_MAX_ISLANDS = 40


@dataclass(frozen=True, eq=False)
class Scene:
    """Valid points (N, 3) m of a cropped scan; organised scans keep their grid (H, W, 3), its valid mask and
    its rays."""

    points: Array
    grid: Array | None = None
    valid: Mask | None = None
    rays: RayModel | None = None

    def near(self, center: Array, radius: float) -> Scene:
        """The part of the scene in a box about ``center`` with half-edge ``radius``."""
        return crop(self.points if self.grid is None else self.grid, center, radius)

    def on_plane(self, plane: PlaneFit, thickness: float, center: Array, reach: float) -> tuple[Array, Mask | None]:
        """Points within ``thickness`` of a plane and ``reach`` of ``center``, in the plane's axes (N, 2); their pixel
        mask."""
        axes = np.column_stack(plane_axes(plane.normal))
        cloud = self.points if self.grid is None else self.grid
        with np.errstate(invalid="ignore"):
            d = cloud - center
            flat = np.abs(d @ plane.normal - float((plane.point - center) @ plane.normal)) < thickness
            face = flat & (np.einsum("...k,...k->...", d, d) < reach**2)
            if self.valid is not None:
                face &= self.valid
        return (cloud[face] - plane.point) @ axes, None if self.grid is None else face

    def parts(self, plane: PlaneFit, thickness: float, center: Array, reach: float) -> tuple[Array, float, Labels]:
        """The face points (N, 2), the pitch between points (m), and the connected part each belongs to, largest 0."""
        xy, face = self.on_plane(plane, thickness, center, reach)
        if face is not None:
            return xy, self._grid_pitch(plane), connected_pixels(face)[face]
        if len(xy) < 6:
            return xy, 1e-3, np.zeros(len(xy), dtype=np.intp)
        few = xy[:: max(1, len(xy) // 200)]
        # the 4th neighbour on a square grid is one pitch away; less sensitive to doubled points than the 1st
        pitch = float(np.median(np.asarray(cKDTree(xy).query(few, k=5)[0])[:, -1]))
        return xy, pitch, connected_parts(xy, 2.5 * pitch)

    def edges(
        self, plane: PlaneFit, thickness: float, center: Array, reach: float, *, labels: bool
    ) -> tuple[Array, EdgePoints | None, FacePixels | None]:
        """Face points (N, 2) and, on organised scans, the crossings of the face's mask and (with ``labels``) its
        pixels."""
        xy, face = self.on_plane(plane, thickness, center, reach)
        if face is None or self.grid is None or self.rays is None:
            return xy, None, None
        return (
            xy,
            organised_edges(self.grid, face, self.rays, plane.point, plane.normal),
            face_pixels(self.grid, face, self.rays, plane.point, plane.normal) if labels else None,
        )

    def _grid_pitch(self, plane: PlaneFit) -> float:
        if self.rays is None or self.valid is None:
            raise ValueError("a pitch in pixels needs an organised scene")
        v, u = (float(np.mean(i)) for i in np.nonzero(self.valid))
        corner = self.rays.on_plane(np.array([u, u + 1.0, u]), np.array([v, v, v + 1.0]), plane.point, plane.normal)
        return float(np.sqrt(np.linalg.norm(np.cross(corner[1] - corner[0], corner[2] - corner[0]))))


def crop(cloud: Array, center: Array | None = None, radius: float = np.inf) -> Scene:
    """A scan (N, 3) or (H, W, 3) with NaN where invalid, cut to a box about ``center`` (3,) with half-edge ``radius``
    m."""
    valid: Mask = np.isfinite(cloud[..., 0]) & np.isfinite(cloud[..., 1]) & np.isfinite(cloud[..., 2])
    if center is not None:
        with np.errstate(invalid="ignore"):
            for axis in range(3):
                valid &= np.abs(cloud[..., axis] - center[axis]) < radius
    if cloud.ndim == 2:
        return Scene(cloud[valid].astype(float))
    rows, columns = np.nonzero(np.any(valid, axis=1))[0], np.nonzero(np.any(valid, axis=0))[0]
    if len(rows) == 0:
        return Scene(np.zeros((0, 3)))
    v = slice(max(int(rows[0]) - 2, 0), int(rows[-1]) + 3)
    u = slice(max(int(columns[0]) - 2, 0), int(columns[-1]) + 3)
    grid, mask = cloud[v, u].astype(float), valid[v, u]
    points = grid[mask]
    if len(points) < 12:
        return Scene(points)
    return Scene(points, grid, mask, RayModel(grid, mask))


def islands(scene: Scene, diameter: float) -> list[Array]:
    """Centres (3,) of the separate bodies in a scene that are about ``diameter`` m across, largest first, at most 40.

    Bodies end where the depth of neighbouring pixels jumps by 3 mm, or, without a grid, where space is empty that far.
    """
    if scene.grid is not None and scene.valid is not None:
        z = np.where(scene.valid, scene.grid[..., 2], np.nan)
        with np.errstate(invalid="ignore"):
            smooth = scene.valid.copy()
            smooth[:, 1:] &= np.abs(np.diff(z, axis=1)) < _STEP_M
            smooth[1:] &= np.abs(np.diff(z, axis=0)) < _STEP_M
        labels = ndimage.label(smooth)[0][smooth]
        points = scene.grid[smooth]
    else:
        points = scene.points
        cell = np.floor((points - points.min(axis=0)) / _STEP_M).astype(np.int64)
        if float(np.prod(cell.max(axis=0).astype(float) + 1.0)) > 2e8:
            return []
        count = np.zeros(cell.max(axis=0) + 1, dtype=np.uint16)
        np.add.at(count, (cell[:, 0], cell[:, 1], cell[:, 2]), 1)
        # a lone point in the air is a flying pixel, not a bridge
        space = count > 0.3 * float(np.median(count[count > 0]))
        labels = ndimage.label(space)[0][cell[:, 0], cell[:, 1], cell[:, 2]]
        points, labels = points[labels > 0], labels[labels > 0]
    if len(labels) == 0:
        return []
    order = np.argsort(labels, kind="stable")
    starts = np.nonzero(np.diff(labels[order], prepend=-1))[0]
    low = np.minimum.reduceat(points[order], starts)
    high = np.maximum.reduceat(points[order], starts)
    counts = np.diff(starts, append=len(labels))
    extent = np.linalg.norm(high - low, axis=1)
    fits = np.nonzero((counts >= 100) & (extent > 0.8 * diameter) & (extent < 2.2 * diameter))[0]
    best = fits[np.argsort(-counts[fits], kind="stable")][:_MAX_ISLANDS]
    return [0.5 * (low[k] + high[k]) for k in best]
