"""Marks missing points and finds the sensor's grid in a list of points that keeps them."""

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.cloud_files.body import CloudError
from weldcal.models.arrays import Array

_SAMPLE = 4000  # pairs of neighbours that are compared
_SIDE = 8  # points of the shortest side of a grid, and the largest ratio of its sides
_FAR = 0.25  # largest distance of neighbours, in distances of any two points
_NEAR = 4.0  # distance of neighbours in a column, in distances of neighbours in a row
_SHARE = 0.9  # of the pairs that must be so near
_CLEAR = 1.25  # by which the next best width must be worse


def measured(points: Array, name: str) -> Array:
    """The points without missing ones: NaN in a grid, left out of a list; a list in the sensor's order becomes its
    grid.

    Args:
        points: (N, 3), or organised (H, W, 3). A point with NaN, or at 0 0 0 (the camera's centre), was not measured.
        name: the cloud's name in messages.

    Returns:
        (N, 3) of finite points, or (H, W, 3) with NaN where nothing was measured.

    Raises:
        CloudError: nothing was measured.
    """
    flat = points.reshape(-1, 3)
    x, y, z = flat.T  # whole columns: reductions over three numbers take several times as long
    sums = x + y
    sums += z
    missing = np.isnan(sums)
    nothing = np.flatnonzero(sums == 0.0)
    missing[nothing] = ~flat[nothing].any(axis=1)
    if missing.all():
        raise CloudError(f"Every point of {name} is missing (NaN or 0 0 0): nothing was measured; scan again.")
    if not missing.any():
        return points
    width = points.shape[1] if points.ndim == 3 else sensor_width(flat, ~missing)
    if width is None:
        return flat[~missing]
    out = flat if flat.flags.writeable else flat.copy()
    out[missing] = np.nan
    return out.reshape(-1, width, 3)


def sensor_width(points: Array, valid: NDArray[np.bool_], widths: tuple[int, ...] = ()) -> int | None:
    """Width of the grid in which points (N, 3) follow each other row by row; None where they do not.

    In a grid the point one row below is about as near as the next one, and both are much nearer than any two points.
    That tells the width among the divisors of N.

    Args:
        valid: which points were measured (N).
        widths: the widths that are tried; without them every divisor of N that makes a grid of usual proportions.
    """
    n = len(points)
    starts = np.flatnonzero(valid[:-1] & valid[1:])
    starts = starts[:: 1 + len(starts) // _SAMPLE]
    tried = widths or _widths(n)
    if len(starts) < _SIDE or not tried:
        return None
    pitch = float(np.median(np.linalg.norm(points[starts + 1] - points[starts], axis=1)))
    others = points[np.roll(starts, len(starts) // 2)]
    spread = float(np.median(np.linalg.norm(points[starts] - others, axis=1)))
    if not 0.0 < pitch < _FAR * spread:
        return None
    found: list[tuple[float, float, int]] = []
    for width in tried:
        below = starts[starts + width < n]
        below = below[valid[below + width]]
        if 2 * len(below) < len(starts) or len(below) < _SIDE:
            continue
        steps = np.linalg.norm(points[below + width] - points[below], axis=1) / pitch
        found.append((float(np.median(steps)), float(np.mean(steps < _NEAR)), width))
    found.sort()
    if (
        not found
        or found[0][1] < _SHARE
        or found[0][0] * pitch > _FAR * spread
        or (len(found) > 1 and found[1][0] < _CLEAR * found[0][0])
    ):
        return None
    return found[0][2]


def _widths(n: int) -> tuple[int, ...]:
    low = np.arange(_SIDE, int(np.sqrt(n)) + 1)
    low = low[n % low == 0] if len(low) else low
    both = sorted({*low.tolist(), *(n // low).tolist()})
    return tuple(w for w in both if max(w, n // w) <= _SIDE * min(w, n // w))
