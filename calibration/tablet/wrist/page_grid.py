"""Derives the page's grid from the touched landmarks: columns, rows and spacing."""

import contextlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.tablet.detection import Look, arrange, find_marks
from weldcal.calibration.tablet.errors import LandmarksNotFound, TabletDataError
from weldcal.models.arrays import Array

MOST_COLUMNS = 30
_ON_GRID_PX = 1.5  # of the page: its landmarks sit on whole device pixels
_MORE_ROWS = 8  # rows below the last touched one that are looked for in the image


def grid_columns(shown_px: Mapping[int, Array]) -> tuple[int, int]:
    """Columns of the page, and rows down to its last touched landmark, from coordinates (2,) px by landmark number.

    A landmark's number is its row times the columns plus its column; x goes with the column and y with the row, evenly, in
    whichever way the page is turned. Raises TabletDataError where no number of columns explains the coordinates.
    """
    numbers = np.array(sorted(shown_px))
    at = np.array([shown_px[k] for k in numbers])
    for columns in range(2, MOST_COLUMNS + 1):
        row, column = np.divmod(numbers, columns)
        if len(set(row)) < 2 or len(set(column)) < 2:
            continue
        A = np.c_[column, row, np.ones(len(numbers))]
        fit, *_ = np.linalg.lstsq(A, at, rcond=None)
        if np.abs(A @ fit - at).max() > _ON_GRID_PX or np.linalg.matrix_rank(A) < 3:
            continue
        right, down = fit[0], fit[1]
        square = abs(right @ down) < 0.02 * np.linalg.norm(right) * np.linalg.norm(down)
        if square and right[0] * down[1] - right[1] * down[0] > 0.0:
            return columns, int(row.max()) + 1
    raise TabletDataError(
        "The numbers and coordinates of the landmarks make no grid row by row from 0; give --seen instead of the picture."
    )


def find_page(grey: NDArray[np.uint8], shown_px: Mapping[int, Array], look: Look) -> Array:
    """Positions (n, 2) px in the image (h, w) of all of the page's landmarks, in their order.

    Rows that nobody touched are not in the file, but they are in the image: the page has as many rows as are found.
    Raises LandmarksNotFound, TabletDataError.
    """
    columns, rows = grid_columns(shown_px)
    points, full = find_marks(grey, columns * (rows + _MORE_ROWS), look)
    for more in range(_MORE_ROWS, 0, -1):
        if len(points) >= columns * (rows + more):
            with contextlib.suppress(LandmarksNotFound):
                return arrange(points, full, columns, rows + more)
    return arrange(points, full, columns, rows)
