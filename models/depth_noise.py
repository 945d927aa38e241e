"""Applies a scanner's errors to a perfect depth map: noise, warp, flying pixels, dropouts and quantisation; seeded."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError

Depth = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """How a scanner errs along its optical axis; metres, radians, pixels. All zero is a perfect scanner.

    Attributes:
        sigma_m: standard deviation of the noise on a bright surface seen head-on at `reference_m`.
        growth: the noise grows as (depth / reference)^growth: 2 for triangulation and for time of flight.
        incidence: the noise grows as (1 / cos of the angle of incidence)^incidence.
        correlation_px: the noise is smoothed with a Gaussian of this width and keeps its sigma (0: white).
        edge_step_m: neighbouring depths further apart than this are a depth discontinuity.
        flying: chance that a pixel beside a discontinuity reads something between the two depths.
        edge_dropout: chance that a pixel beside a discontinuity reads nothing.
        grazing_rad: surfaces seen at a larger angle of incidence are not measured.
        dropout: chance that any pixel reads nothing.
        dark_dropout: chance that a fully dark pixel (dark = 1) reads nothing.
        dark_gain: the noise of a fully dark pixel is (1 + dark_gain) times that of a bright one.
        quantum_m: depths come in steps of this size (0: continuous).
        warp_m, device: largest value of a smooth error over the image that stays the same for one device (a seed), at
            the reference depth; it grows with depth like the noise.
        scale_error: relative error of every depth, and with it of every point, in a calibrated device.
        gradient_per_m: further relative error per metre of x and of y (true, camera frame).
    """

    sigma_m: float = 0.0
    reference_m: float = 1.0
    growth: float = 2.0
    incidence: float = 1.0
    correlation_px: float = 0.0
    edge_step_m: float = 0.005
    flying: float = 0.0
    edge_dropout: float = 0.0
    grazing_rad: float = math.pi / 2
    dropout: float = 0.0
    dark_dropout: float = 0.0
    dark_gain: float = 0.0
    quantum_m: float = 0.0
    warp_m: float = 0.0
    device: int = 0
    scale_error: float = 0.0
    gradient_per_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        chances = (self.flying, self.edge_dropout, self.dropout, self.dark_dropout)
        sizes = (self.sigma_m, self.correlation_px, self.dark_gain, self.quantum_m, self.warp_m)
        if not all(0.0 <= p <= 1.0 for p in chances):
            raise InputError("The chances of a depth noise model lie between 0 and 1: correct flying or a dropout.")
        if not (self.reference_m > 0.0 and self.edge_step_m > 0.0 and all(v >= 0.0 for v in sizes)):
            raise InputError("Depth noise sizes cannot be negative: correct a sigma, step, warp or quantum.")
        if not (
            abs(self.scale_error) < 0.1 and len(self.gradient_per_m) == 2 and np.isfinite(self.gradient_per_m).all()
        ):
            raise InputError("A scanner's scale error must be below 0.1 and its gradient two finite numbers.")

    @property
    def distorts(self) -> bool:
        """Whether the device has errors that stay the same from scan to scan."""
        return self.warp_m > 0.0 or self.scale_error != 0.0 or any(self.gradient_per_m)


def noisy_depth(
    depth: Depth,
    noise: DepthNoise,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    rng: np.random.Generator,
    dark: npt.NDArray[np.floating] | None = None,
) -> Depth:
    """A copy of a perfect depth map (H,W) in metres as the scanner would return it; 0 stays and marks "no reading".

    ``fx..cy`` are in pixels, OpenCV convention (centre of the first pixel at 0, 0). `dark` (H,W) runs from 0 (bright)
    to 1.
    """
    perfect = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0)).astype(np.float32, copy=False)
    valid = perfect > 0.0
    cosine = incidence_cosine(perfect, fx, fy, cx, cy)
    relative = perfect * np.float32(1.0 / noise.reference_m)
    scale = relative * relative if noise.growth == 2.0 else np.power(relative, np.float32(noise.growth))

    out = perfect.copy()
    if noise.sigma_m > 0.0:
        unit = rng.standard_normal(perfect.shape, dtype=np.float32)
        if noise.correlation_px > 0.0:
            unit = _smoothed(unit, noise.correlation_px)
        sigma = np.float32(noise.sigma_m) * scale
        if noise.incidence != 0.0:
            sigma /= cosine if noise.incidence == 1.0 else np.power(cosine, np.float32(noise.incidence))
        if dark is not None and noise.dark_gain > 0.0:
            sigma *= (1.0 + noise.dark_gain * dark).astype(np.float32)
        out += unit * sigma
    if noise.distorts:
        out += _distortion(perfect, noise, fx, fy, cx, cy, scale)

    if noise.flying > 0.0 or noise.edge_dropout > 0.0:
        nearest, farthest = _neighbourhood(perfect)
        edge = np.flatnonzero((farthest - nearest > noise.edge_step_m) & valid)
        chance, blend = rng.random((2, len(edge)), dtype=np.float32)
        flies = chance < noise.flying
        at = edge[flies]
        low, high = nearest.ravel()[at], farthest.ravel()[at]
        out.ravel()[at] = low + blend[flies] * (high - low)
        out.ravel()[edge[(chance >= noise.flying) & (chance < noise.flying + noise.edge_dropout)]] = 0.0

    if noise.quantum_m > 0.0:
        np.multiply(np.rint(out * np.float32(1.0 / noise.quantum_m)), np.float32(noise.quantum_m), out=out)
    lost = ~valid | (cosine < math.cos(noise.grazing_rad))
    if dark is not None and noise.dark_dropout > 0.0:
        lost |= rng.random(perfect.shape, dtype=np.float32) < noise.dark_dropout * dark
    if noise.dropout > 0.0:
        lost |= rng.random(perfect.shape, dtype=np.float32) < noise.dropout
    out[lost] = 0.0
    return out


def incidence_cosine(depth: Depth, fx: float, fy: float, cx: float, cy: float) -> Depth:
    """Cosine (H,W) between each pixel's ray and its surface's normal, at least 0.02, from the depth's own slopes.

    Of the two one-sided slopes along each axis the smaller is taken, so that a jump beside a surface does not tilt it.
    """
    z_u = _least_slope(depth, axis=1)
    z_v = _least_slope(depth, axis=0)
    height, width = depth.shape
    u = (np.arange(width, dtype=np.float32) - np.float32(cx))[None, :]
    v = (np.arange(height, dtype=np.float32) - np.float32(cy))[:, None]
    # The normal of z(u, v) under perspective is (fx z_u, fy z_v, -(z + (u - cx) z_u + (v - cy) z_v)); its product with
    # the ray ((u - cx)/fx, (v - cy)/fy, 1) is -z.
    along = depth + u * z_u + v * z_v
    normal = np.square(np.float32(fx) * z_u) + np.square(np.float32(fy) * z_v) + np.square(along)
    ray = np.square(u / np.float32(fx)) + np.square(v / np.float32(fy)) + np.float32(1.0)
    cosine = depth / np.sqrt(np.maximum(normal * ray, np.float32(1e-12)))
    return np.asarray(np.clip(cosine, np.float32(0.02), np.float32(1.0)), dtype=np.float32)


def _distortion(perfect: Depth, noise: DepthNoise, fx: float, fy: float, cx: float, cy: float, growth: Depth) -> Depth:
    """Return the device's own errors (H,W) of a depth map, m."""
    gx, gy = noise.gradient_per_m
    height, width = perfect.shape
    u = (np.arange(width, dtype=np.float32) - np.float32(cx))[None, :] * np.float32(gx / fx)
    v = (np.arange(height, dtype=np.float32) - np.float32(cy))[:, None] * np.float32(gy / fy)
    out = np.asarray(perfect * (np.float32(noise.scale_error) + perfect * (u + v)), dtype=np.float32)
    if noise.warp_m > 0.0:
        out += device_warp(perfect.shape, noise.warp_m, noise.device) * growth
    return out


def measured_points(
    points_C: npt.NDArray[np.floating], noise: DepthNoise, pixels: tuple[float, float, float, float, int, int]
) -> npt.NDArray[np.float64]:
    """Where the device's own errors, without noise, put points (..., 3) m of its camera frame.

    `pixels` is (fx, fy, cx, cy, width, height). For studies and ground truth.
    """
    p = np.asarray(points_C, dtype=np.float64)
    fx, fy, cx, cy, width, height = pixels
    gx, gy = noise.gradient_per_m
    z = p[..., 2]
    depth = z * (1.0 + noise.scale_error + gx * p[..., 0] + gy * p[..., 1])
    if noise.warp_m > 0.0:
        weights, x, y = _warp_weights(noise.warp_m, noise.device), fx * p[..., 0] / z + cx, fy * p[..., 1] / z + cy
        wave_x, wave_y = (
            np.cos(np.pi * np.multiply.outer(np.arange(3), (t + 0.5) / n)) for t, n in ((x, width), (y, height))
        )
        depth = (
            depth + np.einsum("i...,ij,j...->...", wave_y, weights, wave_x) * (z / noise.reference_m) ** noise.growth
        )
    return np.asarray(p * (depth / z)[..., None])


def device_warp(shape: tuple[int, ...], amplitude_m: float, device: int) -> Depth:
    """Return a smooth error (H,W) in metres with |error| <= amplitude, the same at every resolution for one device.

    The lowest cosines of the image plane (constant, the tilts and four more) with seeded weights: the kind of space
    deformation that is left after a scanner's factory calibration.
    """
    height, width = shape
    x, y = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    wave_x, wave_y = (np.cos(np.pi * np.arange(3)[:, None] * t[None, :]) for t in (x, y))
    return np.asarray(wave_y.T @ _warp_weights(amplitude_m, device) @ wave_x, dtype=np.float32)


def _warp_weights(amplitude_m: float, device: int) -> npt.NDArray[np.float64]:
    """Weights (3, 3) m of the cosines along y and x."""
    rng = np.random.default_rng([device, 0x77617270])
    weights = rng.standard_normal((3, 3)) * np.array([[0.3, 1.0, 0.7], [1.0, 0.7, 0.4], [0.7, 0.4, 0.2]])
    grid = np.linspace(0.0, 1.0, 33)
    waves = np.cos(np.pi * np.arange(3)[:, None] * grid[None, :])
    peak = float(np.abs(waves.T @ weights @ waves).max())
    return np.asarray(weights * amplitude_m / peak)


def _least_slope(depth: Depth, axis: int) -> Depth:
    """Depth change per pixel along an axis: the smaller of the steps to the two measured neighbours, 0 without one."""
    step = np.diff(depth, axis=axis)
    seen = depth > 0.0
    both = seen[:, 1:] & seen[:, :-1] if axis == 1 else seen[1:] & seen[:-1]
    step[~both] = np.inf
    forward, backward = (
        cv2.copyMakeBorder(step, *border, cv2.BORDER_CONSTANT, value=np.inf)
        for border in (((0, 0, 0, 1), (0, 0, 1, 0)) if axis == 1 else ((0, 1, 0, 0), (1, 0, 0, 0)))
    )
    least = np.where(np.abs(forward) < np.abs(backward), forward, backward)
    least[~np.isfinite(least)] = 0.0
    return np.asarray(least, dtype=np.float32)


def _neighbourhood(depth: Depth) -> tuple[Depth, Depth]:
    """Nearest and farthest measured depth (H,W) within one pixel of each pixel."""
    far = np.where(depth > 0.0, depth, np.float32(np.inf))
    kernel = np.ones((3, 3), dtype=np.uint8)
    nearest = np.asarray(cv2.erode(far, kernel, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)
    farthest = np.asarray(cv2.dilate(depth, kernel, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)
    return nearest, farthest


def _smoothed(unit: Depth, width_px: float) -> Depth:
    """White noise through a Gaussian of that width, with its unit variance restored."""
    size = 2 * math.ceil(3.0 * width_px) + 1
    kernel = cv2.getGaussianKernel(size, width_px, cv2.CV_32F)
    # Correlating with k along both axes leaves a variance of (sum k^2)^2.
    kernel = kernel / np.sqrt(np.sum(np.square(kernel)))
    return np.asarray(
        cv2.sepFilter2D(unit, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32
    )
