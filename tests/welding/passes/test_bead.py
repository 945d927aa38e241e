"""The bead model against areas counted on a grid of points."""

from __future__ import annotations

import math

import numpy as np
import pytest

from weldcal.welding.passes.bead import WIDEST_M, bead_area, bead_places, fill_height, propose_passes
from weldcal.welding.passes.felt import PassError

V, FILLET = math.radians(30.0), math.radians(45.0)
GRID_M = 2e-5


def wedge(half_angle: float, from_m: float, to_m: float) -> np.ndarray:
    """Points (N, 2) of a grid between two walls: x from the bisector, y over the root."""
    y, x = np.arange(0.5 * GRID_M, to_m, GRID_M), np.arange(-to_m, to_m, GRID_M) + 0.5 * GRID_M
    xs, ys = np.meshgrid(x * math.tan(half_angle), y)
    inside = (ys > from_m) & (np.abs(xs) < ys * math.tan(half_angle))
    return np.column_stack([xs[inside], ys[inside]])


@pytest.mark.parametrize("half_angle", [V, FILLET])
def test_an_area_fills_the_wedge_up_to_its_height(half_angle: float) -> None:
    height = fill_height(20e-6, half_angle)
    assert len(wedge(half_angle, 0.0, height)) * GRID_M**2 * math.tan(half_angle) == pytest.approx(20e-6, rel=0.01)


def test_a_bead_has_the_volume_of_its_wire() -> None:
    # 8 m/min of 1.2 mm wire for 60 s, over 480 mm
    assert bead_area(8.0 / 60.0, 1.2e-3, 8e-3) * 0.48 == pytest.approx(8.0 * math.pi * 0.6e-3**2)


@pytest.mark.parametrize("half_angle", [V, FILLET])
@pytest.mark.parametrize("beads", [1, 2, 3])
def test_beads_lie_at_the_centroids_of_equal_areas(half_angle: float, beads: int) -> None:
    points = wedge(half_angle, 6e-3, 9e-3)
    parts = np.array_split(np.sort(points[:, 0]), beads)
    assert bead_places(6e-3, 9e-3, half_angle, beads) == pytest.approx([part.mean() for part in parts], abs=2e-5)


@pytest.mark.parametrize("half_angle", [V, FILLET])
def test_the_proposal_fills_the_joint_with_beads_of_the_allowed_width(half_angle: float) -> None:
    areas, depth = [12e-6, 20e-6], 15e-3
    passes = propose_passes(areas, half_angle, depth)
    total = areas[0] + areas[1] * len(passes)
    assert total >= math.tan(half_angle) * depth**2, "full"
    heights = sorted({p.vertical_m for p in passes})
    layers = [sum(p.vertical_m == height for p in passes) for height in heights]
    assert total - areas[1] * layers[-1] < math.tan(half_angle) * depth**2, "and no layer too many"
    filled = areas[0]
    for height, beads in zip(heights, layers, strict=True):
        # a layer starts on the surface of those before it
        assert len(wedge(half_angle, 0.0, height)) * GRID_M**2 * math.tan(half_angle) == pytest.approx(filled, rel=0.02)
        filled += beads * areas[1]
        top = math.sqrt(filled / math.tan(half_angle))
        assert (height + top) * math.tan(half_angle) / beads <= WIDEST_M
    assert max(layers) > 1
    assert sum(p.lateral_m for p in passes) == pytest.approx(0.0, abs=1e-9)


def test_a_joint_without_walls_is_refused() -> None:
    with pytest.raises(PassError, match="walls with an angle"):
        propose_passes([20e-6], 0.5 * math.pi, 0.01)
