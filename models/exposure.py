"""Mixes depth maps of one exposure: the mean where all show one surface, at an edge one of them or a point between."""

import numpy as np

from weldcal.models.depth_noise import Depth


def mixed_exposure(stack: Depth, edge_step_m: float, flying: float, rng: np.random.Generator) -> Depth:
    """The depth map (H, W) m of an exposure of which ``stack`` (n, H, W) holds the instants, infinite or 0 where nothing is.

    Depths further apart than ``edge_step_m`` are two surfaces; such a pixel reads one of them, by its share of the exposure, or
    with chance ``flying`` the mean. 0 marks "no reading".
    """
    stack = np.where(np.isfinite(stack) & (stack > 0.0), stack, np.float32(np.inf))
    low, high = stack.min(axis=0), stack.max(axis=0)
    seen = np.isfinite(low)
    with np.errstate(invalid="ignore"):
        edge = seen & (high - low > edge_step_m)
        mean = stack.mean(axis=0)
    out = np.where(seen & ~edge, mean, 0.0).astype(np.float32)
    at = np.flatnonzero(edge)
    if len(at):
        out.ravel()[at] = _edge_pixels(stack.reshape(len(stack), -1)[:, at], flying, rng)
    return out


def _edge_pixels(samples: Depth, flying: float, rng: np.random.Generator) -> Depth:
    """Depths (k,) of pixels whose instants (n, k) show two surfaces, or one and none."""
    n, k = samples.shape
    one = samples[rng.integers(n, size=k), np.arange(k)]
    seen = np.isfinite(samples)
    mean = np.where(seen, samples, 0.0).sum(axis=0) / seen.sum(axis=0)
    out = np.where(rng.random(k) < flying, mean, one)
    return np.asarray(np.where(np.isfinite(out), out, 0.0), dtype=np.float32)
