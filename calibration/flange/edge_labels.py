"""A circle as the border between pixels on a face and pixels off it: maximum likelihood, blind to pixels that are
missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from weldcal.calibration.errors import CircleFitError
from weldcal.calibration.flange.border_likelihood import WRONG as _WRONG
from weldcal.calibration.flange.border_likelihood import border_likelihood
from weldcal.calibration.geometry.circle import CircleFit

Array = NDArray[np.float64]
Single = NDArray[np.float32]

_SCALES = (0.4, 0.16, 0.06)  # width of the border, in pitches: from easy to sharp
_SETTLED = 0.05  # gain of the log likelihood below which a step is the last


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
        if gain < _SETTLED:
            break
    return theta, information, value


def refine_pair(
    places: Sequence[Single], on_face: Sequence[NDArray[np.bool_]], starts: Sequence[CircleFit], pitch: float
) -> list[CircleFit]:
    """The outer edge and the bore of one face, as ``refine_circle`` finds them from pixels (2, N_k) m, both at once.

    ``places`` are about the centres of ``starts``, which are right to a fifth of a pixel. The two share the width of
    their border, which is the scanner's, and the number of steps. Single precision: a millionth of a pixel. Raises
    CircleFitError.
    """
    theta = np.array([[0.0, 0.0, s.radius] for s in starts])
    now = _pair_likelihood(places, on_face, theta, _SCALES[0] * pitch)
    theta = theta + np.linalg.solve(now[2], now[1][:, :, None])[:, :, 0]
    widths = [s * pitch for s in _SCALES]
    now, sharper = (_pair_likelihood(places, on_face, theta, w) for w in widths[:2])
    width = widths[0]
    if sharper[0] > now[0]:
        now, width = sharper, widths[1]
    while True:
        for _ in range(4):
            step = np.linalg.solve(now[2], now[1][:, :, None])[:, :, 0]
            new = _pair_likelihood(places, on_face, theta + step, width)
            while new[0] < now[0] and float(np.abs(step).max()) > 1e-2 * width:
                step = 0.4 * step
                new = _pair_likelihood(places, on_face, theta + step, width)
            gain = new[0] - now[0]
            if gain < 0.0:
                break
            theta, now = theta + step, new
            if gain < _SETTLED:
                break
        if width != widths[1]:
            break
        width = widths[2]
        sharper = _pair_likelihood(places, on_face, theta, width)
        if sharper[0] < now[0]:
            break  # sharper than the border is
        now = sharper
    information = now[2]
    eigenvalues = np.linalg.eigvalsh(information)
    if (eigenvalues[:, 0] < 1e-8 * eigenvalues[:, 2]).any() or float(np.abs(theta[:, :2]).max()) > 1.5 * pitch:
        raise CircleFitError("The pixels do not fix the edge of the face.")
    covariance = np.linalg.inv(information)
    return [
        replace(s, center=s.center + theta[k, :2], radius=float(theta[k, 2]), covariance=covariance[k])
        for k, s in enumerate(starts)
    ]


def _pair_likelihood(
    places: Sequence[Single], on_face: Sequence[NDArray[np.bool_]], theta: Array, width: float
) -> tuple[float, Array, Array]:
    """Log likelihood of both circles theta (2, 3), its gradient (2, 3) and information (2, 3, 3)."""
    outer = border_likelihood(places[0], on_face[0], True, theta[0], width)
    bore = border_likelihood(places[1], on_face[1], False, theta[1], width)
    return outer[0] + bore[0], np.stack([outer[1], bore[1]]), np.stack([outer[2], bore[2]])


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
