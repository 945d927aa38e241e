"""Things beside a seam that only the scan shows, by a ray caster and a tool whose distance is computed apart."""

from __future__ import annotations

import re

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.welding.seam.obstacles import CLEAR_M, scene
from weldcal.models.mesh import extrude
from weldcal.models.tools.loading import WELDING, load_tool
from weldcal.welding.seam.clearance import NoClearance, check_beside
from weldcal.welding.seam.curve import SeamCurve


@pytest.mark.parametrize("seed", range(8))
def test_what_the_tool_would_touch_is_refused_and_nothing_else(seed: int) -> None:
    found = scene(seed)
    if found.away_m < 0.0:
        assert "The tool would touch something that is not in the drawing" in found.refusal, found
    if found.away_m > CLEAR_M:
        assert found.refusal == "", found


def test_a_part_raised_as_advised_clears_the_table_and_one_raised_less_does_not() -> None:
    """A seam on the side of a block, 20 mm over the table: the tool stands level beside it."""
    tool, x, y = load_tool(WELDING).tool, np.arange(-0.3, 0.3, 0.004), np.arange(-0.3, 0.3, 0.004)
    table = np.stack(np.meshgrid(x, y, [0.0]), axis=-1).reshape(-1, 3)
    block = extrude(np.array([[-0.1, 0.0], [0.1, 0.0], [0.1, 0.1], [-0.1, 0.1]]), 0.0, 0.04)
    line = np.column_stack([np.linspace(-0.05, 0.05, 21), np.full(21, -0.01), np.full(21, 0.02)])

    def raised(height_m: float) -> None:
        up = np.tile([0.0, -1.0, 0.0], (len(line), 1))
        seam = SeamCurve.from_points(np.add(line, [0.0, 0.0, height_m]), up=up)
        check_beside(table, block, RigidTransform([0.0, 0.0, height_m]), seam, tool, 0.0, 0.0)

    with pytest.raises(NoClearance, match="raise the part by") as refused:
        raised(0.0)
    advice = re.search(r"raise the part by (\d+) mm", str(refused.value))
    assert advice is not None
    raised(1e-3 * int(advice[1]))
    with pytest.raises(NoClearance, match="touch the table"):
        raised(1e-3 * int(advice[1]) - 0.008)
