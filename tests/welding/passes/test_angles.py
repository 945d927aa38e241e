"""The wire's angles from the arm's joints and the tool's file, against the frame of a seam whose formula is known."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.systems.jobs.test_unfelt import planning
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.tools.loading import WELDING, LoadedTool, load_tool, tool_file
from weldcal.models.workpieces.seat import JointSection, Press, press_for, seat
from weldcal.systems.jobs.weld.seam_planning import gone_on
from weldcal.welding.numerics import Array
from weldcal.welding.passes.angles import angles_along, leaned, lifted
from weldcal.welding.passes.felt import WeldPass, pass_config
from weldcal.welding.record.process import wire_angles
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import InfeasibleSeam, SeamWindows
from weldcal.welding.seam.restart import Restart
from weldcal.welding.servo.settings import (
    TORCH_ABOVE_ROOT_M,
    DeflectionControl,
    Ends,
    ServoConfig,
    ToolGeometry,
    TorchAngles,
)
from weldcal.welding.servo.tool_axes import check_travel, tool_path

MM, DEG, RADIUS_M, CENTRE = 1e-3, math.radians(1.0), 0.4, np.array([0.65, -0.4, 0.05])
V = JointSection(math.radians(22.5), 0.011, 0.011)
FILLET = JointSection(math.radians(45.0), 0.03, 0.03)


def arc(s: Array) -> tuple[Array, Array, Array, Array]:
    """Point, direction of travel, left and up (N, 3) of a level root that turns to the left."""
    a = s / RADIUS_M
    zero = np.zeros_like(a)
    t, n = np.column_stack([np.cos(a), np.sin(a), zero]), np.column_stack([-np.sin(a), np.cos(a), zero])
    return CENTRE - RADIUS_M * n, t, n, np.tile([0.0, 0.0, 1.0], (len(a), 1))


def setup(
    name: str = "welding",
    section: JointSection = V,
    stick_out_mm: float = 12.0,
    work: Ends = (0.0, 0.0),
    travel: Ends | None = None,
    rotation: Ends | None = None,
) -> tuple[LoadedTool, SeamCurve, ServoConfig]:
    """A tool, the line of its seated tip, and the servo's settings, with angles in degrees."""
    loaded = load_tool(tool_file(Path(name)))
    tool = loaded.tool.with_stick_out(stick_out_mm * MM)
    press = press_for(section, tool)
    seated = seat(section, tool, press)
    in_rad = [None if ends is None else (ends[0] * DEG, ends[1] * DEG) for ends in (travel, rotation)]
    config = ServoConfig(
        tool=ToolGeometry(
            torch_offset_m=tool.chord_m,
            torch_height_m=tool.torch_height_m,
            torch_clearance_m=TORCH_ABOVE_ROOT_M - seated.above_m,
            side_offset_m=-seated.aside_m,
        ),
        deflection=DeflectionControl(delta_d_m=press.lateral_m, axial_d_m=press.axial_m),
        windows=SeamWindows.of(tool),
        angles=TorchAngles(
            work_rad=(work[0] * DEG, work[1] * DEG),
            travel_rad=in_rad[0],
            rotation_rad=in_rad[1],
            half_angle_rad=section.half_angle_rad,
            stiffness_ratio=tool.axial_stiffness_N_per_m / tool.lateral_stiffness_N_per_m,
            seat=partial(seat, section, tool),
            stick_out_m=stick_out_mm * MM,
        ),
    )
    root, _, _, up = arc(np.arange(0.0, 0.2, 1e-3))
    return loaded, SeamCurve.from_points(root + seated.above_m * up, up=up), config


def by_the_joints(loaded: LoadedTool, poses: list[RigidTransform]) -> tuple[Array, Array]:
    """The wire's end (N, 3) m at the tool file's stick-out, and its direction towards the work, by the arm's joints."""
    arm, q = load_arm("ur10e"), np.deg2rad([0.0, -80.0, 110.0, -120.0, -90.0, 0.0])
    ends, directions = [], []
    for X_BT in poses:
        found = nearest_solution(arm, X_BT @ loaded.tool.X_FT.inverse(), q)
        assert found is not None
        q = found
        X_BF = forward_kinematics(arm, q)
        ends.append(X_BF @ loaded.p_FW)
        directions.append(X_BF.rotation() @ loaded.torch_axis)
    return np.array(ends), np.array(directions)


@pytest.mark.parametrize(
    ("tool", "stick_out_mm", "work", "travel", "rotation"),
    [
        ("welding", 12.0, 6.0, -1.5, None),
        ("welding", 8.0, -5.0, 4.0, None),
        ("welding", 17.0, 0.0, -5.0, 2.0),
        ("pipe", 12.0, 4.0, 15.0, 3.0),
        ("pipe", 14.0, 0.0, 11.0, None),
    ],
)
def test_the_wire_has_its_angles_by_the_joints(
    tool: str, stick_out_mm: float, work: float, travel: float, rotation: float | None
) -> None:
    turn = None if rotation is None else (rotation, rotation)
    loaded, seam, config = setup(tool, V, stick_out_mm, (work, work), (travel, travel), turn)
    path = tool_path(seam, config)
    rows = [k for k in range(0, len(path.time), 12) if 0.0 < path.s_torch[k] < 0.13]
    end, towards = by_the_joints(loaded, [path.X_BT[k] for k in rows])
    end = end + (stick_out_mm - 12.0) * MM * towards
    place = np.arctan2(end[:, 0] - CENTRE[0], CENTRE[1] - end[:, 1]) * RADIUS_M
    root, t, n, up = arc(place)
    assert end == pytest.approx(root + 2.0 * MM * up, abs=2e-5)
    # push: the wire points forward; work: the tool's left is up, so that its wire points to the left
    assert np.degrees(np.arcsin(np.sum(towards * t, axis=1))) == pytest.approx(np.full(len(rows), travel), abs=0.05)
    leans = np.degrees(np.arctan2(np.sum(towards * n, axis=1), -np.sum(towards * up, axis=1)))
    assert leans == pytest.approx(np.full(len(rows), work), abs=0.05)
    if rotation is not None:  # of the tip about the wire, from the seated ball on the bisector
        tip = np.array([path.X_BT[k].translation() for k in rows])
        ahead = arc(np.arctan2(tip[:, 0] - CENTRE[0], CENTRE[1] - tip[:, 1]) * RADIUS_M)[0]
        ahead = ahead + (TORCH_ABOVE_ROOT_M - config.clearance_m) * up
        across = [v - np.sum(v * towards, axis=1)[:, None] * towards for v in (ahead - end, tip - end)]
        turned = np.sum(np.cross(across[1], across[0]) * towards, axis=1)
        turned = turned / np.linalg.norm(across[0], axis=1) / np.linalg.norm(across[1], axis=1)
        assert np.degrees(np.arcsin(turned)) == pytest.approx(np.full(len(rows), rotation), abs=0.15)


def test_angles_run_linearly_along_the_seam() -> None:
    _, seam, config = setup(work=(-5.0, 5.0), travel=(-2.0, 1.0))
    along, path = angles_along(seam, config), tool_path(seam, config)
    lean = np.degrees([np.arcsin(X.rotation().matrix()[2, 1]) for X in path.X_BT])
    share = np.clip(path.s_torch / seam.length, 0.0, 1.0)
    assert lean == pytest.approx(-5.0 + 10.0 * share, abs=0.4)
    # the servo is led by the same: tip and torch each by their own place
    assert np.all(np.diff(along.axial_m[along.s_tip > 0.07]) < 0.0), "to push more the tip is pressed less"
    at = along.at(config, 0.15, 0.1)
    assert at.deflection.axial_d_m == pytest.approx(float(np.interp(0.15, along.s_tip, along.axial_m)))
    lead = config.weld_speed_m_s / config.torch.k_roll
    assert at.torch.work_angle_rad == pytest.approx(float(np.interp(0.1 + lead, along.s_torch, along.roll_rad)))


@pytest.mark.parametrize("restart", [False, True])
def test_a_part_of_a_seam_has_the_angles_of_its_places(restart: bool) -> None:
    """Between obstacles, and where a broken weld goes on at 80 mm."""
    _, whole, config = setup(work=(-5.0, 5.0), travel=(-2.0, 1.0))
    begins, s = 0.08, np.linspace(0.0, whole.length, 400)
    piece, broken = whole, None
    if restart:
        broken = Restart(seam=0, p_BCrater=np.asarray(whole.position(begins)), overlap_m=0.0)
    else:
        s = s[(s >= begins) & (s <= 0.18)]
        piece = SeamCurve.from_points(whole.position(s), up=whole.up(s))
    order = replace(planning(restart=broken), config=config)
    plan, line, _, again = gone_on(order, piece, whole, None, math.nan, None)
    assert again["begins_m"] == pytest.approx(s[0] if not restart else begins, abs=1e-4)
    along, of_part = angles_along(whole, config), angles_along(line, plan.config)
    for torch in (0.005, 0.02, 0.035):
        tip = torch + 0.06
        found, wanted = of_part.at(plan.config, tip, torch), along.at(config, begins + tip, begins + torch)
        assert found.torch.work_angle_rad == pytest.approx(wanted.torch.work_angle_rad, abs=0.1 * DEG)
        assert found.deflection.axial_d_m == pytest.approx(wanted.deflection.axial_d_m, abs=0.1 * MM)
    lean = plan.config.torch.work_angle_rad / DEG
    end = 1.0 if restart else 0.18 / whole.length
    assert lean == pytest.approx(-5.0 + 5.0 * (begins / whole.length + end), abs=0.1)


def _named(text: str, words: str) -> tuple[float, float]:
    found = re.search(rf"{words} from ([-+.\d]+) to ([-+.\d]+)", text)
    assert found is not None, text
    return float(found[1]), float(found[2])


@pytest.mark.parametrize("section", [V, FILLET])
@pytest.mark.parametrize("far", [-8.0, 4.0])
def test_the_limits_that_a_refusal_names_are_those_that_are_kept(section: JointSection, far: float) -> None:
    _, seam, config = setup(section=section, travel=(far, far))
    with pytest.raises(InfeasibleSeam, match="Its joint holds it from") as refused:
        check_travel(seam, config)
    angles, sticks = (_named(str(refused.value), words) for words in ("a travel angle", "a stick-out"))
    assert 1.0 < angles[1] - angles[0] < 6.0
    for inside, beyond in ((angles[0] + 0.1, angles[0] - 0.1), (angles[1] - 0.1, angles[1] + 0.1)):
        check_travel(*setup(section=section, travel=(inside, inside))[1:])
        with pytest.raises(InfeasibleSeam):
            check_travel(*setup(section=section, travel=(beyond, beyond))[1:])
    for inside, beyond in ((sticks[0] + 0.1, sticks[0] - 0.1), (sticks[1] - 0.1, sticks[1] + 0.1)):
        check_travel(*setup("welding", section, inside, travel=(far, far))[1:])
        with pytest.raises(InfeasibleSeam):
            check_travel(*setup("welding", section, beyond, travel=(far, far))[1:])


def test_a_rotation_is_limited_by_the_wall_and_by_contact() -> None:
    with pytest.raises(InfeasibleSeam, match="the tip would lean by") as refused:
        check_travel(*setup(rotation=(8.0, 8.0))[1:])
    low, high = _named(str(refused.value), "a rotation")
    for inside, beyond in ((low + 0.15, low - 0.15), (high - 0.15, high + 0.15)):
        check_travel(*setup(rotation=(inside, inside))[1:])
        with pytest.raises(InfeasibleSeam, match="the tip would lean by"):
            check_travel(*setup(rotation=(beyond, beyond))[1:])


@pytest.mark.parametrize(
    ("angles", "said"),
    [({"work": (25.0, 25.0)}, "the finger touches"), ({"stick_out_mm": 40.0}, "its window is 20 deg")],
)
def test_a_finger_at_the_wall_and_a_steep_wire_are_refused(angles: dict[str, Ends], said: str) -> None:
    with pytest.raises(InfeasibleSeam, match=said):
        check_travel(*setup(**angles)[1:])  # type: ignore[arg-type]


def test_springs_that_lean_with_the_tool_press_otherwise() -> None:
    ratio, press, roll = 0.5, Press(3 * MM, 2 * MM), 8.0 * DEG
    R = np.array([[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]])  # left side up
    force = R @ np.diag([1.0, ratio]) @ R.T @ [press.lateral_m, -press.axial_m]
    found = leaned(press, roll, ratio)
    assert (found.lateral_m, -ratio * found.axial_m) == pytest.approx(tuple(force), rel=1e-12)
    assert found.lateral_m < press.lateral_m, "leaning to its right, the tool presses less to the left"


def test_the_torch_stays_over_the_root_where_the_ball_sinks_less() -> None:
    _, seam, config = setup(travel=(1.0, 1.0))
    along = angles_along(seam, config)
    a, lateral = float(along.axial_m[-1]), float(along.lateral_m[-1])
    tool = load_tool(WELDING).tool
    seated = seat(V, tool, leaned(Press(a, lateral), float(along.roll_rad[-1]), 0.5))
    assert a < 0.75 * config.deflection.axial_d_m
    assert along.clearance_m[-1] + seated.above_m == pytest.approx(TORCH_ABOVE_ROOT_M, abs=2e-6)
    assert along.side_m[-1] + seated.aside_m == pytest.approx(0.0, abs=2e-6)


@pytest.mark.parametrize("reverse", [False, True])
def test_a_tip_that_is_not_used_is_lifted_for_a_push(reverse: bool) -> None:
    _, seam, root = setup()
    order = WeldPass(travel_rad=8.0 * DEG, angle_rad=5.0 * DEG, reverse=reverse)
    config = pass_config(root, order, 2.5 * MM)
    line, config = lifted(seam, config)
    assert line.position(0.1)[2] - seam.position(0.1)[2] > 4.0 * MM
    path = tool_path(line, config)
    rows = (path.s_torch > 0.0) & (path.s_torch < 0.13)  # further on the tip is beyond the drawn end
    s, R = path.s_torch[rows], np.array([X.rotation().matrix() for X in path.X_BT])[rows]
    work, travel = np.degrees(wire_angles(R, line.tangent(s), line.normal(s), line.up(s)))
    assert travel == pytest.approx(np.full(len(s), 8.0), abs=0.1)
    assert work == pytest.approx(np.full(len(s), -5.0 if reverse else 5.0), abs=0.1)
    wire = line.position(0.1) + config.clearance_m * line.up(0.1) + config.tool.side_offset_m * line.normal(0.1)
    assert wire == pytest.approx(seam.position(0.1) + root.clearance_m * seam.up(0.1), abs=3e-4)
    with pytest.raises(InfeasibleSeam, match="which is not used, would touch the part"):
        lifted(seam, pass_config(root, replace(order, travel_rad=-2.0 * DEG), 2.5 * MM))


@pytest.mark.parametrize("name", ["welding", "pipe"])
def test_a_longer_wire_ends_farther_along_its_own_direction(name: str) -> None:
    loaded = load_tool(tool_file(Path(name)))
    longer = loaded.tool.with_stick_out(15.0 * MM)
    assert longer.X_FT @ longer.p_TW == pytest.approx(loaded.p_FW + 3.0 * MM * loaded.torch_axis, abs=1e-7)
    assert [c.p_end.tolist() for c in longer.capsules()] == [c.p_end.tolist() for c in loaded.tool.capsules()]
    assert longer.X_FT.IsExactlyEqualTo(loaded.tool.X_FT)
