"""URScript's values and motions beyond the guard's own: texts, lists, structs, arcs, as the script manual describes
them."""

from __future__ import annotations

import socket
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.places import ROOT
from weldcal.models.arms.kinematics import load_arm
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.poses import matrix, pose_of, rotation_vector
from weldcal.tools.emulators.ur.controller.registers import SafetyMode, ScriptStopped
from weldcal.tools.emulators.ur.main import HOME
from weldcal.tools.emulators.ur.script.builtins import script_functions
from weldcal.tools.emulators.ur.script.program import Program
from weldcal.tools.emulators.ur.versions import parse_version


def controller(polyscope: str = "5.21") -> Controller:
    return Controller(load_arm(), np.array(HOME), parse_version(polyscope))


def said_by(body: str, *, made: Controller | None = None, frames: int = 100) -> list[str]:
    """What a program says with textmsg in some frames."""
    made = made or controller()
    assert made.start(f"def asked():\n{body}\nend\n"), made.log[-1]
    for _ in range(frames):
        made.step()
    assert not [line for line in made.log if "error" in line], made.log
    return [line.split("script: ", 1)[1] for line in made.log if "script: " in line]


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ('str_cat("pose ", p[1, 0, 0.5, 0, 0, -1])', "pose p[1, 0, 0.5, 0, 0, -1]"),
        ("str_cat(1, str_cat([1, 2.5], True))", "1[1, 2.5]True"),
        ("to_str(2.123456123456)", "2.12346"),
        ('str_sub("polyscope", 4, 3)', "sco"),
        ('str_sub("polyscope", 4)', "scope"),
        ('str_find("polyscope", "s", 5)', "-1"),
        ('str_find("polyscope", "scope")', "4"),
        ('str_len("four")', "4"),
        ('str_at("four", 2)', "u"),
        ('str_empty("")', "True"),
        ('to_num("3") + to_num("-0.5e1 mm")', "-2"),
        ("get_list_length([1, 2, 3])", "3"),
        ("size([[1, 2, 3], [4, 5, 6]])", "[2, 3]"),
        ("[1, 2] + [3, 4] * 2", "[7, 10]"),
        ("[2, 4] / 4 - 1", "[-0.5, 0]"),
        ("-[1, 2]", "[-1, -2]"),
        ("[[1, 2], [3, 4]] * [1, 1]", "[3, 7]"),
        ("transpose([[1, 2], [3, 4]])", "[[1, 3], [2, 4]]"),
        ("7 % 4", "3"),
        ("floor(-0.5) + ceil(1.5) + log(10, 1000)", "4"),
        ("binary_list_to_integer([True, False, True])", "5"),
        ("struct(name = 3, of = [1, 2]).of[1]", "2"),
    ],
)
def test_a_value_is_what_the_manual_says(value: str, said: str) -> None:
    assert said_by(f"textmsg({value})") == [said]


def test_a_list_grows_a_struct_changes_and_a_seed_is_a_condition() -> None:
    body = """l = make_list(1, 5)
    l.append(7)
    s = struct(a = 1)
    t = s
    t.a = l.length()
    if 0.0:
      textmsg("zero")
    elif 2:
      textmsg(l, s.a)
    end
    textmsg(t)"""
    assert said_by(body) == ["[5, 7]1", "struct(a=2)"]


def test_an_arc_keeps_its_radius_and_ends_at_its_goal() -> None:
    made = controller()
    made.set_tcp([0.0, 0.0, 0.1, 0.3, 0.0, 0.0])
    start = np.array(made.arm.tool_pose())
    x, y = np.array([0.05, 0.0, 0.0]), np.array([0.0, 0.05, 0.0])
    centre, radius = start[:3] + y, 0.05
    via, end = start.copy(), start.copy()
    via[:3], end[:3] = centre + x, centre + y
    made.start(f"def arc():\nmovec(p{via.tolist()}, p{end.tolist()}, a=1.0, v=0.1)\nend\n")
    reached = []
    for _ in range(2000):
        made.step()
        reached.append(made.arm.tool_pose()[:3])
        if made.program is None:
            break
    assert np.abs(np.linalg.norm(np.array(reached) - centre, axis=1) - radius).max() < 1e-6
    assert np.abs(np.array(reached) - via[:3]).max(axis=1).min() < 2e-4
    assert made.arm.tool_pose() == pytest.approx(end.tolist(), abs=1e-6)
    # half a circle of 0.05 m at 0.1 m/s with 0.1 s of ramp at each end
    assert len(reached) * 0.002 == pytest.approx(np.pi * 0.05 / 0.1 + 0.1, abs=0.01)


def test_the_tool_of_a_straight_move_stays_on_its_line_while_it_turns() -> None:
    made = controller()
    made.set_tcp([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])
    start = matrix(made.arm.tool_pose())
    goal = start @ matrix([0.0, 0.1, 0.0, 0.0, 0.5, 0.0])
    made.start(f"def line():\nmovel(p{pose_of(goal)}, a=2.0, v=0.5)\nend\n")
    line = (goal - start)[:3, 3] / np.linalg.norm((goal - start)[:3, 3])
    for _ in range(400):
        made.step()
        off = np.array(made.arm.tool_pose()[:3]) - start[:3, 3]
        assert np.linalg.norm(off - (off @ line) * line) < 1e-6
    assert rotation_vector(matrix(made.arm.tool_pose())[:3, :3] @ goal[:3, :3].T) == pytest.approx([0.0] * 3, abs=1e-6)


def test_a_line_that_asks_a_joint_for_too_much_is_followed_more_slowly() -> None:
    made = controller()
    goal = made.arm.tool_pose()
    goal[1] += 0.4
    made.start(f"def fast():\nmovel(p{goal}, a=50, v=20, t=0.05)\nend\n")
    fastest = np.zeros(6)
    for _ in range(1000):
        made.step()
        fastest = np.maximum(fastest, np.abs(made.arm.qd))
        if made.program is None:
            break
    assert made.safety_mode == SafetyMode.NORMAL, made.log
    assert made.arm.tool_pose()[:3] == pytest.approx(goal[:3], abs=1e-6)
    assert made.time_s > 0.1
    assert (fastest <= made.arm.model.velocity_limit).all()
    assert (fastest / made.arm.model.velocity_limit).max() > 0.95


def test_optimised_motions_come_with_5_21_and_take_shares() -> None:
    goal = [angle + 0.1 for angle in HOME]
    old, new = controller("5.12"), controller()
    assert not old.start(f"def go():\noptimovej({goal})\nend\n")
    assert said_by(f'optimovej({goal}, a=1.0, v=0.5)\ntextmsg("there")', made=new, frames=300) == ["there"]
    assert new.arm.q == pytest.approx(goal)
    new.start(f"def go():\noptimovej({goal}, a=1.5)\nend\n")
    new.step()
    assert "share of what the arm can do" in new.log[-2]


def test_a_joint_target_outside_its_limits_ends_the_program_without_a_stop() -> None:
    made = controller()
    made.start("def far():\nmovej([0, -1.57, 3.5, 0, 0, 0])\nend\n")
    made.step()
    assert "joint 2 of the target is outside its limits" in made.log[-2]
    assert (made.program, made.safety_mode) == (None, SafetyMode.NORMAL)


def test_the_slider_stretches_the_time_of_a_streamed_step() -> None:
    # UR's own test follows a spline that is sent as steps of speedj while the slider is down
    made = controller()
    made.terminals.speed_slider = 0.25
    body = """step = 0
    while step < 50:
      speedj([0.1, 0, 0, 0, 0, 0], a=40, t=0.002)
      step = step + 1
    end
    write_output_integer_register(0, step)
    stopj(40)"""
    made.start(f"def slow():\n{body}\nend\n")
    for _ in range(198):
        made.step()
    assert made.outputs.integers[0] == 0
    for _ in range(5):
        made.step()
    assert made.outputs.integers[0] == 50
    assert made.arm.q[0] == pytest.approx(HOME[0] + 0.1 * 50 * 0.002, abs=3e-4)


def test_a_popup_that_blocks_waits_until_it_is_closed() -> None:
    made = controller()
    waiting = 'popup("look", title="Seen", blocking=True)\ntextmsg("closed")'
    assert said_by(waiting, made=made) == []
    made.popup_open = False
    made.step()
    assert "closed" in made.log[-2]


def test_a_program_that_asks_for_a_protective_stop_and_nothing_else_ends() -> None:
    made = controller()
    made.start("def last():\nprotective_stop()\nend\n")
    made.step()
    assert made.safety_mode == SafetyMode.PROTECTIVE_STOP
    assert made.program is None
    other = controller()
    other.start("def more():\nprotective_stop()\nsync()\nend\n")
    for _ in range(10):
        other.step()
    assert other.program is not None


def test_the_terminals_of_the_tool_and_the_payload_are_set_by_script() -> None:
    made = controller()
    body = """set_tool_digital_out(1, True)
    set_configurable_digital_out(2, True)
    set_tool_voltage(24)
    set_gravity([0, 9.82, 0])
    set_payload(2.5, [0, 0, 0.1])
    set_standard_analog_out(1, 0.25)
    textmsg(get_tool_digital_out(1), get_payload())"""
    assert said_by(body, made=made) == ["True2.5"]
    terminals: Any = made.terminals
    assert terminals.digital_outputs == 1 << 17 | 1 << 10
    assert (terminals.tool_voltage, terminals.analog_outputs) == (24, [0.0, 0.25])
    assert (made.gravity, made.payload.center) == ([0.0, 9.82, 0.0], [0.0, 0.0, 0.1])


@pytest.mark.parametrize("seed", range(5))
def test_roll_pitch_yaw_is_what_scipy_computes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rpy = rng.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1])
    vector = Rotation.from_euler("xyz", rpy).as_rotvec()
    made = controller()
    run = f"a = rpy2rotvec({rpy.tolist()})\nb = rotvec2rpy({vector.tolist()})\n"
    writes = "".join(
        f"write_output_float_register({i + k}, {n}[{i}])\n" for k, n in ((0, "a"), (3, "b")) for i in range(3)
    )
    assert made.start(f"def turn():\n{run}{writes}end\n")
    made.step()
    np.testing.assert_allclose(made.outputs.doubles[:3], vector, atol=1e-12)
    np.testing.assert_allclose(made.outputs.doubles[3:6], rpy, atol=1e-12)


@pytest.mark.parametrize(
    ("value", "said"),  # the script manual's own examples
    [
        ("rotvec2rpy([3.14, 1.57, 0])", [-2.80856, -0.16202, 0.9]),
        ("rpy2rotvec([3.14, 1.57, 0])", [2.22153, 0.00177, -2.21976]),
        ("normalize([0, 5, 0])", [0.0, 1.0, 0.0]),
        ("normalize([0, 1, 1])", [0.0, 0.707, 0.707]),
        ("get_gravity()", [0.0, 0.0, 9.82]),
    ],
)
def test_a_vector_is_what_the_manual_says(value: str, said: list[float]) -> None:
    (text,) = said_by(f"textmsg({value})")
    np.testing.assert_allclose([float(part) for part in text.strip("[]").split(",")], said, atol=5e-4)


def test_normalize_of_zeros_is_a_runtime_error() -> None:
    made = controller()
    made.start("def zero():\nx = normalize([0, 0, 0])\nend\n")
    made.step()
    assert "runtime error in line 2" in made.log[-2]


def test_a_wrench_from_a_new_point_of_view_does_the_same_work() -> None:
    """The power of a wrench on a moving body is the same from every point of view."""
    rng = np.random.default_rng(3)
    p, turn, wrench, twist = rng.normal(size=3), rng.normal(size=3), rng.normal(size=6), rng.normal(size=6)
    made = controller()
    pose = f"p{[*p.tolist(), *turn.tolist()]}"
    writes = "".join(f"write_output_float_register({i}, w[{i}])\n" for i in range(6))
    assert made.start(f"def move():\nw = wrench_trans({pose}, {wrench.tolist()})\n{writes}end\n")
    made.step()
    R = Rotation.from_rotvec(turn).as_matrix()
    seen = np.concatenate([R.T @ (twist[:3] + np.cross(twist[3:], p)), R.T @ twist[3:]])
    assert np.dot(made.outputs.doubles[:6], seen) == pytest.approx(np.dot(wrench, twist))
    np.testing.assert_allclose(made.outputs.doubles[:3], R.T @ wrench[:3], atol=1e-12)


def test_random_numbers_lie_between_0_and_1_and_repeat_after_a_start() -> None:
    rows = [said_by("i = 0\nwhile i < 50:\ntextmsg(random())\ni = i + 1\nend") for _ in range(2)]
    assert rows[0] == rows[1]
    values = np.array(rows[0], dtype=float)
    assert len(set(rows[0])) == 50
    assert values.min() >= 0.0
    assert values.max() < 1.0
    assert 0.3 < values.mean() < 0.7


def test_an_old_assignment_sets_a_digital_output() -> None:
    made = controller()
    made.submit("digital_out[2]=True\n")
    made.step()
    assert made.terminals.digital_outputs == 0b100
    made.submit("digital_out[2]=False\n")
    made.step()
    assert made.terminals.digital_outputs == 0


def test_a_least_time_of_a_velocity_is_its_time() -> None:
    made = controller()
    assert made.start(
        "def go():\nspeedl([0.02, 0, 0, 0, 0, 0], a=0.5, t_min=0.2)\nspeedj([0, 0, 0, 0, 0, 0.1], 1, t_min=0.1)\nend\n"
    )
    frames = 0
    while made.program is not None:
        made.step()
        frames += 1
        assert frames < 1000
    assert frames == pytest.approx(150, abs=3)


def test_joint_temperatures_are_of_six_joints() -> None:
    assert said_by("textmsg(get_joint_temp(5))") == ["30"]
    made = controller()
    made.start("def hot():\nx = get_joint_temp(6)\nend\n")
    made.step()
    assert "runtime error" in made.log[-2]


def test_variables_of_a_server_are_set_and_read() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5.0)
        made = controller()
        port = server.getsockname()[1]
        body = f'socket_open("127.0.0.1", {port}, "g")\nsocket_set_var("POS", 255, "g")\n'
        body += 'a = socket_get_var("STA", "g")\nb = socket_get_var("STA", "g")\ntextmsg(a, b)\nsync()'
        assert made.start(f"def gripper():\n{body}\nend\n"), made.log
        for _ in range(6):
            made.step()
        wire, _ = server.accept()
        with wire:
            wire.settimeout(5.0)
            assert wire.recv(100) == b"SET POS 255\nGET STA\n"
            wire.sendall(b"STA -3\n")
            for _ in range(20):
                made.step()
            assert wire.recv(100) == b"GET STA\n"
            for _ in range(1100):  # longer than the two seconds after which the answer is 0
                made.step()
    assert any(line.endswith("script: -30") for line in made.log)


def named_on_the_page(mark: str) -> list[str]:
    """The names in the block after a mark of docs/reference/urscript_functions.md."""
    page = (ROOT / "docs" / "reference" / "urscript_functions.md").read_text()
    return page.partition(f"<!-- {mark} -->\n```text\n")[2].partition("```")[0].split()


def test_the_page_lists_all_functions_that_programs_can_call() -> None:
    found: set[str] = set()

    def functions(program: Program) -> tuple[Mapping[str, Any], Iterable[str]]:
        named, blocking = script_functions(controller("5.23"), program)
        found.update(named)
        return named, blocking

    Program("def empty():\nend\n", functions)
    assert named_on_the_page("served") == sorted(found)


@pytest.mark.parametrize("name", named_on_the_page("refused"))
def test_a_function_that_is_missing_is_named_by_the_compiler(name: str) -> None:
    made = controller("5.23")
    assert not made.start(f"def call():\n  x = 1\n  y = {name}(1)\nend\n")
    assert f"compile_error_name_not_found:{name}:" in made.log[-1]
    (event,) = [event for event in made.events if isinstance(event, ScriptStopped)]
    assert (event.line, event.column) == (3, 7)


def test_the_functions_that_are_missing_are_as_many_as_the_page_says() -> None:
    assert len(named_on_the_page("refused")) == len(set(named_on_the_page("refused"))) > 80


def test_a_flood_of_messages_does_not_end_its_reader() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5.0)
        made = controller()
        reads = 'while True:\na = socket_read_binary_integer(1, "g")\nn = n + 1\nend'
        body = f'global n = 0\nsocket_open("127.0.0.1", {server.getsockname()[1]}, "g")\n{reads}'
        assert made.start(f"def flooded():\n{body}\nend\n"), made.log
        for _ in range(6):
            made.step()
        wire, _ = server.accept()
        with wire:
            wire.setblocking(False)
            for _ in range(20):
                with suppress(BlockingIOError):
                    wire.send(b"\0" * 40_000)
                made.step()
            assert made.program is not None, made.log
