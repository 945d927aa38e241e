"""State the covariance of a tag's position by the sharpness, light and contrast of its picture."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.welding.finger.sides import REACH, Sides, edge_offsets
from weldcal.welding.numerics import Array

LIMIT_SIGMAS = 3.0  # errors of accepted pictures: 99.9 % lie within three standard deviations
# Standard deviation in px of the tag's place and of its size, per px of each effect of `PictureQuality.effects_px`:
# the most likely ones of the pictures of tests/welding/finger/disturbed.py (`--fit`).
PLACE = np.array([1.0, 0.01, 0.43, 0.12, 0.42, 0.10, 0.01])
SIZE = np.array([1.0, 1.53, 0.44, 0.33, 0.80, 0.09, 0.03])
FLOOR_PX = 0.005  # of a sharp picture with little noise
BLURRED = 0.38  # of a profile's reach: from this width on its ends lie in the blur
BLUR_POWER = 6  # the tails of a blurred edge beyond the profile's end grow so steeply
UNEVEN = 0.25  # a choice: contrast that differs by this share between places is named as the cause
CLIPPED = 0.25  # a choice: share of clipped samples at a side that is named as the cause
SAMPLES, HALF = 8, 10  # profiles of an inner edge, and samples on either side of it
_INNER = 0.2  # of a cell at either end of an inner edge, left out


@dataclass(frozen=True, eq=False, kw_only=True)
class PictureQuality:
    """What a picture shows of its own errors.

    Attributes:
        width: widest side's blur over the reach of its profiles.
        clipped: greatest share of clipped samples at a side.
        uneven: share by which the contrast differs along and between the sides (left and right, top and bottom).
        effects_px: (7,) px: floor; how far white spreads over black at the inner edges; how far the inner print is off
            the middle of the border; scatter of the inner edges; corners off a square's; contrast that differs between
            sides times their width; blur beyond the profiles.
        size_px: mean length of a side.
    """

    width: float
    clipped: float
    uneven: float
    effects_px: Array
    size_px: float

    def covariance(self, p_KM: Array, size_m: float, K: Array) -> Array:
        """Covariance (3,3) m^2 of a tag's position p_KM (3,) m: across the line of sight, and along it by its size."""
        place, size = (float(np.sqrt((gain**2) @ self.effects_px**2)) for gain in (PLACE, SIZE))
        ray = p_KM / p_KM[2]
        across = place * p_KM[2] / float(np.sqrt(K[0, 0] * K[1, 1]))
        along = size / self.size_px * p_KM[2]
        return np.asarray(across**2 * np.diag([1.0, 1.0, 0.0]) + along**2 * np.outer(ray, ray))

    @property
    def blurred(self) -> bool:
        """Whether the ends of the profiles lie in the blur: the covariance is too small there."""
        return self.width > BLURRED

    def cause(self) -> str:
        """The likely cause of a large covariance, and what to do."""
        if self.blurred:
            return "its edges are blurred; focus the camera, or shorten the exposure."
        if self.uneven > UNEVEN:
            glare = self.clipped > CLIPPED
            return f"{'glare or ' if glare else ''}light from one side; shade the camera's window from arc and lamps."
        if self.clipped > CLIPPED:
            return "it is overexposed; shorten the exposure or reduce the gain."
        return "noise or dirt; clean the window and the tag, and give more light."


def picture_quality(
    grey: NDArray[np.uint8], sides: Sides, cells: NDArray[np.bool_], reprojection_px: float
) -> PictureQuality:
    """Judge a picture by the sides of its tag and by the edges inside of the print.

    White that is clipped spreads over black: the border's outline shrinks while its white cells grow. The edges inside
    show by how much, since the true print is known.

    Args:
        grey: (H, W) uint8.
        sides: of the tag's border in it.
        cells: (n, n), the print with its border, True is white.
        reprojection_px: rms distance of the corners from those of the best pose.
    """
    spread, shift, scatter = _inner_effects(grey, sides.corners, cells)
    typical = np.median(sides.contrast, axis=1)
    width = float(sides.width_px.max())
    blur = width / sides.reach_px
    between = 1.0 - float(typical.min() / typical.max())
    effects = [FLOOR_PX, spread, shift, scatter, reprojection_px, between * width, (blur / BLURRED) ** BLUR_POWER]
    return PictureQuality(
        width=blur,
        clipped=float(sides.clipped.max()),
        uneven=1.0 - float(np.divide(*np.quantile(sides.contrast, [0.1, 0.9]))),
        effects_px=np.array(effects),
        size_px=float(np.linalg.norm(sides.corners - np.roll(sides.corners, 1, axis=0), axis=1).mean()),
    )


@lru_cache(maxsize=8)
def _inner_edges(packed: bytes, n: int) -> tuple[Array, Array]:
    """Points (m, SAMPLES, 2 HALF + 1, 2) in cells across the edges inside a print, from white to black.

    Also the offsets (m, 5) of the edges by the spread of white, its gradient (2) and the shift (2) of the print.
    """
    cells = np.frombuffer(packed, dtype=bool).reshape(n, n)
    edges = []
    for k in (0, 1):  # across columns, and across rows
        grid = cells if k == 0 else cells.T
        for row, column in np.argwhere(grid[:, 1:] != grid[:, :-1]):
            ends = np.array([[column + 1, row], [column + 1, row + 1]], dtype=float)
            black = np.array([1.0 if grid[row, column] else -1.0, 0.0])
            edges.append(np.vstack([ends, black])[:, :: 1 if k == 0 else -1])
    start, end, black = np.swapaxes(np.array(edges), 0, 1)
    along, across = np.linspace(_INNER, 1.0 - _INNER, SAMPLES), np.linspace(-REACH, REACH, 2 * HALF + 1)
    on_edge = start[:, None] + along[:, None] * (end - start)[:, None]
    points = on_edge[:, :, None] + across[:, None] * black[:, None, None]
    design = np.column_stack([np.ones(len(edges)), 0.5 * (start + end) / n - 0.5, black])
    return points, design


def _inner_effects(grey: NDArray[np.uint8], corners: Array, cells: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Spread of white, shift and scatter of the edges inside a print with the border's corners (4, 2), in px."""
    n = len(cells)
    points, design = _inner_edges(np.ascontiguousarray(cells).tobytes(), n)
    outline = np.array([[0, 0], [n, 0], [n, n], [0, n]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(outline, corners.astype(np.float32))
    m = len(points)
    pixels = cv2.perspectiveTransform(points.reshape(1, -1, 2), H).reshape(m * SAMPLES, -1, 2).astype(np.float32)
    x, y = np.ascontiguousarray(pixels[:, :, 0]), np.ascontiguousarray(pixels[:, :, 1])
    profiles = cv2.remap(grey.astype(np.float32), x, y, cv2.INTER_LINEAR).reshape(m, SAMPLES, -1).mean(axis=1)
    k = 2 * HALF // 5
    light, dark = profiles[:, :k].mean(axis=1), profiles[:, -k:].mean(axis=1)
    share = (profiles - dark[:, None]) / np.maximum(light - dark, 5.0)[:, None]  # of white; 5 grey levels at least
    reach = np.linalg.norm(pixels[:, -1] - pixels[:, 0], axis=1).reshape(m, SAMPLES).mean(axis=1) / 2.0
    offset = edge_offsets(share, np.linspace(-1.0, 1.0, 2 * HALF + 1)) * reach
    effects = np.linalg.pinv(design) @ offset
    return float(abs(effects[0])), float(np.hypot(*effects[3:])), float(np.std(offset - design @ effects))
