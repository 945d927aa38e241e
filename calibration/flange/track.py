"""Fits plane and both edges of a flange within 3 mm of a given pose; returns None where it is not found there."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import CircleFitError
from weldcal.calibration.flange.edge_labels import pinhole_rays, pinhole_window, refine_pair
from weldcal.calibration.flange.face import (
    FaceMeasurements,
    FaceRefusal,
    FlangeFace,
    FlangeFitConfig,
    clear_band,
    judge,
    lowered_by,
    plane_axes,
    thickness,
)
from weldcal.calibration.geometry.primitives import CircleFit, PlaneFit, plane_steps, refine_circles, shared_noise
from weldcal.calibration.geometry.robust import TUKEY
from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled
from weldcal.models.flanges import FlangeStandard

Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

_SLACK_M = 0.003  # that the centre may have moved sideways
_PLANE_POINTS = 2500
_BLOCK = 4  # pixels a side; what such a block's middle says of the ring and the bore is enough
_BEFORE_M = 0.002  # what stands so far before the face hides it and says nothing of its edge
_LABELLED = 1.2  # pitches about an edge whose pixels place it
_SHARED = 1.3  # variance of a labelled edge over the expected one, as in the window of a search
_RING_SEEN = 0.6  # as in window.py
_FLAT_M = 3e-4  # rms of a face from its plane; a rougher one is for the careful way
_EDGE_POINTS = 240  # crossings that place a circle well enough to look at the pixels about it
_THREE = np.ones((3, 3), np.uint8)


def fit_tracked(
    cloud: Array, center: Array, normal: Array, standard: FlangeStandard, config: FlangeFitConfig
) -> FlangeFace | None:
    """Fit the face in a scan (H, W, 3) m within 3 mm of the centre (3,) m and near the outward normal (3,) given.

    None where it is absent, partly hidden or without a bore, and where the rays are not a pinhole's.
    """
    found = pinhole_window(cloud, center, 0.5 * standard.outer_m + _SLACK_M)
    if found is None:
        return None
    rect, rays = found
    grid = cloud[rect]
    z = np.ascontiguousarray(grid[..., 2], dtype=np.float32)  # to a twentieth of a micrometre
    if rays is None:
        rays = pinhole_rays(grid)
    if rays is None:
        return None
    plane = _plane(z, rays, center, normal, standard, config)
    if plane is None or plane.rms > _FLAT_M:
        return None
    height = thickness(plane)
    view = _View(z, rays, plane, height)
    try:
        fits, pitch = _edges(view, view.onto(center), height, standard)
    except CircleFitError:
        return None
    return judge(_measured(view, fits, pitch, standard), standard, config, FaceRefusal())


def _plane(
    z: Single, rays: Array, center: Array, normal: Array, standard: FlangeStandard, config: FlangeFitConfig
) -> PlaneFit | None:
    """Return the plane of the pixels that lie on the expected ring, from some thousands of them."""
    ring = np.pi * (standard.face_outer_radius_m**2 - standard.face_inner_radius_m**2)
    pitch2 = abs(rays[1, 0] * rays[2, 1] - rays[1, 1] * rays[2, 0]) * float(center[2]) ** 2
    step = max(1, int(np.sqrt(ring / pitch2 / _PLANE_POINTS) + 0.3))
    shape = tuple(-(-n // step) for n in z.shape)
    axes = np.empty((3, 3))
    axes[:, 0], axes[:, 1] = plane_axes(normal)
    axes[:, 2] = normal
    inner, outer = standard.face_inner_radius_m + 0.001, standard.face_outer_radius_m - 0.001
    tolerance = config.hypothesis_tolerance_m
    # in the axes of the expected plane
    p, on = ring_points(z, rays @ axes, center @ axes, step, inner, outer, 4.0 * tolerance)
    if len(on) < config.min_points:
        return None
    agree, fit, moments, limit, e = plane_steps(p, tolerance)
    if not agree:
        return None
    good = np.abs(e) < limit
    e *= good
    count = int(np.count_nonzero(good))
    rms = float(np.sqrt(e @ e / count))
    shared = shared_noise(e, good, on, shape)
    new = axes @ np.array([-fit[1], -fit[2], 1.0])
    new /= float(np.sqrt(new @ new))
    middle = moments[0] / moments[0, 0]
    spread = moments / moments[0, 0] - np.outer(middle, middle)
    sigma = rms * float(np.sqrt(shared / count * 0.5 * (1.0 / spread[1, 1] + 1.0 / spread[2, 2])))
    point = center + axes @ np.array([middle[1], middle[2], float(fit @ middle)])
    return PlaneFit(point, new, rms, int(count / shared), sigma)


class _View:
    """Pixels of a window (h, w) about a plane: which lie on it, which say anything, and where their rays meet it."""

    def __init__(self, z: Single, rays: Array, plane: PlaneFit, height: float) -> None:
        self.plane = plane
        axes = np.empty((3, 3))
        axes[:, 0], axes[:, 1] = plane_axes(plane.normal)
        axes[:, 2] = plane.normal
        self.axes, self.turned, self.at = axes, rays @ axes, plane.point @ axes
        self.shape = h, w = z.shape
        c = self.turned[:, 2].astype(np.float32)
        self.above = (c[0] + c[1] * np.arange(w, dtype=np.float32)) + (c[2] * np.arange(h, dtype=np.float32))[:, None]
        self.above *= z
        self.above -= np.float32(self.at[2])
        valid = z == z
        with np.errstate(invalid="ignore"):
            self.face = np.abs(self.above) < height
            before = self.above > max(3.0 * height, _BEFORE_M)
        gap = cv2.copyMakeBorder((~valid).view(np.uint8), 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=1)
        void = cv2.morphologyEx(gap, cv2.MORPH_OPEN, _THREE)[2:-2, 2:-2].view(bool)
        self.known = (valid | void) & ~before

    def places(self, u: Array, v: Array) -> Array:
        """Where the rays through pixels (u, v) meet the plane: (2, ...) m in its axes, to ten nanometres."""
        u, v = u.astype(np.float32, copy=False), v.astype(np.float32, copy=False)
        t, at = self.turned.astype(np.float32), self.at.astype(np.float32)
        along = (t[1, 2] * u + t[2, 2] * v) + t[0, 2]
        np.divide(at[2], along, out=along)
        out = np.empty((2, *along.shape), dtype=np.float32)
        for k in (0, 1):
            np.multiply(along, (t[1, k] * u + t[2, k] * v) + t[0, k], out=out[k])
            out[k] -= at[k]
        return out

    def slide(self, xy: Array) -> Array:
        """How far (2, ...) a place moves per metre that the plane is raised under its ray."""
        at = self.at[:2].astype(xy.dtype)
        return np.asarray((xy + (at[:, None] if xy.ndim == 2 else at)) * (1.0 / float(self.at[2])))

    def onto(self, center: Array) -> Array:
        """Return a point's place (2,) m along its ray on the plane."""
        c = center @ self.axes
        return np.asarray(c[:2] * (self.at[2] / c[2]) - self.at[:2])


def _edges(view: _View, near: Array, height: float, standard: FlangeStandard) -> tuple[list[CircleFit], float]:
    """Outer edge and bore, and the pitch of the pixels on the plane.

    Raises CircleFitError where either does not show.
    """
    h, w = view.shape
    corner = view.places(0.5 * w + np.array([0.0, 1.0, 0.0]), 0.5 * h + np.array([0.0, 0.0, 1.0]))
    along, down = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    pitch = float(np.sqrt(abs(along[0] * down[1] - along[1] * down[0])))
    d, inward, beyond = borders(view.face, view.known, view.turned, view.at, near)
    rho = np.sqrt(d[0] * d[0] + d[1] * d[1])
    radii = [standard.face_outer_radius_m, standard.face_inner_radius_m]
    width = 2.0 * pitch + 0.0012 + 0.5 * _SLACK_M
    rims = []
    for r, way in zip(radii, (inward, ~inward), strict=True):
        at = np.flatnonzero((np.abs(rho - r) < width) & way)
        if len(at) < 48:
            raise CircleFitError("Too little of an edge is in the scan.")
        rims.append(d[:, at[:: -(-len(at) // _EDGE_POINTS)]].T)
    rough = refine_circles(rims, radii, noise_floor=0.1 * pitch, settled=0.05 * pitch)
    if (
        max(abs(f.radius - r) for f, r in zip(rough, radii, strict=True)) > width
        or float(np.hypot(*(rough[0].center - rough[1].center))) > 3.0 * pitch + 0.001
    ):
        raise CircleFitError("The edges do not agree.")
    starts, lowered, clear = [], [], []
    for k, (f, way) in enumerate(zip(rough, (inward, ~inward), strict=True)):
        e = d - f.center.astype(np.float32)[:, None]
        e = np.sqrt(e[0] * e[0] + e[1] * e[1]) - f.radius
        clear.append(clear_band(standard, pitch, k == 0))
        at = np.flatnonzero((np.abs(e) < max(clear[k], 1.2 * pitch) + height) & way)
        lowered.append(lowered_by(view.above.ravel()[beyond[at]], height, standard.chamfer_m))
        center = near + f.center
        if lowered[k]:
            center = center - lowered[k] * view.slide(center)
        e = e[at]
        inliers = np.abs(e) < TUKEY * max(f.rms, 0.3 * pitch)
        rms = float(np.sqrt((e * e * inliers).sum() / max(int(np.count_nonzero(inliers)), 1)))
        starts.append(CircleFit(center, f.radius, f.covariance, rms, inliers))
    return _labelled(view, starts, pitch, lowered, clear), pitch


def _labelled(
    view: _View, starts: list[CircleFit], pitch: float, lowered: list[float], clear: list[float]
) -> list[CircleFit]:
    """Both edges from the pixels on either side of them."""
    places, sides = [], []
    for k, start in enumerate(starts):
        reach = min(clear[k], _LABELLED * pitch + 3.0 * float(np.sqrt(np.trace(start.covariance[:2, :2]))))
        xy, on = near_edge(
            view.face, view.known, view.turned, view.at, start.center, start.radius, reach, lowered[k], pitch, _BLOCK
        )
        places.append(xy)
        sides.append(on)
    return [replace(f, covariance=_SHARED * f.covariance) for f in refine_pair(places, sides, starts, pitch)]


def _measured(view: _View, fits: list[CircleFit], pitch: float, standard: FlangeStandard) -> FaceMeasurements:
    """What the tests of a flange need, from every fourth pixel along rows and columns."""
    h, w = view.shape
    s = slice(None, None, _BLOCK)
    face, known, above = view.face[s, s], view.known[s, s], view.above[s, s]
    d = view.places(np.arange(0.0, w, _BLOCK), np.arange(0.0, h, _BLOCK)[:, None])
    d -= fits[0].center.astype(np.float32)[:, None, None]
    rho = np.sqrt(d[0] * d[0] + d[1] * d[1])
    ring = (rho > standard.face_inner_radius_m + 0.5 * pitch) & (rho < fits[0].radius - 0.5 * pitch)
    count = int(np.count_nonzero(ring & face))
    core = rho < 0.7 * standard.bore_radius_m
    said = core & (known | (above == above))
    rim = face & (rho > fits[0].radius - (0.5 * _BLOCK + 2.0) * pitch) & (rho < fits[0].radius + 2.0 * pitch)
    parts = 36
    sector = ((np.arctan2(d[1][rim], d[0][rim]) + np.pi) * (parts / (2.0 * np.pi))).astype(np.intp) % parts
    return FaceMeasurements(
        plane=view.plane,
        outer=fits[0],
        bore=fits[1],
        pitch=pitch,
        coverage=float(np.count_nonzero(np.bincount(sector, minlength=parts))) / parts,
        count=count * _BLOCK**2,
        core_share=1.0 - float(np.count_nonzero(core & known & ~face)) / max(int(np.count_nonzero(said)), 1),
        ring_share=count / max(int(np.count_nonzero(ring & known)), int(_RING_SEEN * np.count_nonzero(ring)), 1),
    )


@compiled()
def ring_points(
    z: Single, turned: Array, at: Array, step: int, inner: float, outer: float, tall: float
) -> tuple[Array, Index]:
    """Select the points on a ring about a point from every ``step``-th pixel of depths (h, w) m.

    ``turned`` (3, 3) are the coefficients of the rays in axes whose third is the normal, ``at`` (3,) the point in them;
    ``inner``, ``outer`` and ``tall`` m bound the ring. Returns (x, y, height) (3, N) m about the point and the indices
    (N,) in the image of those pixels.
    """
    h, w = (z.shape[0] + step - 1) // step, (z.shape[1] + step - 1) // step
    out, index = np.empty((3, h * w)), np.empty(h * w, np.int64)
    inner2, outer2 = inner * inner, outer * outer
    n = 0
    for j in range(h):
        v = float(j * step)
        rx, ry, rz = turned[0, 0] + turned[2, 0] * v, turned[0, 1] + turned[2, 1] * v, turned[0, 2] + turned[2, 2] * v
        for i in range(w):
            u = float(i * step)
            depth = float(z[j * step, i * step])
            x = depth * (rx + turned[1, 0] * u) - at[0]
            y = depth * (ry + turned[1, 1] * u) - at[1]
            d = depth * (rz + turned[1, 2] * u) - at[2]
            rho2 = x * x + y * y
            if rho2 > inner2 and rho2 < outer2 and abs(d) < tall:  # false for what was not measured
                out[0, n], out[1, n], out[2, n], index[n] = x, y, d, j * w + i
                n += 1
    return out[:, :n].copy(), index[:n].copy()


@compiled()
def borders(face: Mask, known: Mask, turned: Array, at: Array, near: Array) -> tuple[Single, Mask, Index]:
    """Crossings of the face mask (h, w) between two neighbouring known pixels.

    ``turned`` and ``at`` as in ``places``; ``near`` (2,) m is a point on the plane. Returns the places (2, N) m about
    it in its axes, whether the face lies on the inner side of each, and the flat index of the pixel off the face.
    """
    h, w = face.shape
    first, down = np.empty(2 * h * w, np.int64), np.empty(2 * h * w, np.bool_)
    n = 0
    for v in range(h):
        row, below = face[v], face[min(v + 1, h - 1)]
        for u in range(w - 1):
            if row[u] != row[u + 1] and known[v, u] and known[v, u + 1]:
                first[n], down[n] = v * w + u, False
                n += 1
            if row[u] != below[u] and known[v, u] and known[v + 1, u]:
                first[n], down[n] = v * w + u, True
                n += 1
    out, inward, beyond = np.empty((2, n), np.float32), np.empty(n, np.bool_), np.empty(n, np.int64)
    for i in range(n):
        v, u, k = first[i] // w, first[i] % w, 1 + int(down[i])
        half_u, half_v = u + 0.5 * (2 - k), v + 0.5 * (k - 1)
        sz = turned[0, 2] + turned[1, 2] * half_u + turned[2, 2] * half_v
        sx = turned[0, 0] + turned[1, 0] * half_u + turned[2, 0] * half_v
        sy = turned[0, 1] + turned[1, 1] * half_u + turned[2, 1] * half_v
        along = at[2] / sz
        x, y = along * sx - at[0] - near[0], along * sy - at[1] - near[1]
        # which way the place moves with the pixel
        mx = along * (turned[k, 0] - sx * turned[k, 2] / sz)
        my = along * (turned[k, 1] - sy * turned[k, 2] / sz)
        on = face[v, u]
        out[0, i], out[1, i] = x, y
        inward[i] = (x * mx + y * my > 0.0) == on
        beyond[i] = first[i] + (w if down[i] else 1) if on else first[i]
    return out, inward, beyond


@compiled()
def near_edge(
    face: Mask,
    known: Mask,
    turned: Array,
    at: Array,
    center: Array,
    radius: float,
    reach: float,
    lowered: float,
    pitch: float,
    block: int,
) -> tuple[Single, Mask]:
    """Known pixels within ``reach`` m of a circle on the plane.

    Places (2, N) m about its centre, and which lie on the face (N,). The face may end ``lowered`` m below the plane.
    Blocks of pixels are looked at first.
    """
    h, w = face.shape
    out, on = np.empty((2, h * w), np.float32), np.empty(h * w, np.bool_)
    lower = lowered / at[2]
    half = 0.5 * (block - 1)
    from2, to2 = max(radius - reach, 0.0) ** 2, (radius + reach) ** 2
    # the middle of a block's corner pixel lies so far from its own, and a leaning face stretches them
    wide = reach + lowered + 0.6 * block * pitch
    block_from2, block_to2 = max(radius - wide, 0.0) ** 2, (radius + wide) ** 2
    n = 0
    for j in range(0, h, block):
        for i in range(0, w, block):
            along = at[2] / (turned[0, 2] + turned[1, 2] * (i + half) + turned[2, 2] * (j + half))
            x = along * (turned[0, 0] + turned[1, 0] * (i + half) + turned[2, 0] * (j + half)) - at[0] - center[0]
            y = along * (turned[0, 1] + turned[1, 1] * (i + half) + turned[2, 1] * (j + half)) - at[1] - center[1]
            if not block_from2 < x * x + y * y < block_to2:
                continue
            for v in range(j, min(j + block, h)):
                for u in range(i, min(i + block, w)):
                    if not known[v, u]:
                        continue
                    along = at[2] / (turned[0, 2] + turned[1, 2] * u + turned[2, 2] * v)
                    px = along * (turned[0, 0] + turned[1, 0] * u + turned[2, 0] * v)
                    py = along * (turned[0, 1] + turned[1, 1] * u + turned[2, 1] * v)
                    x, y = px - lower * px - at[0] - center[0], py - lower * py - at[1] - center[1]
                    if from2 < x * x + y * y < to2:
                        out[0, n], out[1, n], on[n] = x, y, face[v, u]
                        n += 1
    return out[:, :n].copy(), on[:n].copy()
