"""Draws the weld gauge: torch speed and n_d . n_t along the seam so far, as a picture for a board in the viewer."""

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array

Picture = NDArray[np.uint8]
WIDTH_PX, HEIGHT_PX = 1024, 400
_INK, _SOFT, _GROUND = (240, 240, 240), (150, 145, 140), (46, 38, 33)  # BGR, as in the phase labels
_BAND, _SPEED, _MEASURE, _ZERO = (70, 62, 56), (66, 145, 242), (235, 190, 110), (90, 90, 240)
_LEFT, _RIGHT = 60, 990
_FONT = cv2.FONT_HERSHEY_DUPLEX


def gauge_picture(s: Array, speed: Array, n_d_dot_n_t: Array, s_end: float, weld_speed: float) -> Picture:
    """Draw the gauge as a (400, 1024, 3) uint8 BGR image.

    Args:
        s: (N,) arc length of the torch along the seam, m, negative before its start.
        speed: (N,) torch speed, m/s; NaN while the arc was off. n_d_dot_n_t: (N,).
        s_end: the seam's length, m; weld_speed: the target speed, m/s.
    """
    board = np.full((HEIGHT_PX, WIDTH_PX, 3), _GROUND, dtype=np.uint8)
    span = (min(-0.01, float(s.min(initial=0.0))), max(s_end, 0.01))
    now = speed[-1] if len(speed) else np.nan
    value = "arc off" if np.isnan(now) else f"{1e3 * now:.2f} mm/s"
    _strip(board, 20, f"torch speed  {value}", s, speed, span, (0.0, 1.5 * weld_speed), _SPEED)
    _dashed(board, 20, span, (0.0, 1.5 * weld_speed), weld_speed)
    now = n_d_dot_n_t[-1] if len(n_d_dot_n_t) else np.nan
    value = "" if np.isnan(now) else f"{now:.2f}"
    _strip(board, 210, f"n_d . n_t  {value}", s, n_d_dot_n_t, span, (-0.25, 1.25), _MEASURE)
    _dashed(board, 210, span, (-0.25, 1.25), 0.0)
    zero = _place(np.array([span[0], span[1]]), np.zeros(2), span, (-0.25, 1.25), 210)[0]
    cv2.putText(board, "0", (_LEFT - 28, int(zero[1]) + 8), _FONT, 0.7, _INK, 1, cv2.LINE_AA)
    # Fewer shades at antialiased edges make the image smaller; a recording holds one a second.
    return (np.minimum(board, 243) + 6) // 12 * 12


def _place(x: Array, y: Array, span: tuple[float, float], reach: tuple[float, float], top: int) -> NDArray[np.int32]:
    """Pixels (N,2) of values in the strip whose heading is at `top`."""
    across = _LEFT + (_RIGHT - _LEFT) * (x - span[0]) / (span[1] - span[0])
    share = np.clip((y - reach[0]) / (reach[1] - reach[0]), 0.0, 1.0)
    return np.column_stack([across, top + 165 - 120 * share]).round().astype(np.int32)


def _strip(
    board: Picture,
    top: int,
    heading: str,
    x: Array,
    y: Array,
    span: tuple[float, float],
    reach: tuple[float, float],
    colour: tuple[int, int, int],
) -> None:
    cv2.rectangle(board, (_LEFT, top + 45), (_RIGHT, top + 165), _BAND, -1)
    cv2.putText(board, heading, (_LEFT, top + 33), _FONT, 1.35, _INK, 2, cv2.LINE_AA)
    good = np.isfinite(x) & np.isfinite(y)
    if good.sum() > 1:
        cv2.polylines(board, [_place(x[good], y[good], span, reach, top)], False, colour, 6, cv2.LINE_AA)


def _dashed(board: Picture, top: int, span: tuple[float, float], reach: tuple[float, float], level: float) -> None:
    """Draw a dashed line at the target speed, or at zero, where the published law divides by n_d . n_t."""
    (x0, y), (x1, _) = _place(np.array(span), np.full(2, level), span, reach, top).tolist()
    colour = _ZERO if level == 0.0 else _SOFT
    for x in range(x0, x1, 24):
        cv2.line(board, (x, y), (min(x + 12, x1), y), colour, 2)
