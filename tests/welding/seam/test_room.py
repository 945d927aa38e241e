"""The tool's room at a part: its body beside high walls, tip and torch beyond the seam's ends."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.mesh import TriMesh, extrude, merge
from weldcal.models.tool import WeldingTool
from weldcal.welding.seam.clearance import NoClearance, check_clearance, check_ends
from weldcal.welding.seam.curve import SeamCurve

TOOL = WeldingTool()
X_BP = RigidTransform(RollPitchYaw(0.1, -0.2, 0.7), [0.6, 0.1, 0.05])


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriMesh:
    corners = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
    return extrude(corners, low[2], high[2])


PLATE = block((-0.1, -0.08, -0.01), (0.1, 0.08, 0.0))
WEB = block((-0.1, 0.0, 0.0), (0.1, 0.01, 0.05))


def seam(lean_deg: float = 45.0, low: float = -0.1, high: float = 0.1) -> SeamCurve:
    """The tip's line along the corner of plate and web, in B."""
    a = np.radians(lean_deg)
    up = np.array([0.0, -np.sin(a), np.cos(a)])
    points = np.linspace([low, 0.0, 0.0], [high, 0.0, 0.0], 60) + 0.0033 * up
    return SeamCurve.from_points(points, up=up).transformed(X_BP)


def test_a_tool_that_leans_between_the_walls_has_room() -> None:
    part = merge(PLATE, WEB)
    check_clearance(part, X_BP, seam(), TOOL.capsules(), TOOL.X_FT, TOOL.chord_m)
    check_ends(part, X_BP, seam(), TOOL.chord_m, TOOL.tip_radius_m)


def test_a_body_that_would_touch_the_web_is_refused() -> None:
    high = merge(PLATE, block((-0.1, 0.0, 0.0), (0.1, 0.01, 0.15)))
    check_clearance(high, X_BP, seam(), TOOL.capsules(), TOOL.X_FT, TOOL.chord_m)
    with pytest.raises(NoClearance, match="does not fit at 0 mm"):
        check_clearance(high, X_BP, seam(20.0), TOOL.capsules(), TOOL.X_FT, TOOL.chord_m)


@pytest.mark.parametrize(("x", "says"), [(0.09, "beyond its end.*tip.*end_mm"), (-0.095, "beyond its start.*start_mm")])
def test_a_wall_across_an_end_is_refused_with_what_to_cut(x: float, says: str) -> None:
    part = merge(PLATE, WEB, block((x, -0.05, 0.0), (x + 0.005, 0.0, 0.05)))
    with pytest.raises(NoClearance, match=says):
        check_ends(part, X_BP, seam(low=-0.08, high=0.08), TOOL.chord_m, TOOL.tip_radius_m)
    # 62.5 mm are needed, and 10 mm are free.
    check_ends(part, X_BP, seam(low=-0.026, high=0.026), TOOL.chord_m, TOOL.tip_radius_m)


def ring(inner: float, outer: float, low: float, high: float, turn: tuple[float, float]) -> TriMesh:
    """A bent wall about the z axis."""
    a = np.linspace(*turn, 60)
    rim = np.column_stack([np.cos(a), np.sin(a)])
    return extrude(np.vstack([inner * rim[::-1], outer * rim])[::-1], low, high)


def along_ring(radius: float, lean: float, turn: tuple[float, float], length: float | None = None) -> SeamCurve:
    a = np.linspace(*turn, 60)
    out = np.column_stack([np.cos(a), np.sin(a), 0.0 * a])
    up = lean * out + np.array([0.0, 0.0, 1.0])
    return SeamCurve.from_points(radius * out + 0.0025 * up, up=up, length=length)


@pytest.mark.parametrize(("height", "fits"), [(0.05, False), (0.006, True)])
def test_a_wall_met_at_a_slant_leads_the_tip_on_only_where_it_can_climb_it(height: float, fits: bool) -> None:
    """The seam on the hollow side of a bent web, cut off 90 mm before the web's end: straight on, the tip meets the
    web."""
    web = ring(0.2, 0.21, 0.0, height, (-0.6, 0.6))
    path = along_ring(0.2, -1.0, (-0.5, 0.15))
    if fits:
        return check_ends(web, RigidTransform(), path, TOOL.chord_m, TOOL.tip_radius_m)
    with pytest.raises(NoClearance, match="beyond its end"):
        check_ends(web, RigidTransform(), path, TOOL.chord_m, TOOL.tip_radius_m)
    return None


def test_a_seam_cut_short_is_followed_round_the_bend_as_far_as_it_is_drawn() -> None:
    """The web that is in the way straight on is not where the groove's bend is followed for another 64 mm."""
    web = ring(0.2, 0.21, 0.0, 0.05, (-0.6, 0.6))
    path = along_ring(0.2, -1.0, (-0.5, 0.47), length=0.1284)
    check_ends(web, RigidTransform(), path, TOOL.chord_m, TOOL.tip_radius_m)


def straight_cut(lean_deg: float, drawn_to: float, length: float) -> SeamCurve:
    """The corner of plate and web from x = -0.1 to `drawn_to`, of which `length` is welded."""
    a = np.radians(lean_deg)
    up = np.array([0.0, -np.sin(a), np.cos(a)])
    points = np.linspace([-0.1, 0.0, 0.0], [drawn_to, 0.0, 0.0], 60) + 0.0033 * up
    return SeamCurve.from_points(points, up=up, length=length).transformed(X_BP)


def test_a_wall_past_what_is_drawn_is_measured_from_the_seams_end() -> None:
    part = merge(PLATE, WEB, block((0.07, -0.05, 0.0), (0.075, 0.0, 0.05)))
    with pytest.raises(NoClearance, match=r"50 mm beyond its end.*set welding\.seam_length_mm 14 mm smaller"):
        check_ends(part, X_BP, straight_cut(45.0, 0.05, 0.12), TOOL.chord_m, TOOL.tip_radius_m)
    check_ends(part, X_BP, straight_cut(45.0, 0.05, 0.10), TOOL.chord_m, TOOL.tip_radius_m)


def test_the_tool_has_room_for_its_tip_past_the_end_of_a_seam_cut_short() -> None:
    part = merge(PLATE, block((0.07, 0.0, 0.0), (0.1, 0.01, 0.15)))
    check_clearance(part, X_BP, straight_cut(20.0, 0.1, 0.06), TOOL.capsules(), TOOL.X_FT, TOOL.chord_m)
    with pytest.raises(NoClearance, match=r"does not fit at 1\d\d mm"):
        check_clearance(part, X_BP, straight_cut(20.0, 0.1, 0.09), TOOL.capsules(), TOOL.X_FT, TOOL.chord_m)


def test_a_wall_that_bends_away_is_no_obstacle() -> None:
    web = ring(0.19, 0.2, 0.0, 0.05, (-0.6, 0.6))
    check_ends(web, RigidTransform(), along_ring(0.2, 1.0, (-0.5, 0.15)), TOOL.chord_m, TOOL.tip_radius_m)


def test_the_end_of_a_low_wall_that_the_tip_has_climbed_is_no_obstacle() -> None:
    """The bent rail is left through its end face 50 mm further on: that face is met from within."""
    rail = ring(0.2, 0.26, 0.0, 0.006, (-0.6, 0.52))
    check_ends(rail, RigidTransform(), along_ring(0.2, -1.0, (-0.5, 0.27)), TOOL.chord_m, TOOL.tip_radius_m)
