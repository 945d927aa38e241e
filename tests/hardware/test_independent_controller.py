"""The robot link with a controller that was written from UR's documents only: a second opinion beside the
emulator's."""

from __future__ import annotations

import ast
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.hardware import independent
from tests.hardware.bare_rtde import Rtde
from tests.hardware.independent.grammar import ScriptError, complete_programs
from tests.hardware.independent.machine import PLAYING, STOPPED, Machine
from tests.hardware.independent.program import Program
from tests.hardware.independent_process import Controller, independent_controller, move, session
from tests.hardware.try_independent import FAULTS, break_session
from weldcal.models.arms.kinematics import forward_kinematics, load_arm

FOLDER = Path(independent.__file__).parent
IN_THE_SUITE = ("pause", "protective stop", "second program")


def imported(file: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            found.add(str(node.module))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in ("__import__", "eval", "exec")
    return found


def test_the_controller_imports_nothing_of_the_product() -> None:
    files = sorted(FOLDER.glob("*.py"))
    assert len(files) >= 6
    for file in files:
        for name in imported(file):
            top = name.partition(".")[0]
            assert top in sys.stdlib_module_names or name.startswith("tests.hardware.independent."), (file.name, name)
            assert top != "importlib", file.name


@pytest.fixture(scope="module")
def controller() -> Iterator[Controller]:
    with independent_controller() as made:
        yield made


def test_the_link_starts_moves_and_ends_the_guard(controller: Controller) -> None:
    controller.do("mark")
    with session(controller) as link:
        running = controller.state()
        assert (running["runtime_state"], running["program"]) == (PLAYING, "weldcal_guard")
        assert running["payload"] == pytest.approx(1.4)
        assert move(link, 1.0) is None
        assert 0.05 < controller.state()["travel"] < 0.3
        # the controller's pose is of its own chain of DH transforms
        state = controller.state()
        pose = forward_kinematics(load_arm("ur10e"), state["q"])
        assert np.linalg.norm(pose.translation() - state["pose"][:3]) < 1e-9
        turn = Rotation.from_rotvec(state["pose"][3:]).as_matrix().T @ pose.rotation().matrix()
        assert Rotation.from_matrix(turn).magnitude() < 1e-7
        foreign = {"weldcal", "pydrake", "numpy"} & set(state["modules"])
        assert foreign == set()
    ended = controller.state()
    assert (ended["runtime_state"], ended["program"], max(map(abs, ended["qd"]))) == (STOPPED, None, 0.0)


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault.name in IN_THE_SUITE], ids=lambda f: f.name)
def test_a_fault_is_named_and_nothing_moves_after_repair_and_play(controller: Controller, fault: object) -> None:
    chosen = next(one for one in FAULTS if one is fault)
    for _ in range(3):
        found = break_session(controller, chosen, process_output=2)
        assert found.resumed_rad < 1e-6
        if chosen.word in found.named or not found.late:
            break  # a computer that was late meanwhile may end the session by the name of that
    assert chosen.word in found.named
    assert found.rests_s <= chosen.rests_s
    assert not found.process_on, "the torch's output stays on in a paused program, if the driver leaves it on"


def test_a_client_claims_inputs_and_starts_only_with_outputs(controller: Controller) -> None:
    with Rtde(controller.host) as first, Rtde(controller.host) as second:
        assert first.send(b"S") == b"\0"
        assert first.send(b"I", b"input_int_register_3,input_double_register_3,") == b"\x01INT32,DOUBLE"
        assert second.send(b"I", b"input_int_register_3") == b"\0IN_USE"
        assert second.send(b"I", b"no_such_register") == b"\0NOT_FOUND"
        assert second.send(b"O", struct.pack(">d", 125.0) + b"timestamp,no_such_output") == b"\0DOUBLE,NOT_FOUND"
        second.watch("timestamp", "input_int_register_3", "input_double_register_3", hz=125.0)
        first.put(b"U", struct.pack(">Bid", 1, 7, 0.5))
        kept = second.until("input_int_register_3", 7)
        assert kept["input_double_register_3"] == 0.5
        times = [second.next()["timestamp"] for _ in range(5)]
        assert np.diff(times) == pytest.approx(0.008, abs=1e-6)


def run(text: str, frames: int = 50) -> Machine:
    """A machine after so many frames with this program."""
    machine = Machine()
    machine.upload(text)
    for _ in range(frames):
        machine.frame()
    return machine


def test_speedj_turns_the_joint_as_its_manual_says() -> None:
    # 0.2 rad/s with 1 rad/s^2: 0.2 s to the speed; after 0.5 s the area under the ramp is 0.2 * 0.5 - 0.2^2 / 2 = 0.08
    # rad
    machine = run("def p():\n speedj([0.2, 0, 0, 0, 0, 0], 1.0, 0.5)\n while True:\n sync()\n end\nend\n", 250)
    assert machine.q[0] == pytest.approx(0.08, abs=0.2 * 0.002)
    assert machine.state == PLAYING


def test_a_program_without_packages_is_stopped_by_its_watchdog() -> None:
    text = (
        'def p():\n rtde_set_watchdog("input_int_register_24", 5, "stop")\n while True:\n  speedj([0.1,0,0,0,0,0], 1.0,'
        " 0.002)\n end\nend\n"
    )
    assert run(text, 100).state == PLAYING
    stopped = run(text, 160)
    assert stopped.state == STOPPED
    assert "watchdog" in stopped.log[-1][1]


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("global x = 1\nx = True", "cannot become"),
        ("global x = [1, 2]\nx = [1, 2, 3]", "cannot become"),
        ("x = y", "no value"),
        ("if 1:\n x = 2\nend", "True or False"),
        ("no_such_function()", "not defined"),
        ("while True:\n x = 1\nend", "without a pause"),
        ("x = 1 +\nend", "expected"),
    ],
)
def test_a_wrong_program_is_an_error_by_name(body: str, said: str) -> None:
    with pytest.raises(ScriptError, match=said):
        list(Program(f"def p():\n{body}\nend\n", {}, {}).run())


def test_a_script_port_waits_for_the_end_of_a_program() -> None:
    text = "def p():\n  if True: # end\n    sync()\n  end\n"
    assert complete_programs(text) == ([], text)
    programs, rest = complete_programs(f"{text}end\nstop program\ndef q():\n")
    assert programs == [f"{text}end\n", "stop program"]
    assert rest == "def q():\n"
