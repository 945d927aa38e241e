"""Force mode, freedrive, the force sensor and tool contact against an elastic plane."""

from __future__ import annotations

import numpy as np
import pytest

from weldcal.models.arms.kinematics import load_arm
from weldcal.models.arrays import Array
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.poses import matrix, rotation_vector
from weldcal.tools.emulators.ur.main import HOME
from weldcal.tools.emulators.ur.versions import parse_version
from weldcal.tools.emulators.ur.wire.rtde_fields import outputs

STIFFNESS = 20_000.0
FLAT = "p[0, 0, 0, 0, 0, 0]"
DOWN = "force_mode({frame}, [0, 0, 1, 0, 0, 0], [0, 0, {force}, 0, 0, 0], {kind}, [0.1, 0.1, 0.05, 1, 1, 1])"


@pytest.fixture
def bench() -> Controller:
    """The tool points down, 5 mm above an elastic table."""
    made = Controller(load_arm(), np.array(HOME), parse_version("5.21"))
    made.surroundings.point = np.array(made.arm.tool_pose()[:3]) - [0.0, 0.0, 0.005]
    made.surroundings.stiffness = STIFFNESS
    return made


def runs(made: Controller, body: str, frames: int) -> Array:
    """Tool positions (n, 3) while a program runs."""
    assert made.start(f"def prog():\n{body}\nend\n"), made.log[-1]
    found = []
    for _ in range(frames):
        made.step()
        found.append(made.arm.tool_pose()[:3])
    assert not [line for line in made.log if "error" in line], made.log
    return np.array(found)


def test_force_mode_presses_with_the_force_asked_for_and_no_faster_than_its_limit(bench: Controller) -> None:
    wait = DOWN.format(frame=FLAT, force=-30, kind=2) + "\nsleep(3.0)"
    heights = runs(bench, wait, 1000)[:, 2]
    assert np.diff(heights).min() / 0.002 >= -0.05 - 1e-9
    assert bench.tcp_force()[2] == pytest.approx(30.0, abs=0.01)
    assert bench.surroundings.point[2] - heights[-1] == pytest.approx(30.0 / STIFFNESS, rel=1e-3)
    turned = matrix(bench.arm.tool_pose())[:3, :3] @ bench.arm.flange(np.array(HOME))[:3, :3].T
    assert rotation_vector(turned) == pytest.approx([0.0] * 3, abs=1e-9)


def test_a_move_across_the_table_keeps_pressing(bench: Controller) -> None:
    goal = bench.arm.tool_pose()
    goal[0] += 0.05
    body = DOWN.format(frame=FLAT, force=-20, kind=2) + f"\nsleep(0.5)\nmovel(p{goal}, v=0.1)\nsleep(3.0)"
    path = runs(bench, body, 1000)
    assert path[-1][:2] == pytest.approx(goal[:2], abs=1e-7)
    pressed = STIFFNESS * (bench.surroundings.point[2] - path[400:, 2])
    assert pressed == pytest.approx(np.full(600, 20.0), abs=0.5)


def test_a_task_frame_that_is_turned_presses_along_its_own_axis(bench: Controller) -> None:
    # z of the frame points down: to press on the table is a positive force in it
    runs(bench, DOWN.format(frame="p[0, 0, 0, 3.14159265, 0, 0]", force=15, kind=2) + "\nsleep(3.0)", 800)
    assert bench.tcp_force()[2] == pytest.approx(15.0, abs=0.01)


def test_force_mode_ends_with_its_program_and_when_it_is_told(bench: Controller) -> None:
    runs(bench, DOWN.format(frame=FLAT, force=-30, kind=2) + "\nsleep(0.2)\nend_force_mode()\nsleep(1.0)", 200)
    here = bench.arm.q.copy()
    for _ in range(50):
        bench.step()
    assert np.abs(bench.arm.q - here).max() == 0.0
    runs(bench, DOWN.format(frame=FLAT, force=30, kind=2), 20)
    assert bench.arm.compliance is None


def test_a_pause_holds_the_arm_in_force_mode_and_play_goes_on(bench: Controller) -> None:
    runs(bench, DOWN.format(frame=FLAT, force=30, kind=2) + "\nsleep(9.0)", 100)
    bench.pause_program()
    for _ in range(60):
        bench.step()
    here = bench.arm.tool_pose()[2]
    for _ in range(20):
        bench.step()
    assert bench.arm.tool_pose()[2] == pytest.approx(here, abs=1e-9)
    bench.resume_program()
    for _ in range(20):
        bench.step()
    assert bench.arm.tool_pose()[2] > here + 1e-4


def test_freedrive_gives_way_to_a_hand_on_its_free_axes_only(bench: Controller) -> None:
    bench.surroundings.push = np.array([10.0, 10.0, 0.0, 0.0, 0.0, 0.0])
    path = runs(bench, "freedrive_mode(freeAxes=[1, 0, 0, 0, 0, 0])\nsleep(2.0)", 500)
    moved = path[-1] - path[0]
    assert moved[0] > 0.05
    assert moved[1:] == pytest.approx([0.0, 0.0], abs=1e-6)
    still = runs(bench, "end_freedrive_mode()\nsleep(2.0)", 500)
    assert np.ptp(still[100:], axis=0) == pytest.approx([0.0] * 3)


def test_the_sensor_is_zeroed_and_rtde_reads_the_same_force(bench: Controller) -> None:
    bench.surroundings.push = np.array([3.0, 0.0, -4.0, 0.1, 0.0, 0.0])
    fields = outputs()
    assert fields["actual_TCP_force"].get(bench) == pytest.approx([3.0, 0.0, -4.0, 0.1, 0.0, 0.0])
    assert fields["tcp_force_scalar"].get(bench) == pytest.approx(5.0)
    raw = np.array(fields["ft_raw_wrench"].get(bench))
    assert bench.arm.flange(bench.arm.q)[:3, :3] @ raw[:3] == pytest.approx([3.0, 0.0, -4.0])
    runs(bench, "zero_ftsensor()", 1)
    assert fields["actual_TCP_force"].get(bench) == pytest.approx([0.0] * 6)
    bench.surroundings.push = np.zeros(6)
    assert fields["actual_TCP_force"].get(bench)[2] == pytest.approx(4.0)


def test_a_sensor_that_a_client_writes_replaces_the_built_in_one(bench: Controller) -> None:
    bench.sensor.written = [0.0, 0.0, 7.0, 0.0, 0.0, 0.0]
    runs(bench, "ft_rtde_input_enable(True, 0.5)", 1)
    # the flange's z points down
    assert bench.tcp_force()[2] == pytest.approx(-7.0, abs=1e-6)


def test_tool_contact_says_how_many_steps_ago_the_tool_touched(bench: Controller) -> None:
    body = """speed = [0, 0, -0.02, 0, 0, 0]
    steps = 0
    while steps == 0:
      speedl(speed, 0.5, 0.002)
      steps = tool_contact(direction=speed)
    end
    stopl(3)
    movel(get_actual_joint_positions_history(0))
    write_output_integer_register(1, steps)"""
    path = runs(bench, body, 400)
    steps = bench.outputs.integers[1]
    # 5 N are 0.25 mm, 6.25 steps at 20 mm/s
    assert steps == pytest.approx(7, abs=1)
    assert path[:, 2].min() > bench.surroundings.point[2] - 0.5e-3
    away = "textmsg(tool_contact(direction=[0, 0, 1, 0, 0, 0]))"
    runs(bench, away, 1)
    assert bench.log[-2].endswith("script: 0")
