"""Follows a bead along its seam: stations, sections across it, and what the neighbours of a profile predict."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes

from weldcal.calibration.errors import InconsistentData
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.profiler.motion import Floats

REACH_M = 5e-3  # to each side, along which the seam's direction is taken
NEIGHBOURS, FEWEST = 10, 5  # profiles that predict one, on both sides where there are; profiles that can at all
_ALONG = 0.4  # share of a section across the travel below which its pose is another profile's: 66 deg aslant
UNLIKE, ALIKE = 5.0, 0.02  # what is left out of a profile unlike the others: sigmas, and share of the value


@dataclass(frozen=True, eq=False, kw_only=True)
class BeadCourse:
    """A bead's profiles along the seam.

    Attributes:
        station: of each profile along the seam, m; its number where no pose is known, (n,).
        values, sigmas: width m, height m and area m2 across the seam, (n, 3).
        left_out: of each value, less what the neighbours predict, (n, 3); NaN where there are too few.
        unlike: which profiles are unlike their neighbours, (k,).
    """

    station: Floats
    values: Floats
    sigmas: Floats
    left_out: Floats
    unlike: NDArray[np.int64]


def bead_course(
    values: Floats, sigmas: Floats, number: NDArray[np.int64], points_B: Floats | None = None
) -> BeadCourse:
    """Order the profiles' values along the seam.

    Args:
        values: width m, height m and area m2 of each profile, (n, 3); sigmas: of each.
        number: of each profile, (n,).
        points_B: toes, crown and the plate below it in the base, (n, 4, 3) m; None where no pose is known.

    Raises:
        InconsistentData: the profiles lie along the travel of their poses.
    """
    station = np.asarray(number, np.float64)
    if points_B is not None:
        station, across = _placed(points_B)
        values, sigmas = values * across, sigmas * across
    left = np.full(values.shape, np.nan)
    n = len(station)
    for k in range(n) if n >= FEWEST else ():
        first = int(np.clip(k - NEIGHBOURS // 2, 0, max(n - NEIGHBOURS - 1, 0)))
        others = np.delete(np.arange(first, min(first + NEIGHBOURS + 1, n)), k - first)
        left[k] = [v[k] - theilslopes(v[others], station[others] - station[k])[1] for v in values.T]
    scale = np.maximum(MAD * np.median(np.abs(left), axis=0), np.median(sigmas, axis=0))
    limit = np.maximum(UNLIKE * scale, ALIKE * np.median(values, axis=0))
    unlike = np.flatnonzero((np.abs(left) > limit).any(axis=1))
    return BeadCourse(station=station, values=values, sigmas=sigmas, left_out=left, unlike=unlike)


def bead_volume(course: BeadCourse, number: NDArray[np.int64]) -> tuple[float, float, float]:
    """Return volume m3, its sigma and the length m that it is of: between profiles that follow each other."""
    step = np.where(np.diff(number) == 1, np.abs(np.diff(course.station)), 0.0)
    weight = 0.5 * (np.append(step, 0.0) + np.insert(step, 0, 0.0))
    return float(weight @ course.values[:, 2]), float(np.linalg.norm(weight * course.sigmas[:, 2])), float(step.sum())


def _placed(points_B: Floats) -> tuple[Floats, Floats]:
    """Return the stations (n,) m along the middles of the toes, and what turns an oblique section across, (n, 3)."""
    middle = points_B[:, :2].mean(axis=1)
    step, k = np.diff(middle, axis=0), np.arange(len(middle))
    apart = float(np.median(np.linalg.norm(step, axis=1))) if len(step) else np.inf
    reach = int(np.clip(np.ceil(REACH_M / max(apart, 1e-9)), 1, len(k)))
    tangent = _unit(middle[np.minimum(k + reach, k[-1])] - middle[np.maximum(k - reach, 0)])
    wide, up = _unit(points_B[:, 1] - points_B[:, 0]), points_B[:, 2] - points_B[:, 3]
    up = _unit(up - np.sum(up * wide, axis=1, keepdims=True) * wide)
    width = np.linalg.norm(np.cross(wide, tangent), axis=1)
    if len(width) > 2 and np.median(width) < _ALONG:
        raise InconsistentData(
            "The profiles lie along the travel of their poses, not across it. Give the poses of these profiles, in"
            " their order and form, and the calibration of this profiler."
        )
    area = np.abs(np.sum(tangent * np.cross(wide, up), axis=1))
    station = np.concatenate([[0.0], np.cumsum(np.sum(step * (tangent[:-1] + tangent[1:]), axis=1) / 2.0)])
    return station, np.column_stack([width, area / width, area])


def _unit(v: Floats) -> Floats:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1), 1e-12)[:, None])
