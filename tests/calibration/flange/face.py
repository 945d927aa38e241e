"""Points on a flange's face, as a scanner without errors has them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from weldcal.models.flanges import FlangeStandard


def face_points(standard: FlangeStandard, spacing_m: float) -> NDArray[np.float64]:
    """(N,3) points in R on a hexagonal lattice over the flat face: between the chamfers and clear of every hole."""
    rows = math.ceil(standard.face_outer_radius_m / (spacing_m * math.sqrt(0.75))) + 1
    columns = math.ceil(standard.face_outer_radius_m / spacing_m) + 1
    j, i = np.mgrid[-rows : rows + 1, -columns : columns + 1]
    xy = np.stack([(i + 0.5 * (j % 2)) * spacing_m, j * math.sqrt(0.75) * spacing_m], axis=-1).reshape(-1, 2)
    reach = np.hypot(xy[:, 0], xy[:, 1])
    keep = (reach >= standard.face_inner_radius_m) & (reach <= standard.face_outer_radius_m)
    for x, y, radius in standard.openings():
        keep &= np.hypot(xy[:, 0] - x, xy[:, 1] - y) >= radius
    return np.column_stack([xy[keep], np.zeros(np.count_nonzero(keep))])
