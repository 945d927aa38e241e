"""Detects the tablet's landmarks in a camera image, rings or single-pixel dots, in the order of the page."""

from collections.abc import Sequence
from itertools import combinations
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import LandmarksNotFound
from weldcal.models.arrays import Array

Grey = NDArray[np.uint8]
Ellipse = tuple[Sequence[float], Sequence[float], float]
"""Centre, axes (px) and angle (deg), as OpenCV has them."""
Look = Literal["rings", "dots"]

_SPARE = 6  # candidates beyond the landmarks that may be something else
_ROUND = 0.80  # least share of its best ellipse that a ring's outline fills, and the ellipse of the outline
_SLIMMEST = 0.35  # axes of that ellipse: seen 70 degrees aslant
_ALIKE = 2.0  # sizes of the rings of one page, largest over smallest, aslant and near and far
_FULLER = 0.15  # by how much the middle of the full disc is darker than that of any ring
_DOT_SIGMAS = 6.0  # contrast of a dot against the image's noise
_GRID_ERROR = 0.08  # of the spacing: how far a landmark may lie from the grid's homography


def find_landmarks(image: Grey, columns: int, rows: int, look: Look = "rings") -> Array:
    """Image positions (rows * columns, 2) px of the page's landmarks, row by row from its first.

    Centre of the first pixel at (0, 0).

    ``image`` (h, w) or (h, w, 3), 8 bits. Rings: landmark 0 is the full disc, so the page may be turned in the image.
    Dots are all alike: the page must stand upright in the image within 45 degrees. Centres are centroids of darkness;
    of an 8 mm ring seen 30 degrees aslant from 0.3 m the centroid is 0.03 mm off its centre, of which nothing is
    corrected.

    Raises LandmarksNotFound: not all are seen, or what is seen is no such grid.
    """
    return arrange(*find_marks(image, columns * rows, look), columns, rows)


def find_marks(image: Grey, most: int, look: Look = "rings") -> tuple[Array, Array | None]:
    """Centres (k, 2) px of what looks like a landmark, of dots the `most` strongest and a few to spare.

    And how full the rings are (k,), None for dots.
    """
    grey: Grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image, dtype=np.uint8)
    return _rings(grey) if look == "rings" else (_dots(grey, most + _SPARE), None)


def arrange(points: Array, full: Array | None, columns: int, rows: int) -> Array:
    """Return the marks (k, 2) that make the page's grid, row by row from its first: (rows * columns, 2).

    See find_landmarks.
    """
    n = columns * rows
    mark = "dot" if full is None else "ring"
    if len(points) < n:
        raise LandmarksNotFound(
            f"{len(points)} of {n} landmarks were found; show all of the page, in focus, without glare, and let no"
            f" {mark} touch the image's edge."
        )
    grid = _as_grid(points, columns, rows)
    if grid is None:
        raise LandmarksNotFound(
            f"What was found is no grid of {columns} by {rows} landmarks; check these numbers against the page's."
        )
    if full is None:
        return max(_turned(grid, columns, rows), key=_uprightness)
    darkness = np.array([full[np.linalg.norm(points - p, axis=1).argmin()] for p in grid])
    first = int(darkness.argmax())
    if darkness[first] - np.delete(darkness, first).max() < _FULLER:
        raise LandmarksNotFound(
            "No landmark is clearly the full disc, which is the page's first; focus the camera or make the rings"
            " larger."
        )
    for turned in _turned(grid, columns, rows):
        if (turned[0] == grid[first]).all():
            return turned
    raise LandmarksNotFound("The full disc is no corner of the grid; check columns and rows against the page's.")


def _rings(grey: Grey) -> tuple[Array, Array]:
    """Centres (k, 2) of round dark outlines of like size, and how dark their middles are (k,), 1 for a full disc."""
    block = max(31, (min(grey.shape) // 8) | 1)
    dark = cv2.adaptiveThreshold(grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, 20)
    outlines, tree = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    found: list[tuple[Array, float, float]] = []
    for k, outline in enumerate(outlines):
        if len(outline) < 12 or tree[0][k][3] >= 0:
            continue
        (_, _), axes, _ = ellipse = cv2.fitEllipse(outline)
        area, ellipse_area = cv2.contourArea(outline), 0.25 * np.pi * axes[0] * axes[1]
        x, y, w, h = cv2.boundingRect(outline)
        inside = x > 1 and y > 1 and x + w < grey.shape[1] - 1 and y + h < grey.shape[0] - 1
        if not inside or min(axes) < _SLIMMEST * max(axes) or not _ROUND < area / max(ellipse_area, 1e-9) < 1.25:
            continue
        found.append((_centroid(grey, ellipse), float(np.sqrt(ellipse_area)), _fullness(grey, ellipse)))
    if not found:
        return np.zeros((0, 2)), np.zeros(0)
    size = np.array([f[1] for f in found])
    # the rings are the largest crowd of one size
    crowd = max(range(len(size)), key=lambda k: int(((size >= size[k]) & (size <= _ALIKE * size[k])).sum()))
    keep = (size >= size[crowd]) & (size <= _ALIKE * size[crowd])
    points = np.array([f[0] for f in found])[keep]
    return points, np.array([f[2] for f in found])[keep]


def _fullness(grey: Grey, ellipse: Ellipse) -> float:
    """Darkness of an outline's middle over its darkest, from the light around it."""
    centre, axes, angle = ellipse

    def mean(inner: float, outer: float) -> float:
        mask = np.zeros(grey.shape, dtype=np.uint8)
        cv2.ellipse(mask, (centre, (outer * axes[0], outer * axes[1]), angle), 255, -1)
        if inner > 0.0:
            cv2.ellipse(mask, (centre, (inner * axes[0], inner * axes[1]), angle), 0, -1)
        return float(cv2.mean(grey, mask)[0])

    middle, ring, around = mean(0.0, 0.3), mean(0.6, 0.85), mean(1.3, 1.6)
    return (around - middle) / max(around - min(ring, middle), 1.0)


def _centroid(grey: Grey, ellipse: Ellipse) -> Array:
    """Centroid of darkness within one and a half times an ellipse."""
    (cx, cy), axes, angle = ellipse
    reach = int(np.ceil(0.8 * max(axes))) + 2
    x0, y0 = max(int(cx) - reach, 0), max(int(cy) - reach, 0)
    window = grey[y0 : int(cy) + reach + 1, x0 : int(cx) + reach + 1].astype(float)
    mask = np.zeros(window.shape, dtype=np.uint8)
    cv2.ellipse(mask, ((cx - x0, cy - y0), (1.4 * axes[0] + 2, 1.4 * axes[1] + 2), angle), 255, -1)
    # a paper that is lit unevenly: its plane of brightness from the pixels just outside
    v, u = np.mgrid[: window.shape[0], : window.shape[1]].astype(float)
    bright = (mask > 0) & (window > 0.5 * (window[mask > 0].min() + window[mask > 0].max()))
    outside = bright & (np.hypot(u - (cx - x0), v - (cy - y0)) > 0.5 * min(axes))
    A = np.c_[u[outside], v[outside], np.ones(int(outside.sum()))]
    plane = np.linalg.lstsq(A, window[outside], rcond=None)[0] if len(A) >= 6 else np.array([0, 0, window.max()])
    darkness = np.where(mask > 0, np.clip(plane[0] * u + plane[1] * v + plane[2] - window, 0.0, None), 0.0)
    total = max(float(darkness.sum()), 1e-9)
    return np.array([x0 + (darkness * u).sum() / total, y0 + (darkness * v).sum() / total])


def _dots(grey: Grey, most: int) -> Array:
    """Centres (k, 2) of the darkest specks, darkest first."""
    image = grey.astype(np.float32)
    background = cv2.medianBlur(grey, 9).astype(np.float32)
    speck = cv2.GaussianBlur(background - image, (0, 0), 0.8)
    bright = background > 0.5 * float(np.percentile(background, 90))
    noise = 1.4826 * float(np.median(np.abs(speck[bright]))) if bright.any() else 1.0
    peak = cv2.dilate(speck, np.ones((9, 9), np.uint8))
    edge = cv2.erode(bright.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    v, u = np.nonzero((speck >= peak) & (speck > _DOT_SIGMAS * max(noise, 0.15)) & edge)
    inside = (u > 4) & (v > 4) & (u < grey.shape[1] - 5) & (v < grey.shape[0] - 5)
    u, v = u[inside], v[inside]
    strongest = np.argsort(-speck[v, u])[:most]
    offset = np.arange(-3.0, 4.0)
    points = []
    for k in strongest:
        window = np.clip(speck[v[k] - 3 : v[k] + 4, u[k] - 3 : u[k] + 4].astype(float) - noise, 0.0, None)
        total = window.sum()
        points.append([u[k] + (window.sum(axis=0) @ offset) / total, v[k] + (window.sum(axis=1) @ offset) / total])
    return np.array(points).reshape(-1, 2)


def _as_grid(points: Array, columns: int, rows: int) -> Array | None:
    """Return the points (n, 2) that make a grid, row by row from some corner; None where no choice of them does.

    Every four points that could be the corners give a homography, and it must lead to a point of its own for every
    landmark: so that something else of the same look is excluded.
    """
    square = np.array([[i, j] for j in range(rows) for i in range(columns)], dtype=np.float32)
    corners = np.array([[0, 0], [columns - 1, 0], [columns - 1, rows - 1], [0, rows - 1]], dtype=np.float32)
    best: tuple[float, Array] | None = None
    for chosen in combinations(range(min(len(points), columns * rows + _SPARE)), 4):
        four = points[list(chosen)]
        hull = cv2.convexHull(four.astype(np.float32))[:, 0]
        if len(hull) < 4:
            continue
        for turn in (0, 1):
            H = cv2.getPerspectiveTransform(corners, np.roll(hull, turn, axis=0))
            there = cv2.perspectiveTransform(square[:, None], H)[:, 0].astype(float)
            distance = np.linalg.norm(there[:, None] - points[None], axis=2)
            nearest = distance.argmin(axis=1)
            steps = np.linalg.norm(np.diff(there.reshape(rows, columns, 2), axis=1), axis=2)
            off = float(distance.min(axis=1).max() / max(float(steps.min()), 1e-9))
            if off < _GRID_ERROR and len(set(nearest)) == len(square) and (best is None or off < best[0]):
                best = off, points[nearest]
    return None if best is None else best[1]


def _turned(grid: Array, columns: int, rows: int) -> list[Array]:
    """Return the grid (n, 2) row by row from each corner at which it can start; a page always shows its front."""
    square = grid.reshape(rows, columns, 2)
    right, down = square[0, -1] - square[0, 0], square[-1, 0] - square[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0.0:
        square = square[:, ::-1]
    turned = (np.rot90(square, k) for k in range(4))
    return [t.reshape(-1, 2) for t in turned if t.shape[:2] == (rows, columns)]


def _uprightness(points: Array) -> float:
    """How far the last point lies to the lower right of the first, as a cosine with the image's diagonal."""
    d = points[-1] - points[0]
    return float((d[0] + d[1]) / max(np.linalg.norm(d), 1e-9))
