"""The world's truth compares each burn of the arc with its own seam and pass."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from weldcal.tools.emulators.cell import physics
from weldcal.welding.passes.felt import WeldPass
from weldcal.welding.seam.curve import SeamCurve

UP = np.array([0.0, 0.0, 1.0])


def line(y_m: float) -> np.ndarray:
    return np.column_stack([np.linspace(0.0, 0.1, 41), np.full(41, y_m), np.zeros(41)])


def test_each_burn_is_of_the_nearest_seam_and_its_next_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    seams = [SeamCurve.from_points(line(y), up=np.tile(UP, (41, 1))) for y in (0.0, 0.3)]
    monkeypatch.setattr(physics, "_seams", lambda _: seams)
    order = WeldPass(lateral_m=2e-3, vertical_m=3e-3, reverse=True)
    side = seams[0].normal(0.05) * 2e-3 + UP * 3e-3
    cap = (line(0.0) + side)[::-1] + UP * 1e-4
    world: Any = SimpleNamespace(burns=[line(0.0), line(0.3) + UP * 2e-4, cap, line(0.0)[:5]], passes=(order,))
    found = physics._of_burns(world)
    assert [numbers for numbers, _ in found] == [(0, 0), (1, 0), (0, 1)]  # the last is too short to judge
    assert [1e3 * error.distance_m.max() for _, error in found] == pytest.approx([0.0, 0.2, 0.1], abs=0.01)
    assert found[2][1].s[0] > found[2][1].s[-1]
