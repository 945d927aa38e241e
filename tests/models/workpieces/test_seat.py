"""The seat of the tip in a joint: against brute force, against the closed form of a V, and every refusal by name."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from weldcal.models.tool import WeldingTool
from weldcal.models.workpieces.seat import (
    JointNotWeldable,
    JointSection,
    Press,
    check_weldable,
    face_forces,
    hard_height,
    press_for,
    seat,
)

TOOL = WeldingTool()
R = TOOL.tip_radius_m
JOINTS = {
    "v": JointSection(math.radians(22.5), 0.0087, 0.0087),
    "fillet": JointSection(math.radians(45.0), 0.02, 0.02),
    "lap": JointSection(math.radians(45.0), 0.004, 0.02),
    "flat": JointSection(math.radians(60.0), 0.02, 0.02),
    "gap": JointSection(math.pi / 2, 0.01, 0.01, 0.003),
}


@pytest.mark.parametrize("name", JOINTS)
def test_a_hard_ball_rests_where_its_energy_is_least(name: str) -> None:
    section = JOINTS[name]
    press = press_for(section, TOOL)
    load = np.array([TOOL.lateral_stiffness_N_per_m * press.lateral_m, -TOOL.axial_stiffness_N_per_m * press.axial_m])
    # Every centre on a grid of 10 um, between the walls, at which the ball cuts no face; the faces as dense points.
    x, y = np.meshgrid(np.arange(-0.001, 0.001, 1e-5), np.arange(0.0005, 0.008, 1e-5), indexing="ij")
    centres = np.column_stack([x.ravel(), y.ravel()])
    segments, _ = section.faces()
    walls = np.concatenate([a + np.linspace(0.0, 1.0, 4001)[:, None] * (b - a) for a, b in segments])
    walls = walls[np.linalg.norm(walls, axis=1) < 0.012]
    from scipy.spatial import cKDTree

    # On the wrong side of a wall nothing is free either: keep what lies above the joint.
    centres = centres[centres[:, 1] > 0.5 * hard_height(section, R)]
    # No wall nearer than the radius: the tree need not find the one that is nearest.
    lowest = centres[np.isinf(cKDTree(walls).query(centres, distance_upper_bound=R - 1e-6)[0])]
    best = lowest[np.argmin(-lowest @ load)]
    hard = seat(section, replace(TOOL, tip_modulus_Pa=1e12), press)
    assert [hard.aside_m, hard.above_m] == pytest.approx(best.tolist(), abs=2.5e-5)
    assert hard.above_m == pytest.approx(hard_height(section, R), abs=1e-5)


def test_in_a_v_groove_it_is_the_closed_form() -> None:
    tool = replace(TOOL, groove_half_angle_rad=JOINTS["v"].half_angle_rad)
    seated = seat(JOINTS["v"], tool, Press(tool.press_axial_m, tool.press_lateral_m))
    assert seated.aside_m == pytest.approx(tool.seat.aside_m, abs=1e-9)
    assert seated.above_m == pytest.approx(hard_height(JOINTS["v"], R) - tool.seat_sink_m, abs=1e-9)


@pytest.mark.parametrize("centre", [(0.0003, 0.0019), (-0.0004, 0.0021), (0.0, 0.0016)])
def test_the_force_of_the_faces_is_the_integral_of_the_pressure(centre: tuple[float, float]) -> None:
    section = JOINTS["gap"]
    segments, normals = section.faces()
    force = face_forces(np.array(centre), segments, normals, R, TOOL.tip_modulus_Pa)
    step = 1e-5
    z = np.arange(-R, R, step) + 0.5 * step
    summed = np.zeros(2)
    for (a, b), n in zip(segments, normals, strict=True):
        length = min(float(np.linalg.norm(b - a)), 0.004)
        u = np.arange(0.0, length, step) + 0.5 * step
        at = a + u[:, None] * (b - a) / np.linalg.norm(b - a)
        p2 = np.sum((at - centre) ** 2, axis=1)
        pressure = TOOL.tip_modulus_Pa * np.maximum(1.0 - np.sqrt(p2[:, None] + z[None] ** 2) / R, 0.0)
        summed += pressure.sum() * step**2 * n
    assert force == pytest.approx(summed, rel=2e-3, abs=2e-4)


def test_a_wall_that_ends_at_the_ball_carries_less() -> None:
    whole, ends = JointSection(math.radians(45.0), 0.02, 0.02), JointSection(math.radians(45.0), 0.0026, 0.02)
    press = Press(0.004, 0.001)
    assert seat(ends, TOOL, press).aside_m > seat(whole, TOOL, press).aside_m + 1e-5


@pytest.mark.parametrize(
    ("section", "says"),
    [
        (JointSection(math.pi / 2, 0.01, 0.01, 0.0036), "falls through"),
        (JointSection(math.pi / 2, 0.0002, 0.0002, 0.003), "touches the ground"),
        (JointSection(math.pi / 2, 0.01, 0.01, 0.0), "without a gap"),
        (JointSection(math.pi / 2, 0.01, 0.01, 0.001), "too narrow to be felt"),
        (JointSection(math.radians(78.0), 0.02, 0.02), "too flat"),
        (JointSection(math.radians(8.0), 0.03, 0.03), "opens only"),
        (JointSection(math.radians(45.0), 0.0025, 0.02), "needs walls of 2.9 mm.* the left wall ends 2.5 mm"),
        (JointSection(math.radians(22.5), 0.02, 0.006), "right wall ends"),
    ],
)
def test_a_joint_that_cannot_be_felt_is_named(section: JointSection, says: str) -> None:
    with pytest.raises(JointNotWeldable, match=says):
        check_weldable(section, R)


def test_the_press_keeps_both_walls() -> None:
    for section in JOINTS.values():
        press = press_for(section, TOOL)
        sideways = TOOL.lateral_stiffness_N_per_m * press.lateral_m
        down = TOOL.axial_stiffness_N_per_m * press.axial_m
        slope = (
            math.tan(math.asin(0.5 * section.gap_m / R)) if section.gap_m else 1.0 / math.tan(section.half_angle_rad)
        )
        assert sideways <= 0.51 * down * slope
    with pytest.raises(JointNotWeldable, match="climbs out"):
        press_for(JOINTS["fillet"], TOOL, 0.003, 0.002)
    with pytest.raises(JointNotWeldable, match="too little"):
        press_for(JointSection(math.pi / 2, 0.01, 0.01, 0.0014), TOOL)
    assert press_for(JOINTS["fillet"], TOOL, 0.0045, 0.0012) == Press(0.0045, 0.0012)
