"""A weld that broke off goes on over its crater: its torch is led by what was felt before, and a moved part is refused."""

from __future__ import annotations

import numpy as np
import pytest

from tests.broken_seam import broken_off
from tests.worlds.weld.budgets import NOMINAL
from weldcal.welding.servo.felt_before import MOVED_M


@pytest.mark.parametrize(
    ("name", "at_m", "kind", "seed"),
    # in the second, the tip had felt nothing where the arc begins, and the second plan's start is 2 mm off
    [("straight", 0.005, "kill", 3), ("corner", 1.731e-3, "kill", 7345), ("corner", 0.050, "stop", 3)],
)
def test_a_broken_weld_goes_on_over_its_crater(name: str, at_m: float, kind: str, seed: int) -> None:
    join = broken_off(name, at_m, kind, seed, NOMINAL)
    assert join.reason is None
    assert join.across_mm <= 0.3
    assert abs(join.along_mm) <= 1.0


def test_a_part_that_was_moved_aside_is_refused_before_the_arc() -> None:
    join = broken_off("straight", 0.005, "stop", 3, NOMINAL, moved_m=1.5 * MOVED_M)
    assert "was moved" in (join.reason or "")
    assert np.isinf(join.across_mm), "no arc"
