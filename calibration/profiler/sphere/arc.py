"""Finds the arc of a sphere in a profile and fits its circle."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weldcal.calibration.errors import ArcNotFound
from weldcal.calibration.profiler.motion import Floats
from weldcal.models.errors import InputError

TRIPLES = 600
MINIMUM_SAMPLES = 12
GAP_SAMPLES = 6  # without support that end an arc
ROUNDS = 10
_NONE: NDArray[np.intp] = np.empty(0, dtype=np.intp)


def fit_circle(points: ArrayLike) -> tuple[Floats, float]:
    """Circle [x, z, r] m by least squares of the radial distances (n, 2), and the rms of these in m."""
    p = np.asarray(points, float)
    mean = p.mean(axis=0)
    u = p - mean
    # algebraic start: u.u = 2 u.c + (r^2 - c.c)
    s = np.linalg.lstsq(np.column_stack([2.0 * u, np.ones(len(u))]), np.einsum("ni,ni->n", u, u), rcond=None)[0]
    c, r = s[:2], float(np.sqrt(max(s[2] + s[:2] @ s[:2], 1e-18)))
    for _ in range(ROUNDS):
        off = u - c
        distance = np.maximum(np.linalg.norm(off, axis=1), 1e-12)
        J = np.column_stack([off / distance[:, None], np.ones(len(u))])
        step = np.linalg.lstsq(J, distance - r, rcond=None)[0]
        c, r = c + step[:2], r + float(step[2])
        if np.abs(step).max() < 1e-12:
            break
    residual = np.linalg.norm(u - c, axis=1) - r
    return np.array([*(c + mean), r]), float(np.sqrt(np.mean(residual**2)))


def find_arc(
    profile: ArrayLike, radius_m: float, *, tolerance_m: float = 0.15e-3, seed: int = 0
) -> tuple[NDArray[np.bool_], Floats, float]:
    """Find the samples of a profile (n, 2) [x, z] m on the sphere, the circle [x, z, r] m through them, and its rms m.

    A circle of a larger radius than the sphere's cannot be a cut of it, and the sensor sees one side of it only. Random
    triples of neighbouring samples (seeded), then the longest run of samples that agree.

    Raises:
        ArcNotFound: no such arc. InputError: not a profile.
    """
    p = np.asarray(profile, float)
    if p.ndim != 2 or p.shape[1] != 2:
        raise InputError(f"A profile is an array (n, 2) of [x, z], not {p.shape}.")
    seen = np.flatnonzero(np.isfinite(p).all(axis=1))
    q = p[seen]
    if len(q) < MINIMUM_SAMPLES:
        raise ArcNotFound(f"The profile has {len(q)} returns only: bring the sphere into the scanner's range.")
    rng = np.random.default_rng(seed)
    span = rng.integers(MINIMUM_SAMPLES - 1, max(len(q) // 2, MINIMUM_SAMPLES), TRIPLES)
    first = (rng.random(TRIPLES) * (len(q) - span).clip(1)).astype(int)
    last = np.minimum(first + span, len(q) - 1)
    best = _NONE
    for circle in _through(q[first], q[(first + last) // 2], q[last]):
        if not (np.isfinite(circle).all() and 0.05 * radius_m < circle[2] < 1.05 * radius_m):
            continue
        best = _run(q, circle, tolerance_m, best)
    if len(best) < MINIMUM_SAMPLES:
        raise ArcNotFound("The profile shows no arc of the sphere: move until the laser line crosses it.")
    for _ in range(ROUNDS):
        circle, rms = fit_circle(q[best])
        run = _run(q, circle, max(tolerance_m, 4.0 * rms))
        if len(run) == len(best) and (run == best).all():
            break
        if len(run) < MINIMUM_SAMPLES:
            break
        best = run
    circle, rms = fit_circle(q[best])
    mask = np.zeros(len(p), bool)
    mask[seen[best]] = True
    return mask, circle, rms


def _through(a: Floats, b: Floats, c: Floats) -> Floats:
    """Circles (n, 3) through three points each (n, 2)."""
    u, v = b - a, c - a
    d = 2.0 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    uu, vv = np.einsum("ni,ni->n", u, u), np.einsum("ni,ni->n", v, v)
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = np.column_stack([v[:, 1] * uu - u[:, 1] * vv, u[:, 0] * vv - v[:, 0] * uu]) / d[:, None]
    return np.column_stack([a + centre, np.linalg.norm(centre, axis=1)])


def _run(q: Floats, circle: Floats, tolerance_m: float, longest: NDArray[np.intp] = _NONE) -> NDArray[np.intp]:
    """The longest stretch of samples on one side of a circle (z may grow to or from the sensor), bridging short gaps.

    Where none is longer than ``longest``, that one.
    """
    x, z = q[:, 0] - circle[0], q[:, 1] - circle[1]
    near = np.abs(np.sqrt(x * x + z * z) - circle[2]) < tolerance_m
    for side in (z < 0.0, z > 0.0):
        good = (near & side).nonzero()[0]
        if good.size > longest.size:
            pieces = np.split(good, np.flatnonzero(np.diff(good) > GAP_SAMPLES) + 1)
            longest = max([longest, *pieces], key=len)
    return longest
