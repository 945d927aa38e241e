"""Finds the parallel faces of a step target in a raw profile, and the gradient of the target's height in it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.profiler.motion import Floats
from weldcal.calibration.profiler.returns import returns_of

MINIMUM_SAMPLES = 15  # of each face: half of a face of 3 mm at a pitch of 0.1 mm
WINDOWS, WINDOW = 12, 0.08  # places where a face is sought, and their length as a share of the samples
LEAST_TOLERANCE_M = 0.05e-3  # a choice: noise of a good profiler of this range
MOST_TOLERANCE = 0.1  # a choice, of the least step: a fifth of it is between two faces
SIGMAS = 4.0  # of the noise, within which a sample belongs to a line
SHORT, LONG = 0.6, 1.1  # a step's height in a profile over its own: 50 deg of tilt, and a sensor that is 10 % off
RATIOS = 101  # between them: each is 0.5 % from the next
ENDS = 2  # samples at each end of a face that may be mixed with the next one
TUKEY = 4.0  # as in groove.py
ROUNDS = 10


@dataclass(frozen=True, eq=False)
class StepFaces:
    """The target's height in one profile is ``gradient`` (2,) . [x, z], plus a constant; `covariance` (2, 2) of it.

    The gradient has no unit: metres of height for each metre in the profile. Its z is below 0: height grows upwards
    where z grows away from the sensor. ``faces`` (n,) are numbers of the heights shown.
    """

    gradient: Floats
    covariance: Floats
    faces: NDArray[np.intp]


def step_faces(profile: ArrayLike, heights_m: Floats) -> StepFaces:
    """Find faces at known heights (k,) m, rising along the normal, in a profile (n, 2) [x, z] m.

    Raises:
        FeatureNotFound: fewer than two of the faces. InputError: not a profile.
    """
    p = returns_of(profile, 2 * MINIMUM_SAMPLES, "step")
    width = max(MINIMUM_SAMPLES, int(WINDOW * len(p)))
    best: tuple[int, Floats, NDArray[np.intp]] | None = None
    for start in np.linspace(0, len(p) - width, WINDOWS).astype(int):
        n, tolerance = _grown(p, p[start : start + width])
        if tolerance > MOST_TOLERANCE * np.diff(heights_m).min():  # the window lies across a step
            continue
        label = _labels(p @ n, float(np.median(p[start : start + width] @ n)), heights_m, tolerance)
        faces, counts = np.unique(label[label >= 0], return_counts=True)
        shown = faces[counts >= MINIMUM_SAMPLES]
        score = int(np.sum(np.isin(label, shown)))
        if len(shown) > 1 and (best is None or score > best[0]):
            best = score, n, np.where(np.isin(label, shown), label, -1)
    if best is None:
        steps = ", ".join(f"{1e3 * h:.4g}" for h in np.diff(heights_m))
        raise FeatureNotFound(
            f"The profile shows no two parallel faces {steps} mm apart: let the laser line cross the step."
        )
    return _fitted(p, *best[1:], heights_m)


def _line(p: Floats) -> tuple[Floats, float]:
    """Unit normal (2,) with z < 0 of the line through points (n, 2), and a robust sigma across it."""
    centred = p - p.mean(axis=0)
    n = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    return -n if n[1] > 0.0 else n, MAD * float(np.median(np.abs(centred @ n)))


def _grown(p: Floats, window: Floats) -> tuple[Floats, float]:
    """Return the normal (2,) of the face that begins with a window of its samples, and the tolerance across it."""
    n, sigma = _line(window)
    tolerance = max(SIGMAS * sigma, LEAST_TOLERANCE_M)
    middle = window
    for _ in range(3):
        near = np.abs(p @ n - np.median(middle @ n)) < tolerance
        if near.sum() < MINIMUM_SAMPLES:
            break
        middle = p[near]
        n, _ = _line(middle)
    return n, tolerance


def _labels(across: Floats, at: float, heights_m: Floats, tolerance: float) -> NDArray[np.intp]:
    """Number (n,) of the face at which each sample lies, -1 for none, if one of the faces lies at ``at``."""
    order = np.sort(across)
    apart = (heights_m[None, :] - heights_m[:, None])[None] * np.linspace(SHORT, LONG, RATIOS)[:, None, None]
    places = at + apart.reshape(-1, len(heights_m))
    count = np.searchsorted(order, places + tolerance) - np.searchsorted(order, places - tolerance)
    off = np.abs(across[:, None] - places[int(np.argmax(count.sum(axis=1)))])
    return np.where(off.min(axis=1) < tolerance, off.argmin(axis=1), -1)


def _fitted(p: Floats, n: Floats, label: NDArray[np.intp], heights_m: Floats) -> StepFaces:
    """Fit one direction and one ratio of heights to all faces, by Tukey's weights."""
    inside = np.ones(len(p), bool)
    for k in range(1, ENDS + 1):
        inside[k:] &= label[k:] == label[:-k]
        inside[:-k] &= label[:-k] == label[k:]
    inside &= label >= 0
    shown = np.array([k for k in range(len(heights_m)) if (label[inside] == k).sum() >= MINIMUM_SAMPLES // 2])
    if len(shown) < 2:
        raise FeatureNotFound("The faces of the step are too short in the profile: come closer, or let it lie across.")
    inside &= np.isin(label, shown)
    u, h = p[inside] - p[inside].mean(axis=0), heights_m[label[inside]]
    h = h - h.mean()
    weight, ratio, offset = np.ones(len(u)), 1.0, 0.0
    for k in range(ROUNDS):
        along = np.array([n[1], -n[0]])  # d n / d angle
        J = np.column_stack([u @ along, -np.ones(len(u)), -h])
        r = u @ n - offset - ratio * h
        root = np.sqrt(weight)
        turn, more, longer = np.linalg.lstsq(root[:, None] * J, -root * r, rcond=None)[0]
        n = np.cos(turn) * n + np.sin(turn) * along
        offset, ratio = offset + more, ratio + longer
        r = u @ n - offset - ratio * h
        sigma = max(MAD * float(np.median(np.abs(r))), 1e-9)
        weight = np.clip(1.0 - (r / (TUKEY * sigma)) ** 2, 0.0, None) ** 2 if k else weight
    along = np.array([n[1], -n[0]])
    # of Tukey's estimate at 4 sigma, as in groove.py
    spread = sigma**2 * float((weight**2).mean() / weight.mean())
    C = np.linalg.inv(J.T @ (weight[:, None] * J))[np.ix_([0, 2], [0, 2])] * spread
    by = np.column_stack([along / ratio, -n / ratio**2])
    return StepFaces(n / ratio, np.asarray(by @ C @ by.T), shown)
