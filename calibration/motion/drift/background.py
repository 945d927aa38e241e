"""Tells a moved scanner from a moved base by what stands still in the scans: it moves in the camera with the one, not
with the other."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.models.arrays import Array

Mask = NDArray[np.bool_]

_STILL_M = 2e-3  # robust spread of a pixel's depth that shows the same thing in all frames
_SEEN = 0.6  # of the frames that must measure a pixel
_STEP_M = 0.004  # in depth between neighbours: an edge, whose normal says nothing
_LEAST_PIXELS = 2000
_SURE = 0.15  # sigma of the share from which on it decides
_CORRELATED = 25.0  # pixels that share their noise
_CLIP = 4.0  # robust deviations, a choice: 6 in 100,000 normal draws lie beyond

SCANNER, BASE = "the scanner moved", "the robot's base moved, and the scanner did not"


@dataclass(frozen=True)
class BackgroundMove:
    """``share`` of the predicted move that the still background made in the camera, with its sigma, from so many
    pixels: 1 where the scanner moved, 0 where the base did."""

    share: float
    sigma: float
    pixels: int

    @property
    def cause(self) -> str | None:
        """What moved, as a sentence without a full stop; None where the background does not decide."""
        if self.sigma > _SURE:
            return None
        if abs(self.share - 1.0) < 0.35:
            return SCANNER
        return BASE if abs(self.share) < 0.35 else None


def background_move(before: Sequence[Array], after: Sequence[Array], X_AB: RigidTransform) -> BackgroundMove | None:
    """Compare organised clouds (H, W, 3) m of before and after a change, a still thing at p before being at X_AB p in
    the camera after it if the scanner moved.

    Each pixel's median over the frames shows what stands still; the arm passes through. Along the normal, a still
    surface at p moves by n . (X_AB p - p) under its ray, and the share of it that shows is a weighted mean over all
    pixels. What the scanner errs at a pixel is the same before and after. None where the clouds are not organised or
    little stands still.
    """
    clouds = [*before, *after]
    if not before or not after or any(c.ndim != 3 or c.shape != clouds[0].shape for c in clouds):
        return None
    first, still = _median(before)
    second, also = _median(after)
    normal, smooth = _normals(first)
    use = still & also & smooth & (np.abs(second[..., 2] - first[..., 2]) < 10.0 * _STILL_M)
    if int(use.sum()) < _LEAST_PIXELS:
        return None
    p, n = first[use], normal[use]
    told = (n * (second[use] - p)).sum(axis=1)
    moved = p @ X_AB.rotation().matrix().T + X_AB.translation() - p
    expected = (n * moved).sum(axis=1)
    weight = np.ones(len(p))
    share = 0.0
    for _ in range(6):
        share = float((weight * told * expected).sum() / max(float((weight * expected**2).sum()), 1e-18))
        e = told - share * expected
        scale = 1.4826 * float(np.median(np.abs(e))) + 1e-7
        weight = (np.abs(e) < _CLIP * scale).astype(float)
    sigma = float(np.sqrt(_CORRELATED * scale**2 / max(float((weight * expected**2).sum()), 1e-18)))
    return BackgroundMove(share, sigma, int(weight.sum()))


def _median(clouds: Sequence[Array]) -> tuple[Array, Mask]:
    """Median point of each pixel (H, W, 3), and whether it shows one thing that stands still."""
    z = np.stack([c[..., 2] for c in clouds])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels that no frame measured
        middle = np.nanmedian(z, axis=0)
        spread = 1.4826 * np.nanmedian(np.abs(z - middle), axis=0)
        ray = np.nanmedian(np.stack([c[..., :2] / c[..., 2:] for c in clouds]), axis=0)
    seen = np.isfinite(z).mean(axis=0) >= _SEEN
    point = np.concatenate([ray * middle[..., None], middle[..., None]], axis=-1)
    return point, np.asarray(seen & (spread < _STILL_M))


def _normals(p: Array) -> tuple[Array, Mask]:
    """Unit normals (H, W, 3) from differences over five pixels, and where they are those of one smooth surface."""
    across, down = np.full_like(p, np.nan), np.full_like(p, np.nan)
    across[:, 2:-2], down[2:-2] = p[:, 4:] - p[:, :-4], p[4:] - p[:-4]
    n = np.cross(across, down)
    size = np.linalg.norm(n, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        n = n / size[..., None]
        steps = np.maximum(np.abs(across[..., 2]), np.abs(down[..., 2]))
        smooth = np.isfinite(n).all(axis=-1) & (steps < 4.0 * _STEP_M)
    return np.where(smooth[..., None], n, 0.0), np.asarray(smooth)
