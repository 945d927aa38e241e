"""A seam that the arm cannot follow is refused before anything moves; what the refusal advises, followed literally, is
accepted."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.systems.cells import EXACT_PLATE, SMALL_IDEAL_SCANNER, plain_station, scenario
from tests.systems.placements import Placement, draw, follow, offered, placed
from tests.worlds.weld.budgets import PERFECT
from tests.worlds.weld.plant import groove_config, simulate
from tests.worlds.weld.seams import get_seam
from weldcal.calibration.planning.clearance import Obstacle, Surroundings
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.errors import InputError
from weldcal.models.mesh import extrude, merge
from weldcal.models.tools.loading import load_tool, tool_file
from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.jobs.weld.arm_way import Welder, find_way, free_move, leans_with_clearance
from weldcal.systems.jobs.weld.job import seam_planning
from weldcal.systems.jobs.weld.seam_planning import SeamPlanning, plan_drawn_seam
from weldcal.systems.jobs.weld.settings import servo_config
from weldcal.systems.messages import PlannedSeam
from weldcal.systems.scenario.checks import check_scenario
from weldcal.welding.locate.planning import RootPlan, seam_above
from weldcal.welding.seam.clearance import NoClearance
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig, ToolGeometry
from weldcal.welding.servo.state import Phase
from weldcal.welding.servo.tool_axes import tool_path


@cache
def planning(*changes: str) -> SeamPlanning:
    found = scenario(SMALL_IDEAL_SCANNER, EXACT_PLATE, *changes)
    station = plain_station()
    return seam_planning(found, station, servo_config(found, station))


def drawn(x: float, yaw_deg: float, *changes: str, move: RigidTransform | None = None, z: float = 0.02) -> PlannedSeam:
    X = RigidTransform(RollPitchYaw(0.0, 0.0, np.radians(yaw_deg)), [x, 0.0, z])
    return plan_drawn_seam(replace(planning(*changes), X_BP_guess=(move or RigidTransform()) @ X), 1)


def numbers(text: str) -> list[float]:
    return [float(n) for n in re.findall(r"[-+]\d+", text)]


def test_a_seam_beyond_the_arms_reach_is_refused_and_the_advised_move_works() -> None:
    """Without surroundings, where nothing was checked between the seam's ends."""
    assert drawn(0.65, 90.0).reason is None
    refused = drawn(1.2, 0.0)
    assert refused.seam is None
    assert "The arm cannot reach the seam above its end, with the elbow at its end: " in str(refused.reason)
    advised = numbers(str(refused.reason).partition("move the part by")[2])
    assert len(advised) == 3
    assert drawn(1.2, 0.0, move=RigidTransform(1e-3 * np.array(advised))).reason is None
    assert (
        drawn(1.2, 0.0, move=RigidTransform(0.5e-3 * np.array(advised))).reason is not None
    )  # no smaller one of the list


def test_the_advised_lean_works_and_the_servo_leans() -> None:
    refused = drawn(1.3, 90.0)
    assert refused.seam is None
    advised = re.search(r"set (welding\.lean_deg: (\d+)),", str(refused.reason))
    assert advised is not None
    planned = drawn(1.3, 90.0, f"welding: {{lean_deg: {advised[2]}}}")
    assert planned.reason is None
    assert abs(np.degrees(planned.lean_rad)) == pytest.approx(float(advised[2]))
    assert drawn(0.65, 90.0, f"welding: {{lean_deg: {advised[2]}}}").lean_rad == 0.0  # upright where it can be


def test_the_advised_branch_works() -> None:
    refused = drawn(0.65, 90.0, z=0.6)
    assert "set welding.posture: any," in str(refused.reason)
    assert drawn(0.65, 90.0, "welding: {posture: any}", z=0.6).reason is None


def test_a_post_in_the_way_to_the_next_seam_or_an_unknown_part_sends_the_arm_home() -> None:
    base, plan = planning(), drawn(0.65, 90.0)
    assert plan.q_above is not None
    assert plan.q_retract is not None
    ends = plan.q_retract, plan.q_above
    assert free_move(base, *ends, plan.X_BP)
    assert not free_move(base, *ends, None)
    tip = forward_kinematics(base.arm, 0.5 * (ends[0] + ends[1])) @ base.tool.X_FT
    square = np.array([(-0.01, -0.01), (0.01, -0.01), (0.01, 0.01), (-0.01, 0.01)])
    post = Obstacle("post", extrude(square, -0.01, 0.01).transformed(RigidTransform(tip.translation())))
    assert not free_move(replace(base, surroundings=Surroundings((post,))), *ends, plan.X_BP)
    assert base.workpiece is not None
    on_part = replace(base.workpiece, mesh=post.mesh.transformed(plan.X_BP.inverse())) if plan.X_BP else None
    assert not free_move(replace(base, workpiece=on_part), *ends, plan.X_BP)


@pytest.mark.parametrize(
    ("key", "names"),
    [
        ("lean_deg: 11", "lean_deg"),
        ("posture: other", "posture"),
        ("seam_order: other", "seam_order"),
        ("between_seams: other", "between_seams"),
    ],
)
def test_a_setting_that_is_none_is_refused(key: str, names: str) -> None:
    with pytest.raises(InputError, match=f"welding.{names} must be"):
        check_scenario(scenario(f"welding: {{{key}}}"))


@pytest.mark.parametrize(("name", "lean_deg"), [("s_r60", 8.0)])
def test_the_planned_path_is_the_servos(name: str, lean_deg: float) -> None:
    """The servo itself, in a world without errors, holds the tool within 1 mm and 0.5 deg of the planned path."""
    seam = get_seam(name)
    config = ServoConfig(tool=ToolGeometry(torch_height_m=-0.0015), weld_speed_m_s=0.016)
    config = replace(config, torch=replace(config.torch, work_angle_rad=np.radians(lean_deg)))
    run = simulate(seam, PERFECT, config, 0)
    assert run.phase == Phase.DONE
    path = tool_path(SeamCurve.from_points(seam.points, seam.up), groove_config(config))
    s = run.column("s_torch_m")
    rows = np.flatnonzero(run.column("torch_on") > 0.5)[50::40]
    index = np.arange(len(path.s_torch))
    place = np.interp(s[rows], path.s_torch, index)
    p = np.array([X.translation() for X in path.X_BT])
    for row, at in zip(rows, place, strict=True):
        between = [float(np.interp(at, index, p[:, k])) for k in range(3)]
        assert np.linalg.norm(between - run.points("robot")[row]) < 1e-3
        axes = path.X_BT[round(at)].rotation().matrix()
        assert np.degrees(np.arccos(axes[:, 0] @ run.points("ahead")[row])) < 0.5
        assert np.degrees(np.arccos(axes[:, 1] @ run.points("left")[row])) < 0.5
    took = run.column("time_s")[rows[-1]] - run.column("time_s")[rows[0]]
    assert np.diff(np.interp(place[[0, -1]], index, path.time)) == pytest.approx(took, rel=0.03)


def test_an_accepted_placement_is_followed_and_a_refused_one_is_not() -> None:
    """Of random placements: the drive by servo, guard and slew limiter ends as the check has said."""
    accepted, refused = placed(401), placed(12)
    assert (accepted["state"], accepted["end"]) == ("accepted", "done")
    assert (refused["state"], refused["end"]) == ("refused", "guard")
    assert re.search(r"at \d+ mm: .* the \w+( \w+)? turns without effect", refused["reason"])


def test_an_offered_turn_of_a_refused_placement_is_followed() -> None:
    """The advice is applied to the true part, and the arm is driven along it."""
    text = offered(12)
    turn = numbers(text.partition("turn the part by")[2])[0]
    old = draw(12)
    centre = old.plan.frame(0.5 * old.plan.length).position
    R = RotationMatrix(RollPitchYaw(0.0, 0.0, np.radians(turn)))
    X = RigidTransform(R, centre - R.multiply(centre))
    seam = replace(old.seam, points=X.multiply(old.seam.points.T).T, up=R.multiply(old.seam.up))
    new = Placement(seam, old.plan.transformed(X), old.welder)
    assert follow(new, find_way(new.welder, new.plan, None).q_start, 12)["end"] == "done"


def test_a_ring_is_welded_round_within_the_wrists_limits() -> None:
    """From this start wrist 3 would reach -360 deg: it begins a whole turn higher, and turns back where the weld
    ends."""
    tool = load_tool(tool_file(Path("pipe"))).tool
    a = np.linspace(np.pi, 3.0 * np.pi, 361)
    out = np.column_stack([np.cos(a), np.sin(a), np.zeros(361)])
    root = np.array([0.65, 0.0, 0.01]) + 0.030 * out
    up = (out + np.array([0.0, 0.0, 1.0])) / np.sqrt(2.0)
    found = RootPlan(
        root=root, up=up, half_angle_rad=np.pi / 4, X_BP=None, sigma_m=0.0, rms_m=0.0, confidence=1.0, summary=""
    )
    seam = seam_above(found, tool, None, 0.003)
    turn = 2.0 * np.pi * (0.030 + 0.003 / np.sqrt(2.0))
    assert seam.length == pytest.approx(turn + 0.005, abs=2e-5)
    assert seam.position(seam.length) == pytest.approx(seam.position(0.005), abs=1e-5)
    assert seam.drawn_m > seam.length + tool.chord_m
    arm, home = plain_station().arm, np.radians([190.0, -120.0, 135.0, -105.0, -90.0, 90.0])
    geometry = ToolGeometry(torch_offset_m=tool.chord_m, torch_height_m=tool.torch_height_m)
    welder = Welder(
        arm=arm, tool=tool, config=ServoConfig(tool=geometry), q_near=home, clearance_m=0.025, advises=False
    )
    way = find_way(welder, seam, None)
    q = way.along[-1].q
    assert np.degrees(q[0, 5] - q[-1, 5]) > 360.0
    assert np.degrees(q[:, 5]).max() > 300.0
    assert (np.abs(q[:, 5]) < arm.position_upper[5]).all()
    assert np.degrees(np.abs(way.q_retract - q[-1])).max() < 30.0
    end, above = (forward_kinematics(arm, joints) @ tool.X_FT for joints in (q[-1], way.q_retract))
    assert above.rotation().matrix() == pytest.approx(end.rotation().matrix(), abs=1e-6)
    assert (above.translation() - end.translation()) @ seam.up(seam.length) == pytest.approx(0.075, abs=1e-3)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_tool_leans_off_the_bisector_where_it_has_no_room_upright(sense: float) -> None:
    """Around a pipe of 136 mm: the least is 148 mm upright, and less where the tool leans away from it."""
    tool = load_tool(tool_file(Path("welding"))).tool
    a = sense * np.linspace(0.0, 1.5 * np.pi, 181)
    out = np.column_stack([np.cos(a), np.sin(a), np.zeros(181)])
    up = (out + np.array([0.0, 0.0, 1.0])) / np.sqrt(2.0)
    round_ = 0.068 * np.column_stack([np.cos(a), np.sin(a)])[:: int(sense)]
    pipe = extrude(round_, 0.0, 0.1)
    plate = extrude(0.17 * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]), -0.01, 0.0)
    part = cast(WeldPart, SimpleNamespace(mesh=merge(pipe, plate)))
    seam = SeamCurve.from_points(0.068 * out + 0.0033 * up, up=up)
    welder = Welder(
        arm=plain_station().arm, tool=tool, config=ServoConfig(), q_near=np.zeros(6), clearance_m=0.025, workpiece=part
    )
    with pytest.raises(NoClearance, match=r"does not fit at .* Or set welding.lean_deg: 2, with which") as refused:
        leans_with_clearance(welder, seam, RigidTransform())
    assert 0.0 < refused.value.short_m < 0.01
    leans = np.degrees(leans_with_clearance(replace(welder, lean_rad=np.radians(3.0)), seam, RigidTransform()))
    assert leans == pytest.approx([2.0 * sense])
