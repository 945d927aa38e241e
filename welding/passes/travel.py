"""Order the seams of a job by the least travel of the tool between them."""

import math
from itertools import pairwise, permutations
from typing import NamedTuple

import numpy as np

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array

MOST_SEAMS = 8  # a choice: 40320 orders take about a second
_ROUNDING_M = 1e-9  # of the sums


class SeamTravel(NamedTuple):
    """The order of seams by their numbers from 0, the tool's travel in it, and in the order as listed, m."""

    order: tuple[int, ...]
    travel_m: float
    listed_m: float

    @property
    def words(self) -> str:
        """Which order was taken, as the end of a sentence; empty for one seam."""
        if len(self.order) < 2:
            return ""
        named, saved = ", ".join(str(k + 1) for k in self.order), 1e3 * (self.listed_m - self.travel_m)
        return f"seams in the order {named}, {saved:.0f} mm of travel less than as listed"


def seam_travel(starts: Array, ends: Array, home: Array, searched: bool) -> SeamTravel:
    """The order of seams with the least travel from home to each start, from its end to the next, and home.

    Args:
        starts, ends: (n, 3) m, of the seams; home: (3,) m, of the tip. All ways are straight.
        searched: else the order is as listed.

    Raises:
        InputError: too many seams to search.
    """
    n = len(starts)
    if searched and n > MOST_SEAMS:
        raise InputError(
            f"welding.seam_order: least_travel orders {MOST_SEAMS} seams at most, and the part has {n}: write given."
        )
    # from an end, or home, to a start; and home
    away: list[list[float]] = np.linalg.norm(starts[None] - np.vstack([ends, home])[:, None], axis=2).tolist()
    back: list[float] = np.linalg.norm(ends - home, axis=1).tolist()

    def travel(order: tuple[int, ...]) -> float:
        return away[n][order[0]] + math.fsum(away[a][b] for a, b in pairwise(order)) + back[order[-1]]

    listed = tuple(range(n))
    least, listed_m = listed, travel(listed)
    if searched:
        best = min(permutations(listed), key=travel)
        least = best if travel(best) < listed_m - _ROUNDING_M else listed
    return SeamTravel(least, travel(least), listed_m)
