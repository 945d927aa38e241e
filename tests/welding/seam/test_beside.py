"""Things beside a seam that only the scan shows, by a ray caster and a tool whose distance is computed apart."""

from __future__ import annotations

import pytest

from tests.welding.seam.obstacles import CLEAR_M, scene


@pytest.mark.parametrize("seed", range(8))
def test_what_the_tool_would_touch_is_refused_and_nothing_else(seed: int) -> None:
    found = scene(seed)
    if found.away_m < 0.0:
        assert "The tool would touch something that is not in the drawing" in found.refusal, found
    if found.away_m > CLEAR_M:
        assert found.refusal == "", found
