"""Fit circles to pixels labelled on or off a face, along the viewing rays of an organised scan."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from weldcal.calibration.errors import CircleFitError
from weldcal.calibration.geometry.primitives import CircleFit
from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled

Mask = NDArray[np.bool_]

_BENT = 0.05  # pixels: a lens that bends rays more is for the careful way, which knows quadratics

Single = NDArray[np.float32]

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
_SCALES = (0.4, 0.16, 0.06)  # width of the border, in pitches: from easy to sharp
_SETTLED = 0.05  # gain of the log likelihood below which a step is the last


class RayModel:
    """Viewing rays of an organised cloud as a smooth function of the pixel: x/z and y/z are quadratics in (u, v).

    Exact for a pinhole scanner, whose noise moves a point along its ray; the quadratic absorbs a lens locally.
    """

    def __init__(self, points: Array, valid: Mask) -> None:
        v, u = np.nonzero(valid)
        p = points[v, u]
        stride = max(1, len(u) // 1500)
        self._origin = np.array([u.mean(), v.mean()])
        self._scale = max(float(np.ptp(u)), float(np.ptp(v)), 1.0)
        basis = self._basis(u[::stride], v[::stride])
        ray = p[::stride, :2] / p[::stride, 2:]
        self._coefficients = np.linalg.lstsq(basis, ray, rcond=None)[0]

    def _basis(self, u: Array | NDArray[np.intp], v: Array | NDArray[np.intp]) -> Array:
        a, b = (u - self._origin[0]) / self._scale, (v - self._origin[1]) / self._scale
        return np.column_stack([np.ones(len(a)), a, b, a * a, a * b, b * b])

    def grid(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Rays x/z and y/z, each (len(v), len(u)), of a whole grid of pixels."""
        a, b = (u - self._origin[0]) / self._scale, ((v - self._origin[1]) / self._scale)[:, None]
        c = self._coefficients.T
        x, y = ((k[0] + k[1] * a + k[3] * a * a) + b * (k[2] + k[4] * a) + k[5] * (b * b) for k in c)
        return x, y

    def on_plane(self, u: Array, v: Array, point: Array, normal: Array) -> Array:
        """Points (N, 3) m where the rays through pixels (u, v) meet a plane."""
        ray = np.column_stack([self._basis(u, v) @ self._coefficients, np.ones(len(u))])
        return np.asarray(ray * (float(point @ normal) / (ray @ normal))[:, None])


def _sampled(cloud: Array, across: int) -> tuple[Array, Array] | None:
    """Of some ``across`` x ``across`` pixels those that were measured: (1, u, v) (n, 3) and points (n, 3)."""
    H, W = cloud.shape[:2]
    dv, du = max(1, H // across), max(1, W // across)
    p = cloud[dv // 2 :: dv, du // 2 :: du]
    A = np.ones((*p.shape[:2], 3))
    A[..., 1] = np.arange(du // 2, W, du)
    A[..., 2] = np.arange(dv // 2, H, dv)[:, None]
    seen = p[..., 2] == p[..., 2]
    A, p = A[seen], p[seen]
    return (A, p) if len(p) >= 12 else None


def _pinhole(A: Array, p: Array) -> Array | None:
    """Coefficients (3, 2) of rays (x/z, y/z) = (1, u, v) @ them, least squares."""
    try:
        return np.asarray(np.linalg.solve(A.T @ A, A.T @ (p[:, :2] / p[:, 2:])))
    except np.linalg.LinAlgError:
        return None


def pinhole_window(cloud: Array, center: Array, reach: float) -> tuple[tuple[slice, slice], Array | None] | None:
    """Find the rectangle of the pixels that may show a ball of radius ``reach`` m about a centre.

    It follows from a pinhole through a few of all pixels. The pixels' rays, as ``pinhole_rays`` gives them, are
    returned where that pinhole fits the whole image.
    """
    some = _sampled(cloud, 12)
    if some is None or not float(center[2]) > 2.0 * reach:
        return None
    c = _pinhole(*some)
    if c is None:
        return None
    det = c[1, 0] * c[2, 1] - c[2, 0] * c[1, 1]
    if det == 0.0:
        return None
    a, b = center[0] / center[2] - c[0, 0], center[1] / center[2] - c[0, 1]
    at = ((a * c[2, 1] - b * c[2, 0]) / det, (b * c[1, 0] - a * c[1, 1]) / det)
    # a ball is seen a little wider than its middle's distance says
    wide = reach / (float(center[2]) - reach)
    low = [int(np.floor(x - wide / abs(k))) for x, k in zip(at, (c[1, 0], c[2, 1]), strict=True)]
    high = [int(np.ceil(x + wide / abs(k))) + 1 for x, k in zip(at, (c[1, 0], c[2, 1]), strict=True)]
    if min(low) < 0 or high[0] > cloud.shape[1] or high[1] > cloud.shape[0]:
        return None  # cut by the image's border: partly hidden
    rays = None
    off = some[0] @ c - some[1][:, :2] / some[1][:, 2:]
    if float(np.abs(off).max()) < _BENT * float(np.abs(c[1:]).max()):
        rays = np.zeros((3, 3))
        rays[:, :2], rays[0, 2] = c, 1.0
        rays[0, :2] += low[0] * c[1] + low[1] * c[2]
    return (slice(low[1], high[1]), slice(low[0], high[0])), rays


def pinhole_rays(grid: Array) -> Array | None:
    """Coefficients (3, 3) of the viewing rays (x/z, y/z, 1) = (1, u, v) @ them; None where they are not a pinhole's."""
    some = _sampled(grid, 10)
    c = None if some is None else _pinhole(*some)
    if some is None or c is None:
        return None
    if not float(np.abs(some[0] @ c - some[1][:, :2] / some[1][:, 2:]).max()) < _BENT * float(np.abs(c[1:]).max()):
        return None
    out = np.zeros((3, 3))
    out[:, :2], out[0, 2] = c, 1.0
    return out


def refine_circle(xy: Array, on_face: NDArray[np.bool_], start: CircleFit, pitch: float, *, outer: bool) -> CircleFit:
    """Fit the circle that best divides pixels (N, 2) m on the face from those off it, near its edge.

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
    """Fisher scoring with step halving at one border width.

    Parameters (cx, cy, r), information (3, 3), log likelihood.
    """
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
    """Fit outer edge and bore of one face together to pixels (2, N_k) m, as ``refine_circle`` fits one.

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


@compiled()
def exponential(x: np.float32) -> np.float32:
    """exp(x) for -80 < x < 80 with a relative error of 5e-6: 2^n by its bits, the rest by a series.

    Vectorises, unlike a library call in a compiled loop.
    """
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


def _likelihood(xy: Array, side: Array, theta: Array, width: float) -> tuple[float, Array, Array]:
    dx, dy = xy[0] - theta[0], xy[1] - theta[1]
    rho = np.sqrt(dx * dx + dy * dy) + 1e-15
    z = side * (rho - theta[2]) * (1.0 / width)
    p = WRONG + (1.0 - 2.0 * WRONG) * ndtr(z)
    slope = ((1.0 - 2.0 * WRONG) / np.sqrt(2.0 * np.pi)) * np.exp(-0.5 * z * z)
    across = side * (-1.0 / width)
    J = np.array([dx / rho, dy / rho, np.ones(len(rho))]) * across
    score = slope / p
    gradient = J @ score
    information = (J * (score * slope / (1.0 - p))) @ J.T
    return float(np.log(p).sum()), gradient, information
