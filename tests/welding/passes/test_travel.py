"""The order of seams against every order, summed up with distances of its own."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest

from weldcal.models.errors import InputError
from weldcal.welding.passes.travel import MOST_SEAMS, seam_travel

HOME: tuple[float, ...] = (0.3, -0.4, 0.5)


def way(seams: Sequence[tuple[tuple[float, ...], tuple[float, ...]]], order: tuple[int, ...]) -> float:
    """Length of the polyline home, first start; first end, next start; ...; last end, home."""
    at, total = HOME, 0.0
    for k in order:
        total += math.dist(at, seams[k][0])
        at = seams[k][1]
    return total + math.dist(at, HOME)


@pytest.mark.parametrize("seed", range(5))
def test_no_other_order_has_less_travel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 2 + seed
    seams = [(tuple(a), tuple(b)) for a, b in rng.uniform(-0.3, 0.3, (n, 2, 3)).tolist()]
    starts, ends = (np.array([seam[k] for seam in seams]) for k in (0, 1))
    found = seam_travel(starts, ends, np.array(HOME), True)
    every = {order: way(seams, order) for order in itertools.permutations(range(n))}
    assert found.travel_m == pytest.approx(min(every.values()), abs=1e-12)
    assert every[found.order] == pytest.approx(found.travel_m, abs=1e-12)
    assert found.listed_m == pytest.approx(way(seams, tuple(range(n))), abs=1e-12)
    listed = seam_travel(starts, ends, np.array(HOME), False)
    assert listed.order == tuple(range(n))
    assert listed.travel_m == listed.listed_m


def test_the_saving_is_said() -> None:
    seams = [((x, 0.0, 0.0), (x, 0.1, 0.0)) for x in (0.0, 0.4, 0.1, 0.5)]  # side by side, listed to and fro
    starts, ends = (np.array([seam[k] for seam in seams]) for k in (0, 1))
    found = seam_travel(starts, ends, np.array(HOME), True)
    saved = 1e3 * (way(seams, (0, 1, 2, 3)) - way(seams, found.order))
    assert saved > 300.0
    named = ", ".join(str(k + 1) for k in found.order)
    assert found.words == f"seams in the order {named}, {saved:.0f} mm of travel less than as listed"


def test_more_seams_than_can_be_searched_are_refused() -> None:
    ends = np.zeros((MOST_SEAMS + 1, 3))
    assert seam_travel(ends, ends, np.zeros(3), False).order == tuple(range(MOST_SEAMS + 1))
    with pytest.raises(InputError, match="8 seams at most"):
        seam_travel(ends, ends, np.zeros(3), True)
