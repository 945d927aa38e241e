"""A tool on a ring: its chord, pitch and travel angle in closed form, the ends of a measured ring, and the least pipe
of a tool."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from weldcal.models.arrays import Array
from weldcal.models.tools.loading import load_tool, tool_file
from weldcal.welding.numerics import pose
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.seam.curve import SeamCurve, ringed
from weldcal.welding.seam.feasibility import InfeasibleSeam, SeamWindows, assess_seam
from weldcal.welding.servo.settings import DeflectionControl, MotionLimits, ServoConfig, ToolGeometry, TouchOnConfig
from weldcal.welding.servo.state import WeldingState
from weldcal.welding.servo.tool_axes import check_travel, least_pipe_m
from weldcal.welding.servo.touch import touch_start_pose
from weldcal.welding.servo.track import TorchTarget, guarded_motion

D, V = 0.025, 0.008
PRESS = DeflectionControl(delta_d_m=1e-3, axial_d_m=4e-3)
SINK_M = 1e-3  # of the torch below the tip's line


def circle(radius: float, points: int = 361) -> tuple[Array, Array]:
    """A ring, and the bisector 45 deg up and out of it; its inside is on the left."""
    a = np.linspace(0.0, 2.0 * math.pi, points)
    out = np.column_stack([np.cos(a), np.sin(a), np.zeros(points)])
    return radius * out, (out + np.array([0.0, 0.0, 1.0])) / math.sqrt(2.0)


def ring(radius: float) -> SeamCurve:
    line, ups, turn = ringed(*circle(radius))
    return SeamCurve.from_points(line, up=ups, length=turn)


def travel_rad(radius: float, height: float = -1.5e-3) -> float:
    """The torch's pitch, rad: rest point and torch on circles of their own, a chord apart (law of cosines)."""
    side = math.sqrt(0.5)
    drop, left, sink = PRESS.axial_d_m, PRESS.delta_d_m, SINK_M
    r_rest, z_rest = radius - side * (drop + left), side * (left - drop)
    r_wire, z_wire = radius - side * sink, -side * sink
    flat2 = D**2 + height**2 - (z_rest - z_wire) ** 2
    cos = (r_rest**2 + r_wire**2 - flat2) / (2.0 * r_rest * r_wire)
    dip = side * (r_rest * cos - r_wire + z_rest - z_wire) / math.hypot(D, height)
    return math.asin(dip) + math.atan2(height, D)  # x of the tool is turned from the chord by its height


@pytest.mark.parametrize("radius", [0.020, 0.030, 0.060])
def test_a_chord_on_a_ring_is_as_in_closed_form(radius: float) -> None:
    chart = chord_map(ring(radius), D, V)
    k = len(chart.turn) // 2
    half = math.asin(D / (2.0 * radius))
    # the turn is about the bisector, 45 deg off the ring's axis
    assert chart.turn[k] == pytest.approx(
        math.atan2(math.sqrt(0.5) * math.sin(2.0 * half), math.cos(2.0 * half)), abs=1e-4
    )
    assert chart.conditioning[k] == pytest.approx(math.sqrt(2.0) * math.cos(half), abs=1e-4)
    assert chart.travel[k] == pytest.approx(-math.asin(math.sqrt(0.5) * math.sin(half)), abs=1e-4)


def test_the_travel_angle_of_a_torch_that_leans_back_is_less_in_a_ring() -> None:
    pitch = math.asin(math.sqrt(0.5) * D / 0.042)  # 24.9 deg, of which 20 are allowed
    upright = assess_seam(ring(0.021), D, V)
    assert [problem.kind for problem in upright.problems] == ["travel angle"]
    assert f"would be {math.degrees(pitch):.1f} deg" in upright.problems[0].sentence
    assert assess_seam(ring(0.021), D, V, SeamWindows(tilt_rad=math.radians(15.0))).feasible
    forward = assess_seam(ring(0.060), D, V, SeamWindows(tilt_rad=math.radians(-15.0)))
    assert [problem.kind for problem in forward.problems] == ["travel angle"]


@pytest.mark.parametrize("tilt_deg", [0.0, 15.0])
def test_the_planned_travel_angle_is_that_of_the_pressed_tip(tilt_deg: float) -> None:
    windows = SeamWindows(tilt_rad=math.radians(tilt_deg))
    tool = ToolGeometry(torch_offset_m=D, torch_height_m=-1.5e-3, torch_clearance_m=-SINK_M)
    config = ServoConfig(tool=tool, deflection=PRESS, windows=windows)
    radii = np.arange(0.014, 0.060, 1e-5)
    least = math.radians(tilt_deg + 23.0)  # the window and 3 deg of the 5 after which the weld stops
    limit = radii[np.argmax([travel_rad(r) > -least for r in radii])]
    check_travel(ring(1.01 * limit), config)
    with pytest.raises(InfeasibleSeam, match="travel angle would be 23 deg"):
        check_travel(ring(0.99 * limit), config)


def test_the_ends_of_a_measured_ring_meet_without_a_step() -> None:
    line, ups = circle(0.022)
    lifted = line + np.linspace(0.0, 2e-4, len(line))[:, None] * [0.0, 0.0, 1.0]  # 0.2 mm higher after one turn
    rows, all_ups, turn = ringed(lifted, ups)
    assert turn == pytest.approx(2.0 * math.pi * 0.022, rel=1e-3)
    seam = SeamCurve.from_points(rows, up=all_ups, length=turn)
    assert seam.length == pytest.approx(turn, abs=1e-5)
    s = np.linspace(turn - 0.012, turn + 0.012, 200)
    assert np.abs(seam.tangent(s)[:, 2]).max() < 0.025  # a step within 0.4 mm would be a slope of 0.5
    np.testing.assert_allclose(seam.position(s + turn), seam.position(s), atol=5e-6)
    open_line, _, none = ringed(line[:-10], ups[:-10])
    assert none is None
    assert open_line is not rows
    assert len(open_line) == len(line) - 10


def test_the_shipped_tools_say_how_their_torch_leans() -> None:
    tilts = [load_tool(tool_file(Path(name))).tool.torch_tilt_rad for name in ("welding", "tip_1p5", "pipe")]
    assert np.degrees(tilts) == pytest.approx([0.0, 0.0, 15.0], abs=0.05)
    assert SeamWindows.of(load_tool(tool_file(Path("pipe"))).tool) == SeamWindows(tilt_rad=tilts[2])


def test_the_pipe_tool_welds_pipes_from_40_mm() -> None:
    pipe = least_pipe_m(load_tool(tool_file(Path("pipe"))).tool, 0.08)
    assert 0.025 < pipe < 0.040
    shipped = load_tool(tool_file(Path("welding"))).tool
    upright, leaning = least_pipe_m(shipped, 0.08), least_pipe_m(shipped, 0.08, math.radians(2.0))
    assert 0.060 < leaning < upright < 0.160


@pytest.mark.parametrize(("ramp", "pitch"), [(100.0, 2.5 * 1e-3 / D), (1.0, 1.0 * 0.008)])
def test_the_pitch_of_a_near_torch_is_ramped(ramp: float, pitch: float) -> None:
    """A torch 1 mm low pitches the tool by k_h e / d, in the first tick no faster than the ramp."""
    line = SeamCurve.from_points([[0.65, -0.1 + 0.01 * k, 0.0] for k in range(21)], up=(-1.0, 0.0, 1.0))
    tool = ToolGeometry(torch_offset_m=D, torch_height_m=0.0)
    config = ServoConfig(tool=tool, limits=MotionLimits(pitch_acceleration_rad_s2=ramp))
    tip, torch = line.frame(0.1), line.frame(0.1 - D)
    R = np.column_stack([tip.tangent, np.cross(tip.up, tip.tangent), tip.up])
    X_BT = pose(R, tip.position)
    s, above = 0.1 - D, torch.position + 1e-3 * torch.up
    target = TorchTarget(
        point=above, tangent=torch.tangent, normal=torch.normal, up=torch.up, arc=s, s=s, residual=np.zeros(2)
    )
    motion = guarded_motion(WeldingState(), X_BT, tip, target, (0.0, 0.0), config, 0.008)
    # nose down: the torch rises about the tip
    assert motion.V_BT[:3] @ tip.normal == pytest.approx(pitch, rel=0.02)


def test_the_torch_is_on_the_ring_when_the_tip_comes_down_on_it() -> None:
    """In the middle of a ring, as where a broken weld goes on: a torch 11 mm above it would still be too high there."""
    chord, radius, at = 0.060, 0.080, 0.2
    config = ServoConfig(tool=ToolGeometry(torch_offset_m=chord), touch=TouchOnConfig(arc_m=at))
    X_BT = touch_start_pose(ring(radius), config)
    R, p_BT = X_BT.rotation().matrix(), X_BT.translation()
    a = at / radius
    p_tip = radius * np.array([math.cos(a), math.sin(a), 0.0])
    p_torch = p_tip - chord * R[:, 0]
    assert abs(p_torch[2]) < 1e-4
    assert np.linalg.norm(p_torch[:2]) == pytest.approx(radius, abs=1e-3)
    assert np.linalg.norm(R.T @ R - np.eye(3)) < 1e-9
    assert (p_BT - p_tip) @ [math.cos(a), math.sin(a), 1.0] > 0.0, "above the face"
