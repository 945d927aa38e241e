"""Fits a flange face in a window of an organised scan: plane, edge crossings, and both circles from pixel labels."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from weldcal.calibration.errors import CircleFitError, PlaneFitError
from weldcal.calibration.flange.edge_labels import RayModel, refine_circle
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
from weldcal.calibration.geometry.primitives import CircleFit, PlaneFit, fit_plane, refine_circles, shared_noise
from weldcal.calibration.geometry.robust import MAD
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

Mask = NDArray[np.bool_]

_PLANE_POINTS = 4000
_FLAT_M = 3e-4  # rms of a face from its plane that a scanner's own distortion may leave
_FLAT_NOISE = 2.5  # and in multiples of its noise: a ball bends more
_BEFORE_M = 0.002  # what stands so far before the face hides it and says nothing of its edge
# share of the ring that counts at least, scanned or not: with _HOLLOW, 0.42 of it must be face; a choice
_RING_SEEN = 0.6
_LABELLED = 1.2  # pitches about an edge whose pixels place it; farther ones say nothing that nearer ones do not
_LABEL_SECTORS = 24  # of a thinned scan's edge: each with points on both sides of it, or none of its points counts
_BEYOND = 0.6  # share of the places beyond it that show something: with less, the outermost points place it better
_DOMED = 0.8  # of its rms: a face whose inner half stands so far above or below its outer half is a ball or a dish
_SHARED = 1.3  # variance of a labelled edge over the expected one, from simulated scans with noise, gaps and chamfers


@dataclass(frozen=True, eq=False, kw_only=True)
class _Window:
    """Pixels of a window as arrays (h, w).

    Measured depth z, its ray (rx, ry, 1), and where the ray meets the plane, in the plane's axes about ``origin``.
    """

    z: Array
    rays: tuple[Array, Array]
    x: Array
    y: Array
    slope: Array  # normal times ray
    face: Mask
    known: Mask
    measured: Mask | None  # None: all that have a depth


def measure_window(
    grid: Array,
    center: Array,
    normal: Array,
    radius: float,
    standard: FlangeStandard,
    config: FlangeFitConfig,
    refusal: FaceRefusal,
    measured: Mask | None = None,
) -> FlangeFace | None:
    """Fit the face with an outer edge near ``center`` (3,) m and ``radius`` m in a part (h, w, 3) of a scan.

    ``normal`` (3,) outward, within a few degrees. ``measured`` (h, w) of a thinned scan with interpolated pixels: only
    those that were measured place plane and edges. None with the reason noted where it fails a test of a flange.
    """
    z = np.ascontiguousarray(grid[..., 2], dtype=np.float64)
    valid = np.isfinite(z)
    if (count := int(np.count_nonzero(valid))) < config.min_points:
        refusal.note(0, f"Only {count} valid points lie there; the flange needs {config.min_points}.")
        return None
    rays = _rays(grid, valid)
    try:
        shown = grid if measured is None else np.where(measured[..., None], grid, np.nan)
        plane = _plane(shown, z, rays, center, normal, (standard.face_inner_radius_m + 0.0015, radius - 0.0015), config)
    except PlaneFitError as e:
        refusal.note(1, str(e))
        return None
    if plane.rms > min(config.max_plane_rms_m, max(_FLAT_M, _FLAT_NOISE * _noise(z, rays, plane))):
        refusal.note(1, f"The face is not flat: {1e3 * plane.rms:.2f} mm rms from its plane.")
        return None
    axes = np.column_stack(plane_axes(plane.normal))
    height = thickness(plane)
    w = _window(z, valid, rays, plane, axes, height, measured)
    cx, cy = (center - plane.point) @ axes
    try:
        outer, bore, hidden, pitch = _edges(w, plane, axes, height, (float(cx), float(cy)), radius, standard)
    except CircleFitError as e:
        refusal.note(4, str(e))
        return None
    rho2 = (w.x - outer.center[0]) ** 2 + (w.y - outer.center[1]) ** 2
    return _face(w, rho2, plane, outer, bore, hidden, pitch, standard, config, refusal, grid, axes)


def _rays(grid: Array, valid: Mask) -> tuple[Array, Array]:
    """Viewing rays x/z and y/z (h, w) of every pixel, measured or not."""
    h, w = valid.shape
    step = max(1, int(np.sqrt(h * w / 900.0)))
    part = grid[::step, ::step]
    return RayModel(part, valid[::step, ::step]).grid(np.arange(w) / step, np.arange(h) / step)


def _plane(
    grid: Array,
    z: Array,
    rays: tuple[Array, Array],
    center: Array,
    normal: Array,
    ring: tuple[float, float],
    config: FlangeFitConfig,
) -> PlaneFit:
    """The plane of the pixels that lie on a ring (radii m) about a centre, from at most a few thousand of them."""
    step = max(1, int(np.sqrt(z.size / (2.5 * _PLANE_POINTS))))
    p = grid[::step, ::step].reshape(-1, 3)
    d = p - center
    height = d @ normal
    rho2 = (d * d).sum(axis=1) - height * height
    with np.errstate(invalid="ignore"):
        on = (rho2 > ring[0] ** 2) & (rho2 < ring[1] ** 2) & (np.abs(height) < 4.0 * config.hypothesis_tolerance_m)
    return fit_plane(p[on], (center, normal), tolerance=3.0 * config.hypothesis_tolerance_m)


def _noise(z: Array, rays: tuple[Array, Array], plane: PlaneFit) -> float:
    """Noise (m) of the depth of pixels near a plane, from how they bend over a few pixels."""
    n = plane.normal
    v = slice(None, None, max(1, z.shape[0] // 60))
    d = z[v] * (n[0] * rays[0][v] + n[1] * rays[1][v] + n[2]) - float(n @ plane.point)
    with np.errstate(invalid="ignore"):
        bend = np.abs(d[:, 4:] + d[:, :-4] - 2.0 * d[:, 2:-2])[np.abs(d[:, 2:-2]) < 3.0 * plane.rms]
    bend = bend[np.isfinite(bend)]
    return float(np.median(bend)) * MAD / np.sqrt(6.0) if len(bend) else 0.0


def _window(
    z: Array, valid: Mask, rays: tuple[Array, Array], plane: PlaneFit, axes: Array, height: float, measured: Mask | None
) -> _Window:
    rx, ry = rays
    n, p = plane.normal, plane.point
    slope = n[0] * rx
    slope += n[1] * ry
    slope += n[2]
    along = float(n @ p) / slope
    x, y = (along * (a[0] * rx + a[1] * ry + a[2]) - float(a @ p) for a in axes.T)
    with np.errstate(invalid="ignore"):
        above = z * slope - float(n @ p)
        if measured is not None:
            # between measured pixels the nearest one decides: no slope from a face down to what lies beyond it
            row, column = ndimage.distance_transform_edt(~measured, return_distances=False, return_indices=True)
            above = np.where(valid, above[row, column], np.nan)
            z = (above + float(n @ p)) / slope
        face = np.abs(above) < height
        hidden = above > max(3.0 * height, _BEFORE_M)
    gap = (~valid).view(np.uint8)
    void = cv2.morphologyEx(
        cv2.copyMakeBorder(gap, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=1), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
    )[2:-2, 2:-2]
    known = (valid | (void > 0)) & ~hidden
    return _Window(z=z, rays=rays, x=x, y=y, slope=slope, face=face, known=known, measured=measured)


def _edges(
    w: _Window,
    plane: PlaneFit,
    axes: Array,
    height: float,
    center: tuple[float, float],
    radius: float,
    standard: FlangeStandard,
) -> tuple[CircleFit, CircleFit | None, Mask, float]:
    """Fit the outer edge and the bore (None where it does not show).

    Also returns the directions (sectors,) in which the outer edge is hidden, and the pitch of the pixels on the plane.
    """
    v, u = w.x.shape[0] // 2, w.x.shape[1] // 2
    pitch = float(
        np.sqrt(
            abs(
                (w.x[v, u] - w.x[v, u - 1]) * (w.y[v, u] - w.y[v - 1, u])
                - (w.x[v, u] - w.x[v - 1, u]) * (w.y[v, u] - w.y[v, u - 1])
            )
        )
    )
    points, off, beyond, slide = _crossings(w, plane, axes)
    clear = [clear_band(standard, pitch, True), clear_band(standard, pitch, False)]
    widths = [2.0 * pitch + 0.0012] * 2
    radii = [radius, standard.face_inner_radius_m]
    rims: list[Array] = []
    lowered: list[float] = []
    hidden = [np.zeros(72, dtype=bool)] * 2
    offset = np.array(center)
    for k in range(2):  # the second time about the circles found in the first, and clear of the holes
        d = points - offset
        rho = np.sqrt((d * d).sum(axis=1))
        # the far side of a screw hole and a lone pixel's far side face the wrong way
        outward = (d * off).sum(axis=1)
        rims, lowered = [], []
        for r, width, way, unseen in zip(radii, widths, (outward, -outward), hidden, strict=True):
            near = (np.abs(rho - r) < width) & (way > 0.0)
            if unseen.any():
                near &= ~unseen[_sector(d[:, 0], d[:, 1], len(unseen))]
            low = lowered_by(beyond[near], height, standard.chamfer_m)
            lowered.append(low)
            rims.append(d[near] - low * slide[near])
        if len(rims[0]) < 24:
            raise CircleFitError(f"Too little of an edge {1e3 * standard.outer_m:.0f} mm across is in the scan.")
        seen = 1 + (len(rims[1]) >= 24)
        fits = refine_circles(rims[:seen], radii[:seen], noise_floor=0.1 * pitch)
        if not float(np.hypot(*fits[0].center)) < 3.0 * widths[0] or not 0.5 * radius < fits[0].radius < 2.0 * radius:
            raise CircleFitError("No circle agrees with enough of the points.")
        if k == 0:
            offset = offset + fits[0].center
            near_bore = seen == 2 and abs(fits[1].radius - radii[1]) < widths[1]
            radii = [fits[0].radius, fits[1].radius if near_bore else radii[1]]
            widths = [min(w, max(c, 1.2 * pitch) + low) for w, c, low in zip(widths, clear, lowered, strict=True)]
            hidden = [_hidden_directions(w, offset, radii[k], pitch, clear[k], outer=k == 0) for k in (0, 1)]
    out: list[CircleFit | None] = []
    for k, fit in enumerate(fits):
        start = replace(fit, center=fit.center + offset)
        try:
            out.append(_labelled(w, axes, start, hidden[k], pitch, lowered[k], clear[k], outer=k == 0))
        except CircleFitError:
            if k == 0:
                raise
            out.append(None)
    assert out[0] is not None
    return out[0], out[1] if len(out) > 1 else None, hidden[0], pitch


def _sector(dx: Array, dy: Array, sectors: int) -> NDArray[np.intp]:
    """Return the one of ``sectors`` (N,) in which each direction lies."""
    return ((np.arctan2(dy, dx) + np.pi) * (sectors / (2.0 * np.pi))).astype(np.intp) % sectors


def _hidden_directions(w: _Window, center: Array, radius: float, pitch: float, clear: float, *, outer: bool) -> Mask:
    """Directions (sectors,) in which the face does not show beside an edge, nor anything that lies lower.

    It is hidden, by a cable, a shadow or the image's border, and what looks like an edge there is none.
    """
    way = -1.0 if outer else 1.0
    count = int(np.clip(2.0 * np.pi * radius / (4.0 * pitch), 18, 72))
    low, high = sorted(radius + way * d for d in (pitch, max(2.5 * pitch, min(5.0 * pitch, clear))))
    x, y = w.x - center[0], w.y - center[1]
    rho2 = x * x + y * y
    at = np.flatnonzero((rho2 > low**2) & (rho2 < high**2))
    sector = _sector(x.ravel()[at], y.ravel()[at], count)
    face = w.face.ravel()[at]
    below = w.known.ravel()[at] & ~face & np.isfinite(w.z.ravel()[at])
    total = np.bincount(sector, minlength=count)
    shown, lower = (np.bincount(sector[m], minlength=count) for m in (face, below))
    typical = float(np.median(total[total > 0])) if len(at) else 1.0
    hidden = ((shown < 0.5 * total) | (total < 0.4 * typical)) & (lower <= 0.5 * total)
    # beside a hidden direction a part of the next one often is
    part = shown < 0.9 * np.maximum(total, typical)
    return np.asarray(hidden | ((np.roll(hidden, 1) | np.roll(hidden, -1)) & part))


def _crossings(w: _Window, plane: PlaneFit, axes: Array) -> tuple[Array, Array, Array, Array]:
    """Where the face ends between neighbours that both say something.

    Places (N, 2) m, the step off the face (N, 2) m, how far beyond lies above the plane (N,) m, and how far a place
    moves per metre that the plane is raised (N, 2).
    """
    width = w.x.shape[1]
    across = (w.face[:, 1:] != w.face[:, :-1]) & w.known[:, 1:] & w.known[:, :-1]
    down = (w.face[1:] != w.face[:-1]) & w.known[1:] & w.known[:-1]
    v, u = np.nonzero(across)
    q, r = np.nonzero(down)
    first = np.concatenate([v * width + u, q * width + r])
    second = np.concatenate([v * width + u + 1, (q + 1) * width + r])
    x, y, face, z, slope = (a.ravel() for a in (w.x, w.y, w.face, w.z, w.slope))
    rx, ry = (a.ravel()[first] for a in w.rays)
    on, off = np.where(face[first], first, second), np.where(face[first], second, first)
    ray = np.column_stack([rx, ry, np.ones(len(first))])
    points = 0.5 * np.column_stack([x[first] + x[second], y[first] + y[second]])
    beyond = np.asarray(z[off] * slope[off] - float(plane.normal @ plane.point), dtype=np.float64)
    step = np.column_stack([x[off] - x[on], y[off] - y[on]])
    return points, step, beyond, np.asarray((ray @ axes) / slope[first][:, None])


def _labelled(
    w: _Window, axes: Array, start: CircleFit, hidden: Mask, pitch: float, lowered: float, clear: float, *, outer: bool
) -> CircleFit:
    """Return the edge from the pixels on either side of it. Raises CircleFitError where they do not fix it."""
    x, y = w.x, w.y
    rho2 = (x - start.center[0]) ** 2 + (y - start.center[1]) ** 2
    reach = min(clear, _LABELLED * pitch + 3.0 * float(np.sqrt(np.trace(start.covariance[:2, :2]))))
    at = np.flatnonzero(
        (rho2 > (start.radius - reach - lowered) ** 2) & (rho2 < (start.radius + reach + lowered) ** 2) & w.known
    )
    xy = np.column_stack([x.ravel()[at], y.ravel()[at]])
    if lowered > 0.0:
        ray = np.column_stack([w.rays[0].ravel()[at], w.rays[1].ravel()[at], np.ones(len(at))])
        xy -= lowered * (ray @ axes) / w.slope.ravel()[at][:, None]
        d = xy - start.center
        close = np.abs(np.hypot(d[:, 0], d[:, 1]) - start.radius) < reach
        at, xy = at[close], xy[close]
    if hidden.any():
        seen = ~hidden[_sector(xy[:, 0] - start.center[0], xy[:, 1] - start.center[1], len(hidden))]
        at, xy = at[seen], xy[seen]
    if w.measured is not None:
        # an edge against nothing has a label on one side only, which would pull it
        kept = w.measured.ravel()[at]
        at, xy = at[kept], xy[kept]
        on = w.face.ravel()[at]
        sector = _sector(xy[:, 0] - start.center[0], xy[:, 1] - start.center[1], _LABEL_SECTORS)
        both = (
            np.bincount(sector[on], minlength=_LABEL_SECTORS) * np.bincount(sector[~on], minlength=_LABEL_SECTORS) > 0
        )
        beyond = (rho2 > (start.radius + pitch) ** 2) & (rho2 < (start.radius + 4.0 * pitch) ** 2)
        known = float(np.isfinite(w.z[beyond]).mean()) if outer and beyond.any() else 1.0
        if np.count_nonzero(both) < 0.5 * _LABEL_SECTORS or known < _BEYOND:
            raise CircleFitError("Too few points lie on both sides of the edge.")
        at, xy = at[both[sector]], xy[both[sector]]
    fit = refine_circle(xy, w.face.ravel()[at], start, pitch, outer=outer)
    # a part of a circle leans on each of its pixels: 1.5 to 2 times the variance in simulated half-hidden flanges
    return replace(fit, covariance=_SHARED / max(1.0 - float(hidden.mean()), 0.2) * fit.covariance)


def _face(
    w: _Window,
    rho2: Array,
    plane: PlaneFit,
    outer: CircleFit,
    bore: CircleFit | None,
    hidden: Mask,
    pitch: float,
    standard: FlangeStandard,
    config: FlangeFitConfig,
    refusal: FaceRefusal,
    grid: Array,
    axes: Array,
) -> FlangeFace | None:
    """Return the tests, then the plane once more, of all that proved to be the face."""
    low, high = standard.face_inner_radius_m + 0.5 * pitch, outer.radius - 0.5 * pitch
    ring = (rho2 > low**2) & (rho2 < high**2)
    core = rho2 < (0.7 * standard.bore_radius_m) ** 2
    if hidden.any():  # what is hidden says nothing of the ring and the bore
        seen = ~hidden[_sector(w.x - outer.center[0], w.y - outer.center[1], len(hidden))]
        ring, core = ring & seen, core & seen
    count = int(np.count_nonzero(ring & w.face))
    on_ring = int(np.count_nonzero(ring & w.known))
    said = core & (w.known | np.isfinite(w.z))
    spacing = pitch
    if w.measured is not None:
        spacing *= float(np.sqrt(count / max(int(np.count_nonzero(ring & w.face & w.measured)), 1)))
    measured = FaceMeasurements(
        plane=plane,
        outer=outer,
        bore=bore,
        pitch=spacing,
        coverage=_seen(w, outer, hidden, pitch),
        bore_coverage=0.0 if bore is None else _seen(w, bore, None, pitch),
        count=count,
        # a bore that is hidden is no bore seen, but lone pixels without a return say nothing (half of a dark bore's
        # floor); a ring of which less than half is seen is no ring
        core_share=1.0 - float(np.count_nonzero(core & w.known & ~w.face)) / max(int(np.count_nonzero(said)), 1),
        ring_share=count / max(on_ring, int(_RING_SEEN * np.count_nonzero(ring)), 1),
    )
    face = judge(measured, standard, config, refusal)
    if face is None:
        return None
    if _domed(w, ring, rho2, plane):
        refusal.note(6, "The ring found is domed: it is not the flange.")
        return None
    ring &= w.face
    if w.measured is not None:
        ring &= w.measured
    points = grid[ring]
    try:
        better = fit_plane(points, (plane.point, plane.normal), tolerance=2.0 * thickness(plane))
    except PlaneFitError:
        return face
    better = _honest(better, w, ring)
    # the centres stay on their rays
    shift = [_moved(f.center, plane, better, axes) for f in (outer, bore) if f is not None]
    return replace(
        face,
        plane=better,
        outer=replace(outer, center=shift[0]),
        bore=None if bore is None else replace(bore, center=shift[1]),
        n_points=len(points),
    )


def _seen(w: _Window, circle: CircleFit, hidden: Mask | None, pitch: float) -> float:
    """Share (0..1) of the directions about a circle in which the face shows at it."""
    x, y = w.x - circle.center[0], w.y - circle.center[1]
    rho2 = x * x + y * y
    width = 2.0 * pitch + 0.0005
    at = np.flatnonzero(w.face & (rho2 < (circle.radius + width) ** 2) & (rho2 > (circle.radius - width) ** 2))
    count = 72 if hidden is None else len(hidden)
    shown = np.bincount(_sector(x.ravel()[at], y.ravel()[at], count), minlength=count) > 0
    if hidden is not None:
        shown &= ~hidden
    return float(np.count_nonzero(shown)) / count


def _domed(w: _Window, ring: Mask, rho2: Array, plane: PlaneFit) -> bool:
    """Does a ring (h, w) bulge, as that part of a ball does which lies near a plane?"""
    s = _thin(ring)
    on = ring[s] & w.face[s]
    above, far = (w.z[s] * w.slope[s])[on] - float(plane.normal @ plane.point), rho2[s][on]
    inner = far < np.median(far)
    return abs(float(above[inner].mean() - above[~inner].mean())) > max(_FLAT_M, _DOMED * plane.rms)


def _thin(ring: Mask) -> tuple[slice, slice]:
    """Return every k-th pixel along rows and columns, so that some thousands of the ring remain."""
    step = slice(None, None, max(1, int(np.sqrt(np.count_nonzero(ring) / _PLANE_POINTS) + 0.5)))
    return step, step


def _honest(plane: PlaneFit, w: _Window, ring: Mask) -> PlaneFit:
    """Return the plane with its spread when neighbouring pixels share their noise, from a sample of pixels."""
    s = _thin(ring)
    n = plane.normal
    at = np.flatnonzero(ring[s])
    slope = n[0] * w.rays[0][s].ravel()[at] + n[1] * w.rays[1][s].ravel()[at] + n[2]
    e = w.z[s].ravel()[at] * slope - float(n @ plane.point)
    good = np.abs(e) < 4.0 * plane.rms
    shared = shared_noise(e * good, good, at, ring[s].shape) * plane.n_inliers / max(int(np.count_nonzero(good)), 1)
    shared = max(shared, 1.0)
    return replace(
        plane, n_inliers=int(plane.n_inliers / shared), normal_sigma=plane.normal_sigma * float(np.sqrt(shared))
    )


def _moved(center: Array, old: PlaneFit, new: PlaneFit, axes: Array) -> Array:
    """Return a centre (2,) on one plane, along its ray onto another, in that one's axes."""
    p = old.point + axes @ center
    p = p * (float(new.normal @ new.point) / float(new.normal @ p))
    return np.asarray((p - new.point) @ np.column_stack(plane_axes(new.normal)))
