"""Locate the corners of a black square on white as intersections of its sides, each found over its whole length."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.welding.numerics import Array

PROFILES = 48  # across each side
NEAR_CORNER = 0.06  # of a side, left out at either end: there the other side is in the profile
REACH = 0.3  # of a cell, on either side of the edge: further out other cells begin
STEP_PX = 0.5  # between the samples of a profile
LEAST_CONTRAST = 20.0  # grey levels between print and margin
LEAST_SHARE = 0.25  # a choice: of a side's contrast; a profile with less lies in a speck and is an outlier
SMOOTHED = 7  # neighbouring profiles whose levels are averaged: light changes slowly along a side
ROUNDS = 2  # the second begins within a hundredth of a pixel of the end
WHITE, BLACK = 252, 2  # a choice: pixels beyond these are clipped, but for the noise
_ALONG = np.linspace(NEAR_CORNER, 1.0 - NEAR_CORNER, PROFILES)
_NEXT, _BEFORE = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])  # of the sides


@dataclass(frozen=True, eq=False, kw_only=True)
class Sides:
    """The sides of a square in a picture.

    Attributes:
        corners: (4, 2) px, intersections of the sides, centre of the first pixel at (0, 0).
        width_px: (4,) standard deviation of the blur across each side; that of a pixel alone is 0.3.
        reach_px: length of a profile on either side of its edge.
        contrast: (4, PROFILES) grey levels between print and margin along each side.
        clipped: (4,) share of the samples of print or margin beside each side that are black or white altogether.
    """

    corners: Array
    width_px: Array
    reach_px: float
    contrast: Array
    clipped: Array


def sides_of_square(grey: NDArray[np.uint8], corners: Array, cells: int) -> Sides | None:
    """Locate the sides of a black square on white; None where a side is not visible.

    Corner refinement looks at a few pixels round each corner. Where blur rounds the corner or the print differs on
    its two sides they move outwards. A tag of 112 px then reads half a pixel too large, which is 0.2 mm in 40 mm of
    distance. Across a whole side the blur is symmetric. The area under a blurred step equals that of the step, so the
    total grey of a profile gives the position of its edge, averaged over a hundred pixels of a side.
    Each profile has its own levels of black and white, so that light from one side does not move the edge.

    Args:
        grey: (H, W) uint8.
        corners: (4, 2) px, to a pixel or two, in order round the square; centre of the first pixel at (0, 0).
        cells: of the print along a side, its black border included.
    """
    found = np.asarray(corners, dtype=float)
    image = np.asarray(grey, dtype=np.float32)
    for _ in range(ROUNDS):
        ends = found[_NEXT]
        length = np.linalg.norm(ends - found, axis=1)
        if not np.isfinite(length).all() or length.min() < 4.0 * cells:
            return None
        tangent = (ends - found) / length[:, None]
        centre = found.mean(axis=0)
        outward = np.column_stack([tangent[:, 1], -tangent[:, 0]])
        outward *= np.sign(np.sum(outward * (0.5 * (found + ends) - centre), axis=1))[:, None]
        half = min(max(REACH * float(length.min()) / cells, 2.0), 6.0)
        n = 2 * int(np.ceil(half / STEP_PX)) + 1
        across = np.linspace(-half, half, n)
        middle = found[:, None] + _ALONG[None, :, None] * (ends - found)[:, None]
        x, y = (
            (middle[:, :, None, k] + across * outward[:, None, None, k]).reshape(4 * PROFILES, n).astype(np.float32)
            for k in (0, 1)
        )
        if x.min() < 0 or y.min() < 0 or x.max() > image.shape[1] - 1 or y.max() > image.shape[0] - 1:
            return None
        profiles = cv2.remap(image, x, y, cv2.INTER_LINEAR).reshape(4, PROFILES, n).astype(float)
        dark, light = _levels(profiles)
        contrast = light - dark
        typical = _medians(contrast)
        if np.min(typical) < LEAST_CONTRAST:
            return None
        contrast = np.maximum(contrast, LEAST_SHARE * typical[:, None])
        share = (light[:, :, None] - profiles) / contrast[:, :, None]  # of black
        lines = _lines(found, ends, outward, edge_offsets(share, across))
        previous = lines[_BEFORE]
        crossing = np.cross(previous, lines)
        if np.abs(crossing[:, 2]).min() < 1e-9:
            return None
        found = crossing[:, :2] / crossing[:, 2:]
    mean = share.mean(axis=1)
    # The area under F (1 - F) of a step with Gaussian blur is its standard deviation over the root of pi.
    width = np.sqrt(np.pi) * np.clip(mean * (1.0 - mean), 0.0, None).sum(axis=1) * (across[1] - across[0])
    black = np.mean(profiles[:, :, across < -0.5 * half] <= BLACK, axis=(1, 2))
    white = np.mean(profiles[:, :, across > 0.5 * half] >= WHITE, axis=(1, 2))
    return Sides(
        corners=np.asarray(found), width_px=width, reach_px=half, contrast=contrast, clipped=np.maximum(black, white)
    )


def _levels(profiles: Array) -> tuple[Array, Array]:
    """Levels (4, PROFILES) of print and margin at the ends of each profile, smoothed along the side."""
    k = max(2, profiles.shape[2] // 5)
    dark, light = (
        cv2.blur(part.mean(axis=2), (SMOOTHED, 1), borderType=cv2.BORDER_REPLICATE)
        for part in (profiles[:, :, :k], profiles[:, :, -k:])
    )
    return np.asarray(dark), np.asarray(light)


def edge_offsets(share: Array, across: Array) -> Array:
    """Position of each profile's edge along `across` (n,), from the share (..., n) of the level at the first sample."""
    weights = np.full(len(across), across[1] - across[0])
    weights[[0, -1]] *= 0.5
    return np.asarray(share @ weights + across[0])


def _medians(rows: Array) -> Array:
    """Median of each row, an even number of numbers; `numpy.median` takes five times as long."""
    k = rows.shape[1] // 2
    middle = np.partition(rows, (k - 1, k), axis=1)[:, k - 1 : k + 1]
    return np.asarray(0.5 * (middle[:, 0] + middle[:, 1]))


def _lines(start: Array, end: Array, outward: Array, offset: Array) -> Array:
    """Homogeneous lines (4, 3) through the edge points of the sides; outliers (a scratch, a speck) are excluded."""
    weight = np.ones_like(offset)
    for _ in range(3):
        total = weight.sum(axis=1, keepdims=True)
        mean_t = weight @ _ALONG[:, None] / total
        mean_o = np.sum(weight * offset, axis=1, keepdims=True) / total
        t = _ALONG - mean_t
        slope = np.sum(weight * t * offset, axis=1, keepdims=True) / np.sum(weight * t * t, axis=1, keepdims=True)
        stray, before = np.abs(offset - mean_o - slope * t), weight
        weight = (stray <= np.maximum(4.5 * _medians(stray)[:, None], 0.02)).astype(float)
        if np.array_equal(weight, before):
            break
    at_start, at_end = mean_o - slope * mean_t, mean_o + slope * (1.0 - mean_t)
    a, b = start + at_start * outward, end + at_end * outward
    normal = np.column_stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]])
    return np.column_stack([normal, -np.sum(normal * a, axis=1)])
