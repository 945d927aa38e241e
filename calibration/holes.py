"""The hole pattern of a flange: the rotation about its axis that circles cannot show, and a ruler the maker drilled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import cKDTree

from weldcal.calibration.circle import fit_circle
from weldcal.calibration.errors import CircleFitError
from weldcal.calibration.flange_fit import FlangeFit
from weldcal.calibration.rim import plane_axes, sector_edges
from weldcal.models.flanges import FlangeStandard

Array = NDArray[np.float64]

_LEAST_HOLES = 4  # of a pattern: three would fit a wrong phase too easily
_COARSEST = 0.25  # pitch between points over the hole's diameter above which a hole has no edge
_COUNTERSINK_M = 0.0013  # a hole shows the end of its countersink, so much wider than the thread at most
_THIN_M = 0.00025  # of the face about its plane: what lies lower is countersink or thread
_OFF_M = 0.0004  # from its place in the pattern: such a hole is a dent or a gap in the scan


@dataclass(frozen=True)
class HolePattern:
    """Holes found in a flange's face: their centres (k, 3) m in the camera frame, their angles (k,) rad in the standard,
    the circle centre (3,) m they fix, the flange's pose X_CR with the rotation about its axis, and how the pitch circle
    measures against the standard (1 where the scanner's scale is right)."""

    holes_C: Array
    angles_rad: Array
    center_C: Array
    X_CR: RigidTransform
    ratio: float
    rms_m: float


def find_holes(points_C: Array, fit: FlangeFit, standard: FlangeStandard) -> HolePattern | None:
    """The hole pattern in the face of a fitted flange; None where fewer than four holes of it are seen well.

    ``points_C`` (N, 3) or (H, W, 3) m. The phase is where the pattern's discs hold the fewest points of the face; each
    hole's rim is a circle, with one radius for all threads in the end, and the pattern is a similarity of the centres
    (Umeyama 1991 in the plane). Deterministic.
    """
    angles = np.array([*standard.hole_angles_rad, *([standard.pin_angle_rad] if standard.pin_m > 0.0 else [])])
    if len(angles) < _LEAST_HOLES:
        return None
    axes = np.column_stack(plane_axes(fit.normal_C))
    xy = _face(np.asarray(points_C, dtype=float), fit, standard, axes)
    if len(xy) < 100:
        return None
    tree = cKDTree(xy)
    pitch = float(np.median(np.asarray(tree.query(xy[:: max(1, len(xy) // 200)], k=5)[0])[:, -1]))
    if pitch > _COARSEST * standard.hole_m:
        return None
    phase = _phase(tree, angles, standard)
    if phase is None:
        return None
    place = 0.5 * standard.pitch_circle_m
    nominal = 0.5 * np.array([standard.hole_m] * standard.n_holes + [standard.pin_m] * (len(angles) - standard.n_holes))
    z, seen = np.zeros(0, dtype=complex), np.zeros(0, dtype=int)
    start, gain = 0j, complex(place * np.exp(1j * phase))
    threads: float | None = None
    for _ in range(3):
        found = []
        for k, a in enumerate(angles):
            c = start + gain * np.exp(1j * a)
            hole = _hole(
                xy, np.array([c.real, c.imag]), float(nominal[k]), pitch, threads if k < standard.n_holes else None
            )
            if hole is not None:
                found.append((k, complex(*hole[0]), hole[1]))
        if len(found) < _LEAST_HOLES:
            return None
        seen, z = np.array([f[0] for f in found]), np.array([f[1] for f in found])
        start, gain = _similarity(z, angles[seen])
        off = np.abs(z - start - gain * np.exp(1j * angles[seen]))
        keep = off < _OFF_M
        if int(keep.sum()) < _LEAST_HOLES:
            return None
        if not keep.all():
            seen, z, found = seen[keep], z[keep], [f for f, k in zip(found, keep, strict=True) if k]
            start, gain = _similarity(z, angles[seen])
        threads = float(np.median([f[2] for f in found if f[0] < standard.n_holes]))
    off = np.abs(z - start - gain * np.exp(1j * angles[seen]))
    center = fit.center_C + axes @ np.array([start.real, start.imag])
    turn = gain / abs(gain)
    x = axes @ np.array([turn.real, turn.imag])
    R = RotationMatrix.ProjectToRotationMatrix(np.column_stack([x, np.cross(fit.normal_C, x), fit.normal_C]))
    return HolePattern(
        holes_C=fit.center_C + np.column_stack([z.real, z.imag]) @ axes.T,
        angles_rad=angles[seen],
        center_C=center,
        X_CR=RigidTransform(R, fit.center_C),
        ratio=float(abs(gain) / place),
        rms_m=float(np.sqrt(np.mean(off**2))),
    )


def _face(points: Array, fit: FlangeFit, standard: FlangeStandard, axes: Array) -> Array:
    """Face points (N, 2) about the fitted centre."""
    flat = points.reshape(-1, 3)
    d = flat[np.isfinite(flat).all(axis=1)] - fit.center_C
    with np.errstate(invalid="ignore"):
        thin = np.abs(d @ fit.normal_C) < max(3.0 * fit.plane_rms_m, _THIN_M)
    xy = d[thin] @ axes
    return np.asarray(xy[np.hypot(xy[:, 0], xy[:, 1]) < standard.outer_radius_m])


def _phase(tree: cKDTree, angles: Array, standard: FlangeStandard) -> float | None:
    """Rotation (rad) of the standard's pattern, in the plane's axes, at which its holes are emptiest; None without one."""
    turns = np.radians(np.arange(0.0, 360.0, 1.0))
    place, disc = 0.5 * standard.pitch_circle_m, 0.35 * standard.hole_m
    ring = place * np.column_stack([np.cos(turns), np.sin(turns)])
    count = np.asarray(tree.query_ball_point(ring, disc, return_length=True), dtype=float)
    at = (np.arange(360)[None] + np.round(np.degrees(angles)).astype(int)[:, None]) % 360
    # a plugged hole counts as face, however dense its plug
    total = np.minimum(count, np.median(count))[at].sum(axis=0)
    best = int(np.argmin(total))
    # a face without holes, or too thin a scan of one, has no phase that stands out
    if total[best] > 0.25 * float(np.median(total)) or float(np.median(count)) < 10.0:
        return None
    # the counts are zero over a stretch of phases: its middle, along the circle
    low = np.nonzero(total <= total[best] + 0.02 * float(np.median(total)))[0]
    low = low[np.abs((low - best + 180) % 360 - 180) < 8]
    return float(np.radians(best + np.mean((low - best + 180) % 360 - 180)))


def _hole(xy: Array, near: Array, nominal: float, pitch: float, radius: float | None) -> tuple[Array, float] | None:
    """Centre (2,) and radius of one hole near its expected place; None where its rim is not seen all round."""
    c, r = near, nominal + 0.5 * _COUNTERSINK_M if radius is None else radius
    try:
        for _ in range(3):
            rim = sector_edges(xy, c, pitch, outer=False, band=(0.4 * nominal, nominal + 2.0 * _COUNTERSINK_M))
            circle = fit_circle(rim, initial=(c, r), noise_floor=0.1 * pitch, radius=radius)
            c, r = circle.center, circle.radius
    except CircleFitError:
        return None
    wide = 0.8 * nominal < r < nominal + _COUNTERSINK_M
    if not wide or float(np.linalg.norm(c - near)) > nominal or int(circle.inliers.sum()) < 17:
        return None
    return c, r


def _similarity(z: NDArray[np.complex128], angles: Array) -> tuple[complex, complex]:
    """Shift and gain (complex numbers are points of the plane) that take the unit circle's points at ``angles`` to z."""
    M = np.column_stack([np.ones(len(z)), np.exp(1j * angles)])
    shift, gain = np.linalg.lstsq(M, z, rcond=None)[0]
    return complex(shift), complex(gain)
