"""A circle as the border between pixels on a face and pixels off it: maximum likelihood, blind to pixels that are
missing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from weldcal.calibration.circle import CircleFit
from weldcal.calibration.errors import CircleFitError

Array = NDArray[np.float64]

_WRONG = 0.02  # share of labels that may be plainly wrong (flying pixels)
_SCALES = (0.4, 0.16, 0.06)  # width of the border, in pitches: from easy to sharp


def refine_circle(xy: Array, on_face: NDArray[np.bool_], start: CircleFit, pitch: float, *, outer: bool) -> CircleFit:
    """Circle (centre and radius) that best divides pixels (N, 2) m on the face from those off it, near its edge.

    A pixel is on the face with the probability Phi(distance to the edge / width), or its label is wrong (2 %). The
    width is the one of a short ladder that makes the labels most likely. Whether a pixel was measured at all may depend
    on where it is, as at a sharp step, where scanners lose them: given its place, its label stays fair, so the centre
    is not pulled. The covariance is the inverse of the expected information. Raises CircleFitError where it does not
    converge.
    """
    places = np.ascontiguousarray(xy.T)
    side = np.where(on_face, -1.0, 1.0) * (1.0 if outer else -1.0)
    theta = np.array([*start.center, start.radius])
    best: tuple[float, Array, Array, float] | None = None
    for scale in _SCALES:
        width = scale * pitch
        theta, information, value = _climb(places, side, theta, width)
        if best is not None and value < best[0]:
            break  # sharper than the border is
        best = (value, theta, information, width)
    assert best is not None
    _, theta, information, width = best
    if np.linalg.cond(information) > 1e8 or float(np.linalg.norm(theta[:2] - start.center)) > 1.5 * pitch:
        raise CircleFitError("The pixels do not fix the edge of the face.")
    rho = np.hypot(xy[:, 0] - theta[0], xy[:, 1] - theta[1])
    right = side * (rho - theta[2]) > -3.0 * width
    return CircleFit(theta[:2], float(theta[2]), np.asarray(np.linalg.inv(information), dtype=float), start.rms, right)


def _climb(xy: Array, side: Array, theta: Array, width: float) -> tuple[Array, Array, float]:
    """Fisher scoring with step halving at one border width: parameters (cx, cy, r), information (3, 3), log
    likelihood."""
    value, gradient, information = _likelihood(xy, side, theta, width)
    for _ in range(4):
        step = np.linalg.solve(information + np.diag(1e-10 * np.diag(information) + 1e-30), gradient)
        for _ in range(6):
            new = _likelihood(xy, side, theta + step, width)
            if new[0] >= value:
                break
            step = 0.5 * step
        else:
            break
        theta = theta + step
        gain = new[0] - value
        value, gradient, information = new
        if gain < 2e-2:
            break
    return theta, information, value


def _likelihood(xy: Array, side: Array, theta: Array, width: float) -> tuple[float, Array, Array]:
    dx, dy = xy[0] - theta[0], xy[1] - theta[1]
    rho = np.sqrt(dx * dx + dy * dy) + 1e-15
    z = side * (rho - theta[2]) * (1.0 / width)
    p = _WRONG + (1.0 - 2.0 * _WRONG) * ndtr(z)
    slope = ((1.0 - 2.0 * _WRONG) / np.sqrt(2.0 * np.pi)) * np.exp(-0.5 * z * z)
    across = side * (-1.0 / width)
    J = np.array([dx / rho, dy / rho, np.ones(len(rho))]) * across
    score = slope / p
    gradient = J @ score
    information = (J * (score * slope / (1.0 - p))) @ J.T
    return float(np.log(p).sum()), gradient, information
