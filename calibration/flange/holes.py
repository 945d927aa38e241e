"""Finds the hole pattern of a flange: its rotation about the flange axis and the scale of its pitch circle."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.errors import CircleFitError
from weldcal.calibration.flange.face import plane_axes
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.search import typical_pitches, window_about
from weldcal.calibration.geometry.primitives import CircleFit, refine_circles
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

_LEAST_HOLES = 4  # of a pattern: three would fit a wrong phase too easily
_LEAST_EDGES = 17  # of a hole's 24 sectors
_SECTORS = 24
_COARSEST = 0.25  # pitch between points over the hole's diameter above which a hole has no edge
_COUNTERSINK_M = 0.0013  # a hole shows the end of its countersink, so much wider than the thread at most
_THIN_M = 0.00025  # of the face about its plane: what lies lower is countersink or thread
_PHASES = 12  # that are tried
_OFF_M = 0.0004  # from its place in the pattern: such a hole is a dent or a gap in the scan


@dataclass(frozen=True, kw_only=True)
class HolePattern:
    """Holes detected in a flange's face, and the circle and pose that they fix.

    ``holes_C`` (k, 3) m are their centres in the camera frame, ``center_C`` (3,) m that of the circle, ``X_CR`` the
    flange's pose with the rotation about its axis. ``ratio`` is the pitch circle as measured over the standard's: 1
    where the scanner's scale is right.

    ``rms_m`` is the root mean square of how far the holes lie from their places in the pattern.
    ``turn_sigma`` rad is the spread of the rotation about the axis and ``covariance`` (6, 6) that of X_CR, rotation
    then translation, in the camera's axes. Both cover this scan's noise and how well the holes agree.
    ``other_turns_rad`` are rotations about the axis, from that of X_CR, under which the scan shows the pattern as well
    (the threads alone are symmetric; the dowel hole decides): the spread then covers all of them, and ``turn_known`` is
    false.
    """

    holes_C: Array
    center_C: Array
    X_CR: RigidTransform
    ratio: float
    rms_m: float
    turn_sigma: float = float("nan")
    covariance: Array | None = None
    other_turns_rad: tuple[float, ...] = ()

    @property
    def turn_known(self) -> bool:
        """Whether the scan shows one rotation about the axis only."""
        return not self.other_turns_rad


def find_holes(points_C: Array, fit: FlangeFit, standard: FlangeStandard) -> HolePattern | None:
    """Find the hole pattern in the face of a fitted flange; None where fewer than four of its holes are clear.

    ``points_C`` (N, 3) or (H, W, 3) m. The phase is where the pattern's discs hold the fewest points of the face and
    have rims: slots are as empty as holes. Each hole's rim is a circle, with one radius for all threads in the end, and
    the pattern is a similarity of the centres (Umeyama 1991 in the plane). Deterministic.
    """
    angles = np.array([*standard.hole_angles_rad, *([standard.pin_angle_rad] if standard.pin_m > 0.0 else [])])
    if len(angles) < _LEAST_HOLES:
        return None
    axes = np.column_stack(plane_axes(fit.normal_C))
    xy = _face(points_C, fit, standard, axes)
    if xy is None or xy.shape[1] < 100:
        return None
    solid = standard.outer_radius_m**2 - standard.bore_radius_m**2 - sum(r * r for _, _, r in standard.openings())
    pitch = float(np.sqrt(np.pi * solid / xy.shape[1]))
    if pitch > _COARSEST * standard.hole_m:
        return None
    found: list[tuple[NDArray[np.intp], NDArray[np.complex128], Array, complex, complex]] = []
    for phase in _phases(xy, angles, standard):
        placed = _placed(xy, angles, phase, standard, pitch)
        found += [] if placed is None else [placed]
        if placed is not None and len(placed[0]) == len(angles):
            break
    if not found:
        return None
    seen, z, covariances, start, gain = max(found, key=lambda p: len(p[0]))
    place = 0.5 * standard.pitch_circle_m
    off = z - start - gain * np.exp(1j * angles[seen])
    turn_sigma = _turn_sigma(off, gain, angles[seen], covariances)
    others = _other_turns(xy, start, gain, standard, seen, pitch)
    if others:  # equally likely rotations: their spread about the one reported
        turn_sigma = float(np.sqrt(turn_sigma**2 + np.sum(np.square(others)) / (len(others) + 1)))
    n = fit.normal_C
    turn = gain / abs(gain)
    x = axes @ np.array([turn.real, turn.imag])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = fit.normal_sigma**2 * (np.eye(3) - np.outer(n, n)) + turn_sigma**2 * np.outer(n, n)
    covariance[3:, 3:] = fit.center_covariance
    return HolePattern(
        holes_C=fit.center_C + np.column_stack([z.real, z.imag]) @ axes.T,
        center_C=fit.center_C + axes @ np.array([start.real, start.imag]),
        X_CR=RigidTransform(
            RotationMatrix.ProjectToRotationMatrix(np.column_stack([x, np.cross(n, x), n])), fit.center_C
        ),
        ratio=float(abs(gain) / place),
        rms_m=float(np.sqrt(np.mean(np.abs(off) ** 2))),
        turn_sigma=turn_sigma,
        covariance=covariance,
        other_turns_rad=others,
    )


def _face(points: Array, fit: FlangeFit, standard: FlangeStandard, axes: Array) -> Array | None:
    """Face points (2, N) m about the fitted centre."""
    cloud: Array | None = np.asarray(points)
    assert cloud is not None
    reach = standard.outer_radius_m
    if cloud.ndim == 3:
        pitches = typical_pitches(cloud)
        step = 1 if pitches is None else max(1, int(reach / (6.0 * pitches[0])))
        part = window_about(cloud, fit.center_C, 1.1 * reach, step)
        cloud = None if part is None else cloud[part]
        if cloud is None:
            return None
    flat = np.ascontiguousarray(cloud.reshape(-1, 3).T) - np.asarray(fit.center_C)[:, None]
    x, y, d = np.column_stack([axes, fit.normal_C]).T @ flat
    with np.errstate(invalid="ignore"):
        rho2 = x * x + y * y
        on = np.flatnonzero(
            (np.abs(d) < max(3.0 * fit.plane_rms_m, _THIN_M)) & (rho2 < reach**2) & (rho2 > standard.bore_radius_m**2)
        )
    return np.array([x[on], y[on]])


def _placed(
    xy: Array, angles: Array, phase: float, standard: FlangeStandard, pitch: float
) -> tuple[NDArray[np.intp], NDArray[np.complex128], Array, complex, complex] | None:
    """The holes at a phase (rad): which ones, their centres, covariances (k, 2, 2) m^2, shift and gain of the pattern.

    None where fewer than four have a rim at their places.
    """
    nominal = 0.5 * np.array([standard.hole_m] * standard.n_holes + [standard.pin_m] * (len(angles) - standard.n_holes))
    start, gain = 0j, complex(0.5 * standard.pitch_circle_m * np.exp(1j * phase))
    near = _about(xy, start + gain * np.exp(1j * angles), nominal)
    threads: float | None = None
    for k in range(3):
        expected = start + gain * np.exp(1j * angles)
        found = _holes(near, expected, nominal, standard.n_holes, pitch, threads, passes=3 if k == 0 else 2)
        if len(found) < _LEAST_HOLES:
            return None
        seen, z = np.array(list(found)), np.array([complex(*c.center) for c in found.values()])
        radii = np.array([c.radius for c in found.values()])
        covariances = np.array([c.covariance[:2, :2] for c in found.values()])
        start, gain = _similarity(z, angles[seen])
        while True:  # the worst goes first: it drags the others off their places
            off = np.abs(z - start - gain * np.exp(1j * angles[seen]))
            worst = int(np.argmax(off))
            if off[worst] < _OFF_M:
                break
            if len(seen) == _LEAST_HOLES:
                return None
            seen, z, radii, covariances = (np.delete(a, worst, axis=0) for a in (seen, z, radii, covariances))
            start, gain = _similarity(z, angles[seen])
        threads = float(np.median(radii[seen < standard.n_holes]))
    return seen, z, covariances, start, gain


def _phases(xy: Array, angles: Array, standard: FlangeStandard) -> list[float]:
    """Return the rotations (rad) of the standard's pattern at which its holes are emptiest, the emptiest first.

    They are in the plane's axes.
    """
    place, disc = 0.5 * standard.pitch_circle_m, 0.35 * standard.hole_m
    rho = np.sqrt(xy[0] * xy[0] + xy[1] * xy[1])
    ring = np.flatnonzero(np.abs(rho - place) < disc)
    rho = rho[ring]
    at = np.degrees(np.arctan2(xy[1, ring], xy[0, ring])) + 720.0
    # a point lies in the discs about so much of the pitch circle to either side
    half = np.degrees(np.arccos(np.clip((rho * rho + place**2 - disc**2) / (2.0 * place * rho), -1.0, 1.0)))
    enters = np.bincount(np.ceil(at - half).astype(int), minlength=1500)
    leaves = np.bincount(np.floor(at + half).astype(int) + 1, minlength=1500)
    count = np.cumsum(enters - leaves)[360:1440].reshape(3, 360).sum(axis=0).astype(float)
    at_hole = (np.arange(360)[None] + np.round(np.degrees(angles)).astype(int)[:, None]) % 360
    # a plugged hole counts as face, however dense its plug
    total = np.minimum(count, np.median(count))[at_hole].sum(axis=0)
    # a face without holes, or too thin a scan of one, has no phase that stands out
    limit = 0.6 * float(np.median(total))
    if float(np.median(count)) < 10.0:
        return []
    phases: list[float] = []
    left = total.copy()
    while len(phases) < _PHASES and left.min() <= limit:
        best = int(np.argmin(left))
        # the counts are zero over a stretch of phases: its middle, along the circle
        low = np.nonzero(left <= total[best] + 0.02 * float(np.median(total)))[0]
        low = low[np.abs((low - best + 180) % 360 - 180) < 8]
        phases.append(float(np.radians(best + np.mean((low - best + 180) % 360 - 180))))
        left[np.abs((np.arange(360) - best + 180) % 360 - 180) < 8] = np.inf
    return phases


def _other_turns(
    xy: Array, start: complex, gain: complex, standard: FlangeStandard, seen: NDArray[np.intp], pitch: float
) -> tuple[float, ...]:
    """Rotations (rad, -pi to pi) that take the threads onto themselves and that the dowel hole does not exclude.

    It excludes one only if its rim is seen where the pattern has it, and no such rim where the rotation would have it.
    """
    threads = np.exp(1j * np.asarray(standard.hole_angles_rad))
    turns = [
        float(np.angle(t))
        for t in threads[1:] / threads[0]
        if float(np.abs(threads[:, None] * t - threads).min(axis=1).max()) < 1e-3
    ]
    if standard.n_holes not in seen:  # the dowel hole is the last of the openings
        return tuple(turns)
    places = start + gain * np.exp(1j * (standard.pin_angle_rad + np.array(turns)))
    nominal = np.full(len(turns), 0.5 * standard.pin_m)
    found = _holes(_about(xy, places, nominal), places, nominal, 0, pitch, None, passes=3) if turns else {}
    return tuple(t for k, t in enumerate(turns) if k in found and abs(complex(*found[k].center) - places[k]) < _OFF_M)


def _about(xy: Array, expected: NDArray[np.complex128], nominal: Array) -> list[Array]:
    """Return the face points (2, N_k) m about each expected hole."""
    out = []
    for c, r in zip(expected, nominal, strict=True):
        x, y = xy[0] - c.real, xy[1] - c.imag
        at = np.flatnonzero(x * x + y * y < (2.0 * float(r) + 2.0 * _COUNTERSINK_M) ** 2)
        out.append(xy[:, at])
    return out


def _holes(
    near: list[Array],
    expected: NDArray[np.complex128],
    nominal: Array,
    n_threads: int,
    pitch: float,
    threads: float | None,
    *,
    passes: int,
) -> dict[int, CircleFit]:
    """Circles of the holes near their expected places, by their number.

    Those whose rim is not seen all round are left out. ``threads`` is the radius of all threaded ones, where it is
    known already.
    """
    sizes = [a.shape[1] for a in near]
    hole = np.repeat(np.arange(len(near)), sizes)
    points = np.concatenate(near, axis=1)
    least, most = (0.4 * nominal)[hole], (nominal + 2.0 * _COUNTERSINK_M)[hole]
    center = np.array([expected.real, expected.imag])
    radius = nominal + 0.5 * _COUNTERSINK_M
    if threads is not None:
        radius = np.where(np.arange(len(near)) < n_threads, threads, radius)
    out: dict[int, CircleFit] = {}
    for _ in range(passes):
        d = points - center[:, hole]
        rho = np.sqrt(d[0] * d[0] + d[1] * d[1])
        band = np.flatnonzero((rho > least) & (rho < most))
        x, y, r = d[0, band], d[1, band], rho[band]
        sector = ((np.arctan2(y, x) + np.pi) * (_SECTORS / (2.0 * np.pi))).astype(np.intp) % _SECTORS
        cell = hole[band] * _SECTORS + sector
        first = np.full(len(near) * _SECTORS, np.inf)
        np.minimum.at(first, cell, r)
        rim = np.flatnonzero(r == first[cell])
        of = hole[band][rim]
        able = [k for k in range(len(near)) if int(np.count_nonzero(of == k)) >= _LEAST_EDGES]
        if not able:
            return {}
        edges = [np.column_stack([x[rim[of == k]], y[rim[of == k]]]) for k in able]
        fixed = None if threads is None else np.array([k < n_threads for k in able])
        try:
            fits = refine_circles(edges, radius[able].tolist(), noise_floor=0.1 * pitch, fixed=fixed)
        except CircleFitError:
            return {}
        out = {}
        for k, f in zip(able, fits, strict=True):
            center[:, k] += f.center
            radius[k] = f.radius
            wide = 0.8 * nominal[k] < f.radius < nominal[k] + _COUNTERSINK_M
            stays = float(np.hypot(center[0, k] - expected[k].real, center[1, k] - expected[k].imag)) < nominal[k]
            if not stays:
                center[:, k] = expected[k].real, expected[k].imag
            if wide and stays and f.rms < pitch and int(f.inliers.sum()) >= _LEAST_EDGES:
                out[k] = CircleFit(center[:, k].copy(), f.radius, f.covariance, f.rms, f.inliers)
    return out


def _similarity(z: NDArray[np.complex128], angles: Array) -> tuple[complex, complex]:
    """Fit the shift and gain that take the unit circle's points at ``angles`` to z.

    Complex numbers are points of the plane.
    """
    M = np.column_stack([np.ones(len(z)), np.exp(1j * angles)])
    shift, gain = np.linalg.lstsq(M, z, rcond=None)[0]
    return complex(shift), complex(gain)


def _turn_sigma(off: NDArray[np.complex128], gain: complex, angles: Array, covariances: Array) -> float:
    """Spread (rad) of the pattern's rotation.

    The holes' own covariances (k, 2, 2) through the similarity, inflated where the holes lie farther off their places
    than those allow (Birge ratio, never below one).
    """
    k = len(off)
    a = np.exp(1j * angles)
    J = np.zeros((2 * k, 4))  # shift x, y, gain real, imaginary
    J[0::2, 0] = J[1::2, 1] = 1.0
    J[0::2, 2], J[0::2, 3], J[1::2, 2], J[1::2, 3] = a.real, -a.imag, a.imag, a.real
    S = np.zeros((2 * k, 2 * k))
    for i, c in enumerate(covariances):
        S[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = c
    inverse = np.linalg.pinv(J)
    e = np.column_stack([off.real, off.imag]).ravel()
    ratio = float(e @ np.linalg.solve(S, e)) / (2 * k - 4)
    along = np.array([-gain.imag, gain.real]) / abs(gain) ** 2  # of the gain's change: the turn
    variance = along @ (inverse @ S @ inverse.T)[2:, 2:] @ along
    return float(np.sqrt(variance * max(1.0, ratio)))
