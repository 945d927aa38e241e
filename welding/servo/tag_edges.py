"""Corners of a printed square from its four whole sides: every pixel along a side votes for where it is, not the corner alone."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.welding.vectors import Array

PROFILES = 48  # across each side
NEAR_CORNER = 0.06  # of a side, left out at either end: there the other side is in the profile
REACH = 0.3  # of a cell, on either side of the edge: further out other cells begin
STEP_PX = 0.5  # between the samples of a profile
LEAST_CONTRAST = 20.0  # grey levels between print and margin
ROUNDS = 2  # the second begins within a hundredth of a pixel of the end


def corners_from_sides(grey: NDArray[np.uint8], corners: Array, cells: int) -> Array | None:
    """Where the four sides of a black square on white cross, (4, 2) px; None where they cannot be seen well enough.

    Corner refinement looks at a few pixels round each corner, and where blur rounds the corner or the print differs on its two
    sides it is drawn outwards: a tag of 112 px reads half a pixel too large, which is 0.2 mm in 40 mm of distance. Across a
    whole side the blur is symmetric: the grey that a profile holds in all says where its edge is (the area under a
    blurred step is that of the step, whatever the blur), and a side has a hundred pixels to say it.

    Args:
        grey: (H, W) uint8.
        corners: (4, 2) px, to a pixel or two, in order round the square; centre of the first pixel at (0, 0).
        cells: of the print along a side, its black border included.
    """
    found = np.asarray(corners, dtype=float)
    image = np.asarray(grey, dtype=np.float32)
    along = np.linspace(NEAR_CORNER, 1.0 - NEAR_CORNER, PROFILES)
    for _ in range(ROUNDS):
        ends = np.roll(found, -1, axis=0)
        length = np.linalg.norm(ends - found, axis=1)
        if not np.isfinite(length).all() or length.min() < 4.0 * cells:
            return None
        tangent = (ends - found) / length[:, None]
        centre = found.mean(axis=0)
        outward = np.column_stack([tangent[:, 1], -tangent[:, 0]])
        outward *= np.sign(np.sum(outward * (0.5 * (found + ends) - centre), axis=1))[:, None]
        half = float(np.clip(REACH * length.min() / cells, 2.0, 6.0))
        n = 2 * int(np.ceil(half / STEP_PX)) + 1
        across = np.linspace(-half, half, n)
        middle = found[:, None] + along[None, :, None] * (ends - found)[:, None]
        x, y = (
            (middle[:, :, None, k] + across * outward[:, None, None, k]).reshape(4 * PROFILES, n).astype(np.float32)
            for k in (0, 1)
        )
        if x.min() < 0 or y.min() < 0 or x.max() > image.shape[1] - 1 or y.max() > image.shape[0] - 1:
            return None
        profiles = cv2.remap(image, x, y, cv2.INTER_LINEAR).reshape(4, PROFILES, n).astype(float)
        offset = _edge_offsets(profiles, across)
        if offset is None:
            return None
        lines = _lines(found, ends, outward, along, offset)
        previous = np.roll(lines, 1, axis=0)
        crossing = np.cross(previous, lines)
        if np.abs(crossing[:, 2]).min() < 1e-9:
            return None
        found = crossing[:, :2] / crossing[:, 2:]
    return np.asarray(found)


def _edge_offsets(profiles: Array, across: Array) -> Array | None:
    """How far outwards each profile's edge lies, (4, PROFILES) px, from the share of it that is dark."""
    k = max(2, profiles.shape[2] // 5)
    dark, light = np.median(profiles[:, :, :k], axis=(1, 2)), np.median(profiles[:, :, -k:], axis=(1, 2))
    if np.min(light - dark) < LEAST_CONTRAST:
        return None
    share = (light[:, None, None] - profiles) / (light - dark)[:, None, None]
    weights = np.full(len(across), across[1] - across[0])
    weights[[0, -1]] *= 0.5
    return np.asarray(share @ weights + across[0])


def _lines(start: Array, end: Array, outward: Array, along: Array, offset: Array) -> Array:
    """Homogeneous lines (4, 3) through the edge points of the sides; a point that strays (a scratch, a speck) does not count."""
    weight = np.ones_like(offset)
    for _ in range(3):
        total = weight.sum(axis=1, keepdims=True)
        mean_t = weight @ along[:, None] / total
        mean_o = np.sum(weight * offset, axis=1, keepdims=True) / total
        t = along - mean_t
        slope = np.sum(weight * t * offset, axis=1, keepdims=True) / np.sum(weight * t * t, axis=1, keepdims=True)
        stray = np.abs(offset - mean_o - slope * t)
        weight = (stray <= np.maximum(4.5 * np.median(stray, axis=1, keepdims=True), 0.02)).astype(float)
    at_start, at_end = mean_o - slope * mean_t, mean_o + slope * (1.0 - mean_t)
    a, b = start + at_start * outward, end + at_end * outward
    normal = np.column_stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]])
    return np.column_stack([normal, -np.sum(normal * a, axis=1)])
