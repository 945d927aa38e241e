"""URScript as the emulator runs it: no sockets, one frame at a time."""

from __future__ import annotations

import re
import socket
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from weldcal.models.arms.kinematics import load_arm
from weldcal.models.arms.urdf import arm_urdf
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.registers import RuntimeState, SafetyMode
from weldcal.tools.emulators.ur.main import HOME
from weldcal.tools.emulators.ur.script.forces import Dynamics, mass_matrix
from weldcal.tools.emulators.ur.script.parser import split_programs
from weldcal.tools.emulators.ur.script.program import Program
from weldcal.tools.emulators.ur.script.syntax import ScriptError
from weldcal.tools.emulators.ur.versions import parse_version


def said_by(body: str, frames: int = 50) -> list[Any]:
    """What a program says in some frames."""
    said: list[Any] = []

    def functions(_: Program) -> tuple[Mapping[str, Callable[..., Any]], tuple[str, ...]]:
        def sync() -> Any:
            yield

        return {"say": said.append, "sync": sync}, ("sync",)

    program = Program(f"def prog():\n{body}\nend\n", functions)
    for _ in range(frames):
        if program.finished:
            break
        program.step()
    return said


def controller() -> Controller:
    return Controller(load_arm(), np.array(HOME), parse_version("5.21"))


def frames(made: Controller, count: int) -> None:
    for _ in range(count):
        made.step()


def test_newline_is_white_space_where_an_operand_is_expected() -> None:
    # ur_rtde injects its register offset after a comment, so that the number stands in the next line
    assert said_by("global offset = # register offset\n24    global other = 1 +\n 2\nsay(offset) say(other)") == [24, 3]


def test_operators_bind_as_in_the_manual() -> None:
    assert said_by("say(1 + 2 * 3 - 4 / 2)\nsay(True or False and False)\nsay(True xor True)\nsay(-2 * 3)") == [
        5.0,
        True,
        False,
        -6,
    ]


def test_assignment_copies_a_list() -> None:
    assert said_by("a = [1, 2]\nb = a\nb[0] = 9\nsay(a[0])") == [1]


def test_a_parameter_called_p_is_indexed_and_six_numbers_are_a_pose() -> None:
    assert said_by("def first(p, factor=2):\nreturn p[0] * factor\nend\nsay(first(p[5, 0, 0, 0, 0, 0], factor=3))") == [
        15
    ]


def test_names_of_the_main_body_are_global_and_those_of_a_function_are_its_own() -> None:
    body = "x = 1\ndef f():\nx = 2\nlocal y = 3\nend\ny = 7\nf()\nsay(x)\nsay(y)"
    assert said_by(body) == [2, 7]


def test_elif_else_break_continue() -> None:
    body = """
    i = 0
    while True:
      i = i + 1
      if i == 2:
        continue
      elif i > 4:
        break
      else:
        say(i)
      end
    end"""
    assert said_by(body) == [1, 3, 4]


def test_a_thread_runs_beside_the_program_until_it_is_joined_or_killed() -> None:
    body = """
    global n = 0
    thread counter():
      while n < 3:
        n = n + 1
        sync()
      end
    end
    thread endless():
      while True:
        sync()
      end
    end
    e = run endless()
    join run counter()
    say(n)
    kill e
    say(n)"""
    assert said_by(body) == [3, 3]


def test_a_critical_section_protects_no_longer_than_its_slice() -> None:
    # UR's control script holds one over a whole trajectory, which its other threads cancel meanwhile
    body = """
    global n = 0
    thread counter():
      while True:
        n = n + 1
        sync()
      end
    end
    enter_critical
    run counter()
    say(n)
    sync()
    sync()
    say(n)
    exit_critical"""
    assert said_by(body) == [0, 1]


@pytest.mark.parametrize(
    ("body", "part", "line"),
    [
        ("while True:\nx = 1\nend", "takes no time", 2),
        ("sync()\nsay(nowhere)", "nowhere", 3),
        ("sync()\na = [1]\nsay(a[1])", "outside", 4),
        ("if [1]:\nsay(1)\nend", "True or False", 2),
        ("say(1 / 0)", "zero", 2),
        ("say([1, 2] + [1])", "Lists of 2 and 1", 2),
    ],
)
def test_a_mistake_stops_the_program_and_names_its_line(body: str, part: str, line: int) -> None:
    with pytest.raises(ScriptError, match=part) as caught:
        said_by(body)
    assert caught.value.line == line


@pytest.mark.parametrize("body", ["x = ", "if True:\nsay(1)", "unheard_of(1)", "x = 1 +* 2", "say(?)"])
def test_what_is_not_urscript_never_starts(body: str) -> None:
    with pytest.raises(ScriptError):
        said_by(body)


def test_programs_are_cut_at_their_own_end_and_lines_stand_alone() -> None:
    text = "movej([0])\ndef a():\nif True:\n# end\nsync()\nend\nend\nsec b():\nend\ndef c():\n"
    programs, rest = split_programs(text)
    assert [program.split("(")[0] for program in programs] == ["movej", "def a", "sec b"]
    assert rest == "def c():\n"


def test_movej_arrives_in_the_time_of_its_trapezoid() -> None:
    made = controller()
    made.submit("movej([0.3, -1.57, 1.57, -1.57, -1.57, 0.1], a=2.0, v=0.5)")
    # 0.5^2 / 2 = 0.125 rad of ramps, so 0.25 s + 0.175 / 0.5 s + 0.25 s = 0.85 s, and a frame at either end
    frames(made, 420)
    assert made.runtime_state == RuntimeState.PLAYING
    frames(made, 10)
    assert made.runtime_state == RuntimeState.STOPPED
    assert np.abs(made.arm.q - [0.3, -1.57, 1.57, -1.57, -1.57, 0.1]).max() < 1e-12


def test_movel_keeps_to_the_line_and_turns_nothing() -> None:
    made = controller()
    start, X_start = made.arm.tool_pose(), made.arm.flange(made.arm.q)
    made.submit(f"movel(p{[start[0], start[1] + 0.1, start[2], *start[3:]]}, a=1.0, v=0.2)")
    away = 0.0
    for _ in range(500):
        made.step()
        X = made.arm.flange(made.arm.q)
        away = max(away, *np.abs((X - X_start)[[0, 2], 3]), np.abs((X - X_start)[:3, :3]).max())
    assert made.arm.tool_pose()[1] == pytest.approx(start[1] + 0.1, abs=1e-9)
    assert away < 1e-8  # the solver stops at 1e-10 m and rad, and what is left adds up over no more than a step


def test_a_stopped_program_brakes_the_arm_at_the_stated_deceleration() -> None:
    made = controller()
    made.submit("speedj([0.5, 0, 0, 0, 0, 0], a=5.0, t=10)")
    frames(made, 200)
    assert made.arm.qd[0] == pytest.approx(0.5)
    made.stop_program()
    # 0.5 rad/s at 10 rad/s^2 is 25 frames
    frames(made, 24)
    assert made.arm.qd[0] > 0.0
    assert made.runtime_state == RuntimeState.STOPPING
    frames(made, 3)
    assert made.runtime_state == RuntimeState.STOPPED
    assert not made.arm.qd.any()


def test_a_second_thread_that_moves_ends_the_program() -> None:
    made = controller()
    made.submit(
        "def two():\nthread t():\nspeedj([0.1,0,0,0,0,0], 1, 5)\nend\nrun t()\nsync()\nsync()\nstopj(2)\nsync()\nend\n"
    )
    frames(made, 50)
    assert made.program is None
    assert any("Another thread is already controlling the robot" in line for line in made.log)


@pytest.mark.parametrize("action", ["stop", "pause"])
def test_a_watchdog_acts_one_period_after_the_last_write(action: str) -> None:
    made = controller()
    made.submit(f'def w():\nrtde_set_watchdog("input_int_register_0", 50, "{action}")\nwhile True:\nsync()\nend\nend\n')
    for _ in range(5):
        frames(made, 9)
        made.written(("input_int_register_0",))
    assert made.runtime_state == RuntimeState.PLAYING
    frames(made, 13)
    assert made.runtime_state == (RuntimeState.STOPPED if action == "stop" else RuntimeState.PAUSED)


def test_a_protective_stop_pauses_and_play_goes_on_with_the_old_speed() -> None:
    made = controller()
    made.submit("speedj([0.1, 0, 0, 0, 0, 0], a=5.0, t=100)")
    frames(made, 100)
    made.protective_stop("a test")
    frames(made, 20)
    assert made.safety_mode == SafetyMode.PROTECTIVE_STOP
    assert made.runtime_state == RuntimeState.PAUSED
    assert not made.arm.qd.any()
    assert not made.unlock_protective_stop()  # younger than 5 s
    frames(made, 2500)
    assert made.unlock_protective_stop()
    assert made.resume_program()
    frames(made, 50)
    assert made.arm.qd[0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("speedj([9, 0, 0, 0, 0, 0], a=40, t=5)", "too fast"),
        ("speedj([0, 0, 0.5, 0, 0, 0], a=5, t=9)", "limit"),
        ("movel(p[-1.5, -0.17, 0.7, 2.22, 2.22, 0])", "reach|too fast"),
        ("speedl([-0.2, 0, 0, 0, 0, 0], a=1, t=20)", "singularity|too fast"),
    ],
)
def test_what_the_arm_cannot_do_is_a_protective_stop(line: str, why: str) -> None:
    made = controller()
    made.submit(line)
    frames(made, 3000)
    assert made.safety_mode == SafetyMode.PROTECTIVE_STOP
    assert re.search(why, "\n".join(made.log))
    assert not made.arm.qd.any()
    assert (np.abs(made.arm.q) <= made.arm.model.position_upper).all()


def test_a_script_talks_to_a_server_and_waits_no_longer_than_it_says() -> None:
    made = controller()
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        made.submit(
            f"""def talk():
              textmsg("open ", socket_open("127.0.0.1", {port}, "s"))
              socket_send_line("hello", "s")
              socket_send_int(-2, "s")
              textmsg("floats ", socket_read_ascii_float(2, "s"))
              textmsg("ints ", socket_read_binary_integer(2, "s"))
              textmsg("line ", socket_read_line("s"))
              textmsg("late ", socket_read_line("s", 0.1))
              textmsg("elsewhere ", socket_open("10.0.0.1", 80))
            end
            """
        )
        frames(made, 10)
        server.settimeout(5.0)
        with server.accept()[0] as peer:
            peer.settimeout(5.0)
            assert peer.recv(64) == b"hello\n" + struct.pack(">i", -2)
            peer.sendall(b"(1.5, -2e-1)" + struct.pack(">2i", 7, -8) + b"bye\n")
            frames(made, 10)
            assert made.runtime_state == RuntimeState.PLAYING
            frames(made, 50)
            assert peer.recv(64) == b""  # the program has ended, and its sockets with it
    assert made.runtime_state == RuntimeState.STOPPED
    said = [line.split("script: ")[1] for line in made.log if "script: " in line]
    assert said == ["open True", "floats [2, 1.5, -0.2]", "ints [2, 7, -8]", "line bye", "late ", "elsewhere False"]


def test_functions_come_with_their_version() -> None:
    asked = "def q():\nj = get_jacobian()\ntextmsg(j[0, 1])\nend\n"
    for version, known in (("5.21", False), ("5.23", True), ("10.7", False), ("10.12", True)):
        made = Controller(load_arm(), np.array(HOME), parse_version(version))
        assert made.start(asked) is known


def test_coriolis_torques_are_those_of_the_mass_matrix() -> None:
    # the power they take is half the change of the mass matrix: qd' c = qd' dM/dt qd / 2 (dM/dt - 2C is skew)
    made = Controller(load_arm(), np.array(HOME), parse_version("5.23"))
    functions = Dynamics(made, None)  # type: ignore[arg-type]
    q, qd, step = np.array(HOME) + 0.3, np.array([0.5, -0.4, 0.3, 0.2, -0.6, 0.1]), 1e-6
    torques = np.array(functions.get_coriolis_and_centrifugal_torques(q.tolist(), qd.tolist()))
    rate = (mass_matrix(made.arm.model, q + step * qd) - mass_matrix(made.arm.model, q - step * qd)) / (2 * step)
    assert qd @ torques == pytest.approx(0.5 * qd @ rate @ qd, rel=1e-6)
    J_rate = np.array(functions.get_jacobian_time_derivative(q.tolist(), qd.tolist()))
    ahead, behind = (np.array(functions.get_jacobian((q + s * qd).tolist())) for s in (1e-4, -1e-4))
    # the two steps of the difference, 1e-4 s of a smooth function: second order
    assert np.abs(J_rate - (ahead - behind) / 2e-4).max() < 1e-7


def test_the_mass_matrix_is_that_of_drakes_plant() -> None:
    model = load_arm()
    plant = MultibodyPlant(0.0)
    parser = Parser(plant)
    (robot,) = parser.AddModelsFromString(arm_urdf(model), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", robot))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    q = np.array(HOME) + 0.3
    plant.SetPositions(context, q)
    assert np.abs(plant.CalcMassMatrix(context) - mass_matrix(model, q)).max() < 1e-9
