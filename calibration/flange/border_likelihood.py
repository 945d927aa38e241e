"""How likely a circle is as the border between pixels on a face and pixels off it, compiled to run on many pixels at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.compiled import compiled

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]

WRONG = 0.02  # share of labels that may be plainly wrong (flying pixels)
_FAR = np.float32(6.0)  # border widths; beyond them only wrong labels count
_ONE, _HALF, _TINY = np.float32(1.0), np.float32(0.5), np.float32(1e-12)
# Phi(z) = 1 / (1 + exp(-z (a + b z^2))), right to 2e-4
_PHI1, _PHI3 = np.float32(1.5957691216), np.float32(0.0713548162)
_LOG2_E, _LN_2 = np.float32(1.4426950409), np.float32(0.6931471806)
_C2, _C3, _C4, _C5 = (np.float32(1.0 / k) for k in (2.0, 6.0, 24.0, 120.0))
_BIAS, _MANTISSA = np.int32(127), np.int32(23)
_WRONG, _RIGHT, _DENSITY = (
    np.float32(k) for k in (WRONG, 1.0 - 2.0 * WRONG, (1.0 - 2.0 * WRONG) / np.sqrt(2.0 * np.pi))
)


@compiled()
def exponential(x: np.float32) -> np.float32:
    """exp(x) for -80 < x < 80, right to 5e-6: 2^n by its bits, the rest by a series; written so that it is done for eight
    or sixteen numbers at once, which a library's cannot be here."""
    y = x * _LOG2_E
    n = np.floor(y + _HALF)
    f = (y - n) * _LN_2
    series = _ONE + f * (_ONE + f * (_C2 + f * (_C3 + f * (_C4 + f * _C5))))
    return np.float32(series * np.int32((np.int32(n) + _BIAS) << _MANTISSA).view(np.float32))


@compiled(any_order=True)
def border_likelihood(xy: Single, on: Mask, outer: bool, theta: Array, width: float) -> tuple[float, Array, Array]:
    """Log likelihood of a circle (cx, cy, r) m, its gradient (3,) and expected information (3, 3).

    ``xy`` (2, N) m are pixels near an edge, ``on`` (N,) whether each lies on the face, which is inside the edge if
    ``outer``; ``width`` m is the border's. In single precision: to a millionth of a pixel.
    """
    n = xy.shape[1]
    cx, cy, r = np.float32(theta[0]), np.float32(theta[1]), np.float32(theta[2])
    steep = np.float32((1.0 if outer else -1.0) / width)
    likely = np.empty(n, np.float32)
    g0 = g1 = g2 = h00 = h01 = h11 = h02 = h12 = h22 = np.float32(0.0)
    for i in range(n):
        dx, dy = xy[0, i] - cx, xy[1, i] - cy
        rho = np.sqrt(dx * dx + dy * dy) + _TINY
        across = steep if on[i] else -steep
        z = min(max((rho - r) * across, -_FAR), _FAR)
        z2 = z * z
        p = _WRONG + _RIGHT / (_ONE + exponential(z * (_PHI1 + _PHI3 * z2)))
        slope = across * _DENSITY * exponential(-_HALF * z2)
        toward = slope / p
        weight = toward * slope / (_ONE - p)
        a, b = dx / rho, dy / rho
        likely[i] = p
        g0 += a * toward
        g1 += b * toward
        g2 += toward
        h00 += weight * a * a
        h01 += weight * a * b
        h11 += weight * b * b
        h02 += weight * a
        h12 += weight * b
        h22 += weight
    log, product = 0.0, 1.0
    for i in range(n):
        product *= likely[i]
        if product < 1e-250:  # far less often than at every pixel
            log += np.log(product)
            product = 1.0
    gradient = np.array([float(g0), float(g1), float(g2)])
    information = np.array(
        [
            [float(h00), float(h01), float(h02)],
            [float(h01), float(h11), float(h12)],
            [float(h02), float(h12), float(h22)],
        ]
    )
    return log + np.log(product), gradient, information
